"""A store in one SQLite file, in WAL mode: what is committed survives a killed process, a torn tail is cut off."""

import os
import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.storage import former
from prior_sg.services.scene_store.storage.tables import (
    LAYOUT_VERSION,
    Found,
    Indexed,
    Point,
    Storage,
    StoreAway,
    StoreError,
    words_of,
)
from prior_sg.services.scene_store.storage.writing import begin

APPLICATION_ID = 0x70736753  # "psgS", in the header of the file
AWAY = ("SQLITE_FULL", "SQLITE_IOERR")  # what a full disk, or one that is not there, makes of reads and writes
FIRST_RADIUS_M, LAST_RADIUS_M = 1.0, 1e7  # of the search for what is nearest

_RECORDS = """
CREATE TABLE {table} (
    robot INTEGER NOT NULL REFERENCES robots, sequence INTEGER NOT NULL, revision INTEGER NOT NULL,
    session INTEGER NOT NULL, kind TEXT NOT NULL, stamp_ns INTEGER NOT NULL, places INTEGER NOT NULL,
    edges INTEGER NOT NULL, regions INTEGER NOT NULL, objects INTEGER NOT NULL, schema TEXT NOT NULL,
    payload BLOB NOT NULL, PRIMARY KEY (robot, sequence));
CREATE INDEX {table}_by_revision ON {table} (robot, revision, kind, stamp_ns);
"""
_PRIORS = """
CREATE TABLE priors (
    digest TEXT PRIMARY KEY, environment TEXT NOT NULL, task TEXT NOT NULL, source TEXT NOT NULL,
    message BLOB NOT NULL) WITHOUT ROWID;
"""
_INDEX = """
CREATE TABLE places (
    id INTEGER PRIMARY KEY, robot INTEGER NOT NULL REFERENCES robots, number INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL, radius_m REAL NOT NULL, UNIQUE (robot, number));
CREATE TABLE objects (
    id INTEGER PRIMARY KEY, robot INTEGER NOT NULL REFERENCES robots, number INTEGER NOT NULL,
    label TEXT NOT NULL, words TEXT NOT NULL, x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL,
    x_min_m REAL NOT NULL, y_min_m REAL NOT NULL, z_min_m REAL NOT NULL,
    x_max_m REAL NOT NULL, y_max_m REAL NOT NULL, z_max_m REAL NOT NULL, UNIQUE (robot, number));
CREATE TABLE regions (
    id INTEGER PRIMARY KEY, robot INTEGER NOT NULL REFERENCES robots, number INTEGER NOT NULL,
    label TEXT NOT NULL, words TEXT NOT NULL, x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL,
    place_count INTEGER NOT NULL, area_m2 REAL NOT NULL, probability REAL NOT NULL, UNIQUE (robot, number));
"""
_CORNERS = {  # of the box of a row of the index, per axis
    "place": [(f"{{row}}{axis}_m - {{row}}radius_m", f"{{row}}{axis}_m + {{row}}radius_m") for axis in "xyz"],
    "object": [(f"{{row}}{axis}_min_m", f"{{row}}{axis}_max_m") for axis in "xyz"],
}
_BOXES = {  # least and greatest per axis, whatever a message called so
    kind: [f"{end}({', '.join(corners)})" for corners in axes for end in ("min", "max")]
    for kind, axes in _CORNERS.items()
}
_AXES = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")


def _box_triggers(kind: str) -> str:
    """An R*Tree over the boxes, with the robot as a fourth axis, that follows its table."""
    table, box = f"{kind}_boxes", [bound.format(row="new.") for bound in _BOXES[kind]]
    add = f"INSERT INTO {table} VALUES (new.id, new.robot, new.robot, {', '.join(box)});"
    moved = ", ".join(f"{column} = {bound}" for column, bound in zip(_AXES, box, strict=True))
    move = f"UPDATE {table} SET {moved} WHERE id = new.id;"
    return f"""
CREATE VIRTUAL TABLE {table} USING rtree(id, robot_min, robot_max, {", ".join(_AXES)});
CREATE TRIGGER {table}_new AFTER INSERT ON {kind}s BEGIN {add} END;
CREATE TRIGGER {table}_moved AFTER UPDATE ON {kind}s BEGIN {move} END;
CREATE TRIGGER {table}_gone AFTER DELETE ON {kind}s BEGIN DELETE FROM {table} WHERE id = old.id; END;
"""


def _word_triggers(kind: str) -> str:
    """A full-text index over the words of labels that follows its table."""
    table = f"{kind}_words"
    add, drop = (
        f"INSERT INTO {table} (rowid, words) VALUES (new.id, new.words);",
        f"DELETE FROM {table} WHERE rowid = old.id;",
    )
    return f"""
CREATE VIRTUAL TABLE {table} USING fts5(words, tokenize = "unicode61 remove_diacritics 0");
CREATE TRIGGER {table}_new AFTER INSERT ON {kind}s BEGIN {add} END;
CREATE TRIGGER {table}_other AFTER UPDATE OF words ON {kind}s WHEN old.words <> new.words BEGIN {drop} {add} END;
CREATE TRIGGER {table}_gone AFTER DELETE ON {kind}s BEGIN {drop} END;
"""


