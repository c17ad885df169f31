"""A store in a PostgreSQL database, in a schema of its own: the same tables, with `cube` for boxes and what is nearest.

One store writes at a time; it holds a lock that the server releases when the store is gone. Passwords come from where
libpq finds them (PGPASSWORD, ~/.pgpass), never from the address.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, LiteralString, cast

from prior_sg.services.runtime import extras
from prior_sg.services.scene_store.core.config import Config
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

extras.require("postgres", "a scene store in PostgreSQL")
import psycopg  # noqa: E402

SCHEMA = "prior_sg"
WRITER_LOCK = 0x70736753  # "psgS"; of a database
ROBOT_APART_M = 1e9  # the robot is a fourth axis of boxes and centres, along which robots stand this far apart
CONNECT_S = 10
PAGE = 200  # events fetched at a time

_RECORDS = """
CREATE TABLE {table} (
    robot BIGINT NOT NULL REFERENCES robots, sequence BIGINT NOT NULL, revision BIGINT NOT NULL,
    session BIGINT NOT NULL, kind TEXT NOT NULL, stamp_ns BIGINT NOT NULL, places BIGINT NOT NULL,
    edges BIGINT NOT NULL, regions BIGINT NOT NULL, objects BIGINT NOT NULL, schema TEXT NOT NULL,
    payload BYTEA NOT NULL, PRIMARY KEY (robot, sequence));
ALTER TABLE {table} ALTER COLUMN payload SET STORAGE EXTERNAL;
CREATE INDEX {table}_by_revision ON {table} (robot, revision, kind, stamp_ns);
"""
_APART = f"robot * {ROBOT_APART_M:.0f}"
_CENTRE = f"cube(ARRAY[x_m, y_m, z_m, {_APART}])"
_SPHERE = ", ".join(
    f"ARRAY[{', '.join(f'{axis}_m {sign} radius_m' for axis in 'xyz')}, {_APART}]" for sign in ("-", "+")
)
_CORNERS = ", ".join(f"ARRAY[{', '.join(f'{axis}_{end}_m' for axis in 'xyz')}, {_APART}]" for end in ("min", "max"))
_LABEL = """label TEXT NOT NULL, words TEXT NOT NULL,
    terms tsvector GENERATED ALWAYS AS (array_to_tsvector(array_remove(string_to_array(words, ' '), ''))) STORED"""


def _table(kind: Indexed, columns: str, box: str = "") -> str:
    """One table of the index with what answers its questions."""
    boxed = f", box cube GENERATED ALWAYS AS (cube({box})) STORED" if box else ""
    indices = {"centre": "gist", **({"box": "gist"} if box else {}), **({} if kind == "place" else {"terms": "gin"})}
    return f"""
CREATE TABLE {kind}s (
    robot BIGINT NOT NULL REFERENCES robots, number BIGINT NOT NULL,
    x_m FLOAT8 NOT NULL, y_m FLOAT8 NOT NULL, z_m FLOAT8 NOT NULL, {columns},
    centre cube GENERATED ALWAYS AS ({_CENTRE}) STORED{boxed}, PRIMARY KEY (robot, number));
