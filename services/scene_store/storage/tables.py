"""The tables of a store and the statements that both databases understand.

Events and snapshots are the truth. The tables `places`, `objects` and `regions` are an index over the present, made of
it in the same transaction, for questions about space and labels and for people who read the database with SQL.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, Literal, NamedTuple

from prior_sg.schemas.scene import StoredRevision
from prior_sg.services.runtime.service import LaterError, ServiceError
from prior_sg.services.scene_store.core.events import DELTAS
from prior_sg.services.scene_store.core.keeping import Mark, Thinned

LAYOUT_VERSION = 6
LAST = 2**62  # beyond every revision
LONGEST_WORD, MOST_WORDS = 64, 64  # letters of a word, words of a label
Point = tuple[float, float, float]
Indexed = Literal["place", "object", "region"]

INDEX = {  # columns behind robot and number
    "place": ("x_m", "y_m", "z_m", "radius_m"),
    "object": ("label", "words", "x_m", "y_m", "z_m", "x_min_m", "y_min_m", "z_min_m", "x_max_m", "y_max_m", "z_max_m"),
    "region": ("label", "words", "x_m", "y_m", "z_m", "place_count", "area_m2", "probability"),
}
_IS_DELTA = f"kind IN ({', '.join(repr(kind) for kind in DELTAS)})"
_COUNTS = "places, edges, regions, objects"


class StoreError(ServiceError):
    """The database cannot be used; the message says what to do."""


class StoreAway(StoreError, LaterError):
    """The database was there and cannot be used now: its disk is full, or its server has gone."""


class Record(NamedTuple):
    """One event, or one snapshot of what all events up to `sequence` left; `payload` is a compressed message."""

    sequence: int  # of a robot's events, from 1
    revision: int
    session: int
    kind: str
    stamp_ns: int
    places: int
    edges: int
    regions: int
    objects: int
    schema: str
    payload: bytes


class Found(NamedTuple):
    """One answer from the index; world, metres. Places have no label."""

    kind: Indexed
    id: int
    label: str
    position_m: Point


def words_of(text: str) -> str:
    """The words of a label as they are indexed: lower case, one space between, of absurd ones the beginning."""
    return " ".join(word[:LONGEST_WORD] for word in re.findall(r"[^\W_]+", text.lower())[:MOST_WORDS])


def without_nul(text: str) -> str:
    """A text as any database holds it: PostgreSQL knows no NUL."""
    return text.replace("\0", " ")


class Storage(ABC):
    """One open database. Statements hold `?` for their arguments. Raises StoreError."""

    location: str  # for messages; never holds a password

    @abstractmethod
    def run(self, sql: str, arguments: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """The rows of one statement."""

    @abstractmethod
    def stream(self, sql: str, arguments: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
        """The rows of one statement, not all of them in memory."""

    @abstractmethod
    def run_many(self, sql: str, rows: Iterable[Sequence[Any]]) -> None:
        """One statement for each row of arguments."""

    @abstractmethod
    def transaction(self) -> AbstractContextManager[None]:
        """One atomic change; nothing of it remains when the body raises."""

    @abstractmethod
    def nearest(self, robot: int, kind: Indexed, point_m: Point, count: int) -> list[Found]:
        """Places or objects by the distance of their centres, closest first, ties by id."""

    @abstractmethod
    def overlapping(self, robot: int, kind: Indexed, min_m: Point, max_m: Point) -> list[Found]:
        """Places or objects whose boxes overlap one (touching counts), by id; a place's box is that of its sphere."""

    @abstractmethod
    def labelled(self, robot: int, kind: Indexed, text: str) -> list[Found]:
        """Regions or objects whose label has words that begin with each of these, by label and id."""

    @abstractmethod
    def checkpoint(self) -> None:
        """What the database may tidy up between deltas."""

    @abstractmethod
    def disk_bytes(self) -> int:
        """What it takes on disk."""

    def room(self) -> dict[str, float]:
        """Bytes of its file and bytes free beside it, where it is a file; asked by any thread."""
        return {}

    @abstractmethod
    def close(self) -> None:
        """Let go of it."""

    def robots(self) -> dict[str, int]:
        """Key of every robot by name; SQLite may hold anything as a text."""
        rows = self.run("SELECT name, id FROM robots ORDER BY name")
        return {name: key for name, key in rows if isinstance(name, str)}

    def robot_key(self, name: str) -> int:
        """The key of a robot, which is new when it was not known; within a transaction."""
        self.run("INSERT INTO robots (name) VALUES (?) ON CONFLICT DO NOTHING", (name,))
        key: int = self.run("SELECT id FROM robots WHERE name = ?", (name,))[0][0]
        return key

    def add(self, table: Literal["events", "snapshots"], robot: int, record: Record) -> None:
        """One more event or snapshot; within a transaction."""
        columns = ("robot", *Record._fields)
        self.run(f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({_marks(columns)})", (robot, *record))

    def snapshot(self, robot: int, revision: int) -> Record | None:
        """The last snapshot that is not beyond a revision."""
        sql = f"SELECT {', '.join(Record._fields)} FROM snapshots WHERE robot = ? AND revision <= ?"
        rows = self.run(f"{sql} ORDER BY sequence DESC LIMIT 1", (robot, revision))
        return Record(*rows[0]) if rows else None

    def events(self, robot: int, after: int, revision: int) -> Iterator[Record]:
        """The events behind `after` that are not beyond a revision, in order."""
        sql = f"SELECT {', '.join(Record._fields)} FROM events WHERE robot = ? AND sequence > ? AND revision <= ?"
        for row in self.stream(f"{sql} ORDER BY sequence", (robot, after, revision)):
            yield Record(*row)

    def revision_at(self, robot: int, revision: int, stamp_ns: int) -> int | None:
        """The newest revision that is kept and not beyond either limit."""
        where = "robot = ? AND revision BETWEEN 0 AND ? AND stamp_ns <= ?"
        newest = f"SELECT revision FROM {{}} WHERE {where} ORDER BY revision DESC LIMIT 1"
        limits = (robot, revision, stamp_ns)
        found = [self.run(newest.format(table), limits) for table in ("events", "snapshots")]
        return max((rows[0][0] for rows in found if rows), default=None)

    def revisions(self, robot: int, limit: int, before: int) -> list[StoredRevision]:
        """The newest revisions that are kept, of those below `before`, oldest first."""
        bare = f"SELECT 1 FROM events WHERE robot = ? AND revision = snapshots.revision AND {_IS_DELTA}"
        sql = (
            f"SELECT revision, session, kind, stamp_ns, {_COUNTS} FROM events"
            f" WHERE robot = ? AND revision < ? AND {_IS_DELTA} UNION ALL"
            f" SELECT revision, session, kind, stamp_ns, {_COUNTS} FROM snapshots"
            f" WHERE robot = ? AND revision BETWEEN 0 AND ? - 1 AND NOT EXISTS ({bare}) ORDER BY revision DESC LIMIT ?"
        )
        rows = self.run(sql, (robot, before, robot, before, robot, limit))
        return [StoredRevision(**dict(zip(StoredRevision.__struct_fields__, row, strict=True))) for row in rows[::-1]]

    def marks(self, robot: int) -> list[Mark]:
        """Where the snapshots stand, in order."""
        sql = f"SELECT {', '.join(Mark._fields)} FROM snapshots WHERE robot = ? ORDER BY sequence"
        return [Mark(*row) for row in self.run(sql, (robot,))]

    def thin(self, robot: int, gone: Thinned) -> None:
        """Take old history out; within a transaction."""
        self.run("DELETE FROM events WHERE robot = ? AND sequence <= ?", (robot, gone.sequence))
        self.run_many(
            "DELETE FROM snapshots WHERE robot = ? AND sequence = ?", [(robot, mark) for mark in gone.snapshots]
        )

    def put_index(self, robot: int, kind: Indexed, rows: Sequence[Sequence[Any]]) -> None:
        """Rows (number, columns of INDEX); those that say what is there already are left; within a transaction."""
        if not rows:
            return
        columns = INDEX[kind]
        old, new = (", ".join(f"{prefix}.{name}" for name in columns) for prefix in (f"{kind}s", "excluded"))
        sets = ", ".join(f"{name} = excluded.{name}" for name in columns)
        self.run_many(
            f"INSERT INTO {kind}s (robot, number, {', '.join(columns)}) VALUES ({_marks(columns)}, ?, ?)"
            f" ON CONFLICT (robot, number) DO UPDATE SET {sets} WHERE ({old}) <> ({new})",
            [(robot, *row) for row in rows],
        )

    def drop_index(self, robot: int, kind: Indexed, numbers: Iterable[int]) -> None:
        """These are gone; within a transaction."""
        gone = [(robot, number) for number in numbers]
        if gone:
            self.run_many(f"DELETE FROM {kind}s WHERE robot = ? AND number = ?", gone)

    def indexed(self, robot: int, kind: Indexed) -> set[int]:
        """The numbers that the index holds."""
        return {number for (number,) in self.run(f"SELECT number FROM {kind}s WHERE robot = ?", (robot,))}

    def put_prior(self, digest: str, told: Sequence[str], message: bytes) -> None:
        """Keep a prior; `told` are its environment, task and source."""
        row = (digest, *map(without_nul, told), message)
        with self.transaction():
            self.run("INSERT INTO priors VALUES (?, ?, ?, ?, ?) ON CONFLICT DO NOTHING", row)

    def prior(self, digest: str) -> bytes | None:
        """The message of a prior."""
        rows = self.run("SELECT message FROM priors WHERE digest = ?", (digest,))
        return bytes(rows[0][0]) if rows else None


def _marks(columns: Sequence[str]) -> str:
    return ", ".join("?" * len(columns))