ROBOTS = "CREATE TABLE robots (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);"
HISTORY = (
    "".join(_RECORDS.format(table=table) for table in ("events", "snapshots"))
    + _INDEX
    + "".join(map(_box_triggers, _BOXES))
    + "".join(map(_word_triggers, ("object", "region")))
)
LAYOUT = ROBOTS + _PRIORS + HISTORY


class Sqlite(Storage):
    """One open file. Raises StoreError when it is no scene database, is damaged or cannot be written. One of an older
    layout is converted; to be only read, a copy of it in memory is.
    """

    def __init__(self, cfg: Config, *, read_only: bool = False) -> None:
        self.location = cfg.path
        try:
            if cfg.path != ":memory:" and not read_only:
                Path(cfg.path).parent.mkdir(parents=True, exist_ok=True)
            where, is_uri = _frozen(cfg.path) if read_only else (cfg.path, False)
            self.connection = sqlite3.connect(where, isolation_level=None, check_same_thread=False, uri=is_uri)
            try:
                self._open(cfg, read_only)
            except BaseException:
                self.connection.close()
                raise
        except (sqlite3.Error, OSError) as error:
            raise unusable(cfg.path, error) from error

    def _open(self, cfg: Config, read_only: bool) -> None:
        run = self.connection.execute
        run(f"PRAGMA busy_timeout = {cfg.busy_timeout_ms}")
        empty, version = content(self.connection)
        if read_only and version == LAYOUT_VERSION:
            run("PRAGMA query_only = ON")
            return
        if read_only and empty:
            raise sqlite3.DatabaseError("it holds no scenes")
        if read_only:
            self._copy()
            run = self.connection.execute
        run("PRAGMA journal_mode = WAL")
        run(f"PRAGMA synchronous = {cfg.synchronous}")
        run(f"PRAGMA wal_autocheckpoint = {cfg.checkpoint_pages}")
        run("PRAGMA foreign_keys = ON")
        if empty:
            self.connection.executescript(
                f"BEGIN IMMEDIATE; {LAYOUT} PRAGMA application_id = {APPLICATION_ID};"
                f"PRAGMA user_version = {LAYOUT_VERSION}; COMMIT;"
            )
        elif version < LAYOUT_VERSION:
            former.upgrade(self.connection, version)
            self._convert()
        if read_only:
            run("PRAGMA query_only = ON")
            return
        check_whole(self.connection)

    def _copy(self) -> None:
        """Go on with a copy in memory; the file stays as it is."""
        file, self.connection = (
            self.connection,
            sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False),
        )
        with closing(file):
            file.backup(self.connection)

    def _convert(self) -> None:
        """A file of the last layout without history: what it holds becomes each robot's first snapshot."""
        with self.transaction():
            if self.run("PRAGMA user_version")[0][0] == LAYOUT_VERSION:  # another process was faster
                return
            graphs = former.graphs(self.connection)
            for statement in former.GONE:
                self.connection.execute(statement)
            for statement in _statements(HISTORY):
                self.connection.execute(statement)
            for robot, graph in graphs.items():
                begin(self, robot, graph)
            self.connection.execute(f"PRAGMA user_version = {LAYOUT_VERSION}")

    def run(self, sql: str, arguments: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        with self._refused():
            return self.connection.execute(sql, arguments).fetchall()

    def stream(self, sql: str, arguments: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
        with self._refused():
            yield from self.connection.execute(sql, arguments)

    def run_many(self, sql: str, rows: Iterable[Sequence[Any]]) -> None:
        with self._refused():
            self.connection.executemany(sql, rows)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        with self._refused():
            self.connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self.connection.execute("COMMIT")
            except BaseException:
                if self.connection.in_transaction:
                    self.connection.execute("ROLLBACK")
                raise

    @contextmanager
    def _refused(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            if (
                getattr(error, "sqlite_errorname", "") == "SQLITE_CONSTRAINT_PRIMARYKEY"
            ):  # the next event is there already
                raise StoreError(
                    f"{self.location} is written by another scene_store; stop it or name another."
                ) from error
            if getattr(error, "sqlite_errorname", "").startswith(AWAY):
                raise StoreAway(
                    f"{self.location} cannot be read or written ({error}); free the disk: the store then goes on."
                ) from error
            raise StoreError(
                f"{self.location} cannot be read or written ({error}); free the file, then restart."
            ) from error

    def nearest(self, robot: int, kind: Indexed, point_m: Point, count: int) -> list[Found]:
        """Within a growing box, until a sphere inside it holds enough."""
        x, y, z = point_m
        away = f"({' + '.join(f'({axis}_m - ?) * ({axis}_m - ?)' for axis in 'xyz')})"
        radius_m = FIRST_RADIUS_M
        while True:
            box = [(centre - radius_m, centre + radius_m) for centre in point_m]
            sql, limits = self._within(robot, kind, box, columns=f"{away} AS away, ")
            rows = self.run(f"{sql} ORDER BY away, number LIMIT ?", (x, x, y, y, z, z, *limits, count))
            if radius_m > LAST_RADIUS_M or (len(rows) == count and rows[-1][0] <= radius_m**2):
                return [_found(kind, row[1:]) for row in rows]
            radius_m *= 2

    def overlapping(self, robot: int, kind: Indexed, min_m: Point, max_m: Point) -> list[Found]:
        sql, limits = self._within(robot, kind, list(zip(min_m, max_m, strict=True)))
        exact = [
            f"{edge.format(row='t.')} {'<=' if i % 2 == 0 else '>='} ?" for i, edge in enumerate(_BOXES[kind])
        ]  # the tree holds its boxes in single precision, rounded outwards
        bounds = [value for low, high in zip(min_m, max_m, strict=True) for value in (high, low)]
        rows = self.run(f"{sql} AND {' AND '.join(exact)} ORDER BY number", (*limits, *bounds))
        return [_found(kind, row) for row in rows]

    def _within(
        self, robot: int, kind: Indexed, box: list[tuple[float, float]], columns: str = ""
    ) -> tuple[str, list[float]]:
        """A statement for rows (number, label, x, y, z) whose boxes overlap one, and its arguments."""
        label = "''" if kind == "place" else "label"
        axes = " AND ".join(f"{axis}_min <= ? AND {axis}_max >= ?" for axis in ("robot", "x", "y", "z"))
        sql = f"SELECT {columns}number, {label}, x_m, y_m, z_m FROM {kind}_boxes JOIN {kind}s t USING (id) WHERE {axes}"
        return sql, [value for low, high in ((robot, robot), *box) for value in (high, low)]

    def labelled(self, robot: int, kind: Indexed, text: str) -> list[Found]:
        query = " ".join(f'"{word}"*' for word in words_of(text).split())
        if not query:
            return []
        rows = self.run(
            f"SELECT number, label, x_m, y_m, z_m FROM {kind}s WHERE robot = ?"
            f" AND id IN (SELECT rowid FROM {kind}_words WHERE {kind}_words MATCH ?) ORDER BY label, number",
            (robot, query),
        )
        return [_found(kind, row) for row in rows]

    def checkpoint(self) -> None:
        """Fold what the write-ahead log holds into the file, without waiting for readers."""
        self.run("PRAGMA wal_checkpoint(PASSIVE)")

    def disk_bytes(self) -> int:
        if self.location == ":memory:":
            return 0
        path = Path(self.location)
        return sum(file.stat().st_size for file in (path, path.with_name(f"{path.name}-wal")) if file.exists())

    def room(self) -> dict[str, float]:
        if self.location == ":memory:":
            return {}
        free = shutil.disk_usage(Path(self.location).parent).free
        return {"file_bytes": self.disk_bytes(), "disk_free_bytes": free}

    def close(self) -> None:
        """The last connection removes the write-ahead log."""
        self.connection.close()


def content(connection: sqlite3.Connection) -> tuple[bool, int]:
    """Whether a file is empty, and the version of its layout. Raises sqlite3.Error for one that holds no scenes."""
    kind, version = (connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
    empty = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0] == 0
    if not empty and (kind != APPLICATION_ID or not 1 <= version <= LAYOUT_VERSION):
        found = f"layout {version}, this program needs {LAYOUT_VERSION}" if kind == APPLICATION_ID else "other content"
        raise sqlite3.DatabaseError(f"it holds {found}")
    return empty, version


def check_whole(connection: sqlite3.Connection) -> None:
    """Raises sqlite3.Error for a damaged file."""
    fault = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if fault != "ok":
        raise sqlite3.DatabaseError(f"it is damaged: {' '.join(fault.split())}")


def unusable(path: str, error: Exception) -> StoreError:
    """What there is to say of a file that cannot be opened."""
    return StoreError(f"{path} cannot be used as a scene database ({error}); {_remedy(error)}")


def _found(kind: Indexed, row: tuple[Any, ...]) -> Found:
    number, label, *position_m = row
    return Found(kind, number, label, tuple(position_m))


def _frozen(path: str) -> tuple[str, bool]:
    """How to name a file that is only read, and whether that is a URI: where nobody can write beside it, as on a medium
    that is read only, nothing has to be coordinated."""
    file = Path(path)
    if os.access(file.parent, os.W_OK) or file.with_name(f"{file.name}-wal").exists():
        return path, False
    return f"file:{quote(str(file))}?immutable=1", True


def _remedy(error: Exception) -> str:
    if isinstance(error, sqlite3.OperationalError | OSError):
        return "free the file or choose another path."
    return "move the file away or choose another path."


def _statements(script: str) -> Iterator[str]:
    """Each statement of a script, for `executescript` would end the transaction."""
    statement = ""
    for piece in script.split(";"):
        statement += f"{piece};"
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""