""" + "".join(
        f"CREATE INDEX {kind}s_by_{column} ON {kind}s USING {method} ({column});" for column, method in indices.items()
    )


_EDGES = ", ".join(f"{axis}_{end}_m FLOAT8 NOT NULL" for end in ("min", "max") for axis in "xyz")
_FIGURES = "place_count BIGINT NOT NULL, area_m2 FLOAT8 NOT NULL, probability FLOAT8 NOT NULL"
LAYOUT = (
    "CREATE TABLE layout (version BIGINT NOT NULL);"
    f"INSERT INTO layout VALUES ({LAYOUT_VERSION});"
    "CREATE TABLE robots (id BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, name TEXT NOT NULL UNIQUE);"
    "CREATE TABLE priors (digest TEXT PRIMARY KEY, environment TEXT NOT NULL, task TEXT NOT NULL,"
    " source TEXT NOT NULL, message BYTEA NOT NULL);"
    + "".join(_RECORDS.format(table=table) for table in ("events", "snapshots"))
    + _table("place", "radius_m FLOAT8 NOT NULL", _SPHERE)
    + _table("object", f"{_LABEL}, {_EDGES}", _CORNERS)
    + _table("region", f"{_LABEL}, {_FIGURES}")
)


class Postgres(Storage):
    """One connection to a database. Raises StoreError, ExtraMissing."""

    def __init__(self, cfg: Config, *, read_only: bool = False) -> None:
        self.location = _location(cfg.path)
        try:
            self.connection = psycopg.connect(cfg.path, autocommit=True, connect_timeout=CONNECT_S)
        except psycopg.Error as error:
            raise StoreError(
                f"{self.location} cannot be reached ({_line(error)}); start it, or correct scene_store.path."
            ) from error
        try:
            with self._refused():
                self._open(cfg, read_only)
        except BaseException:
            self.connection.close()
            raise

    def _open(self, cfg: Config, read_only: bool) -> None:
        durably = {"full": "on", "normal": "off"}[cfg.synchronous]
        for setting, value in (
            ("synchronous_commit", durably),
            ("lock_timeout", f"{cfg.busy_timeout_ms}ms"),
            ("search_path", f"{SCHEMA}, public"),
        ):
            self.run("SELECT set_config(?, ?, false)", (setting, value))
        there = self.run("SELECT to_regclass(?)", (f"{SCHEMA}.layout",))[0][0] is not None
        if read_only:
            if not there:
                raise StoreError(f"{self.location} holds no scenes; `prior-sg up` with this scene_store.path makes it.")
            self.run("SET default_transaction_read_only = on")
        else:
            self._lock()
            if not there:
                self._create()
        version = self.run("SELECT version FROM layout")[0][0]
        if version != LAYOUT_VERSION:
            raise StoreError(
                f"{self.location} holds scenes of layout {version}, this program needs {LAYOUT_VERSION}; "
                "use the program that wrote it or another database."
            )

    def _lock(self) -> None:
        """Be the one who writes."""
        try:
            self.connection.execute("SELECT pg_advisory_lock(%s)", (WRITER_LOCK,))
        except psycopg.errors.LockNotAvailable as error:
            raise StoreError(f"{self.location} is written by another scene_store; stop it or name another.") from error

    def _create(self) -> None:
        with self.transaction():
            self.run(f"CREATE SCHEMA IF NOT EXISTS {SCHEMA}")
            self.run("CREATE EXTENSION IF NOT EXISTS cube SCHEMA public")
            self.connection.execute(cast(LiteralString, LAYOUT))

    def run(self, sql: str, arguments: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        with self._refused():
            cursor = self.connection.execute(_statement(sql), arguments)
            return cursor.fetchall() if cursor.description else []

    def stream(self, sql: str, arguments: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
        with self._refused(), self.connection.transaction(), self.connection.cursor(name="events") as cursor:
            cursor.itersize = PAGE
            yield from cursor.execute(_statement(sql), arguments)

    def run_many(self, sql: str, rows: Iterable[Sequence[Any]]) -> None:
        with self._refused(), self.connection.cursor() as cursor:
            cursor.executemany(_statement(sql), rows)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        with self._refused(), self.connection.transaction():
            yield

    @contextmanager
    def _refused(self) -> Iterator[None]:
        try:
            yield
        except (psycopg.OperationalError, psycopg.InterfaceError) as error:
            raise StoreAway(
                f"{self.location} cannot be read or written ({_line(error)}); start the server or free its disk: the "
                "store then goes on."
            ) from error
        except psycopg.Error as error:
            raise StoreError(
                f"{self.location} cannot be read or written ({_line(error)}); see the server's log, then restart."
            ) from error

    def nearest(self, robot: int, kind: Indexed, point_m: Point, count: int) -> list[Found]:
        """All other robots stand farther away, so that the index alone says what comes first."""
        order, point = "ORDER BY centre <-> cube(?), number", _corner(point_m, robot)
        first = f"SELECT * FROM {kind}s {order} LIMIT ?"
        sql = f"SELECT {_columns(kind)} FROM ({first}) AS first WHERE robot = ? {order}"
        return _found(kind, self.run(sql, (point, count, robot, point)))

    def overlapping(self, robot: int, kind: Indexed, min_m: Point, max_m: Point) -> list[Found]:
        sql = f"SELECT {_columns(kind)} FROM {kind}s WHERE box && cube(?, ?) ORDER BY number"
        return _found(kind, self.run(sql, (_corner(min_m, robot), _corner(max_m, robot))))

    def labelled(self, robot: int, kind: Indexed, text: str) -> list[Found]:
        query = " & ".join(f"'{word}':*" for word in words_of(text).split())
        if not query:
            return []
        sql = f"SELECT {_columns(kind)} FROM {kind}s WHERE robot = ? AND terms @@ ?::tsquery"
        return _found(kind, self.run(f'{sql} ORDER BY label COLLATE "C", number', (robot, query)))

    def checkpoint(self) -> None:
        """The server tidies up by itself."""

    def disk_bytes(self) -> int:
        tables = ("events", "snapshots", "places", "objects", "regions", "priors", "robots")
        total = " + ".join(f"pg_total_relation_size('{SCHEMA}.{table}')" for table in tables)
        size: int = self.run(f"SELECT {total}")[0][0]
        return size

    def close(self) -> None:
        self.connection.close()


def _statement(sql: str) -> LiteralString:
    """As psycopg wants it; nothing but our own names and marks is ever put together into one."""
    return cast(LiteralString, sql.replace("%", "%%").replace("?", "%s"))


def _columns(kind: Indexed) -> str:
    label = "''" if kind == "place" else "label"
    return f"number, {label}, x_m, y_m, z_m"


def _corner(point_m: Point, robot: int) -> list[float]:
    """A point as boxes and centres hold theirs."""
    return [float(value) for value in (*point_m, robot * ROBOT_APART_M)]


def _found(kind: Indexed, rows: list[tuple[Any, ...]]) -> list[Found]:
    return [Found(kind, number, label, tuple(position_m)) for number, label, *position_m in rows]


def _location(url: str) -> str:
    """The address for messages: where it is, not who connects."""
    try:
        parts = psycopg.conninfo.conninfo_to_dict(url)
    except psycopg.Error:
        raise StoreError(
            "scene_store.path is no address of PostgreSQL; write postgresql://user@host:5432/database"
        ) from None
    host = parts.get("host") or "localhost"
    return f"postgresql://{host}{f':{port}' if (port := parts.get('port')) else ''}/{parts.get('dbname') or ''}"


def _line(error: Exception) -> str:
    """What the server or libpq says, in one line."""
    return " ".join(str(error).split())
