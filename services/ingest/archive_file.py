"""The archive of keyframes on disk, and how far the source was read: what a process that was killed leaves to the next.

One SQLite file in WAL mode: what is committed survives a killed process, a torn tail is cut off. It holds what the
archive in memory holds, so the same setting bounds it; the space of what was dropped is used again.
"""

import contextlib
import logging
import sqlite3
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from hashlib import sha256
from pathlib import Path

import msgspec

from prior_sg.schemas.codec import DecodeError, decode, encode, schema_name
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.migrations import current
from prior_sg.services.ingest.core.checkpoint import Checkpoint, Kept, NotKeptError
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.options import is_live

log = logging.getLogger(__name__)
APPLICATION_ID = 0x70736761  # "psga", in the header of the file
LAYOUT_VERSION = 1
THIS_PROCESS = uuid.uuid4().hex
LOCKED_S = 5.0  # for which a writer that was stopped in the middle is waited for
ASIDE = ".before"  # ending of an archive that was not gone on with; there is one at a time
SETTINGS = "settings"
LIVE_GAP_S = 600.0  # after which a robot's poses may be in another world, so that its keyframes are not gone on with
WITHOUT_EFFECT = ("speed", "when_behind", "window", "archive_mb", "archive_path")  # on what the keyframes are
LAYOUT = f"""
CREATE TABLE about (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE keyframes (
    frame_id INTEGER PRIMARY KEY, owed INTEGER NOT NULL, schema TEXT NOT NULL, payload BLOB NOT NULL);
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {LAYOUT_VERSION};
"""


class ForeignError(Exception):
    """The file cannot be gone on with; the text says why."""


class ArchiveFile:
    """One open file of one robot and source. Opening raises NotKeptError and ForeignError."""

    def __init__(self, path: Path, origin: dict[str, str]) -> None:
        self._path, self._origin = path, origin
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._sql = sqlite3.connect(path, check_same_thread=False, timeout=LOCKED_S)
        except (sqlite3.Error, OSError) as error:
            raise NotKeptError(str(error)) from error
        try:
            self._open()
        except sqlite3.DatabaseError as error:
            self.close()
            kind = NotKeptError if isinstance(error, sqlite3.OperationalError) else ForeignError
            raise kind(f"it cannot be read ({error})") from error
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        run = self._sql.execute
        empty = not run("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if not empty and run("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
            raise NotKeptError("it is a file of another program")
        run("PRAGMA journal_mode = WAL")
        run("PRAGMA synchronous = NORMAL")  # safe from killed processes; a power cut may cost the newest
        if empty:
            self._sql.executescript(f"BEGIN IMMEDIATE; {LAYOUT} COMMIT;")
            self.begin()
            return
        if run("PRAGMA user_version").fetchone()[0] != LAYOUT_VERSION:
            raise ForeignError("it is of another version of this program")
        for name, value in self._origin.items():
            if (found := self._about(name)) != value.encode():
                raise ForeignError(_differs(name, "" if found is None else found.decode(errors="replace")))
        with self._writing() as sql:
            _put(sql, "opened", THIS_PROCESS.encode())

    def kept(self) -> Kept | None:
        """What was left; None when there is no keyframe. Raises ForeignError when it is damaged."""
        try:
            checkpoint = self._about("checkpoint")
            if checkpoint is None:
                return None
            rows = self._sql.execute("SELECT payload, schema, owed FROM keyframes ORDER BY frame_id")
            keyframes: list[Keyframe] = []
            owed: set[int] = set()
            for payload, schema, is_owed in rows:
                keyframes.append(decode(Keyframe, current(Keyframe, payload, schema)))
                if is_owed:
                    owed.add(keyframes[-1].frame_id)
            return Kept(decode(Checkpoint, checkpoint), keyframes, owed)
        except (sqlite3.Error, DecodeError, TypeError) as error:
            raise ForeignError(f"it is damaged ({error})") from error

    def keep(self, keyframe: Keyframe, oldest_frame_id: int, checkpoint: Checkpoint) -> None:
        with self._writing() as sql:
            row = (keyframe.frame_id, bool(keyframe.color), schema_name(Keyframe), encode(keyframe))
            sql.execute("INSERT OR REPLACE INTO keyframes VALUES (?, ?, ?, ?)", row)
            sql.execute("DELETE FROM keyframes WHERE frame_id < ? OR ? < 0", (oldest_frame_id, oldest_frame_id))
            _put(sql, "checkpoint", encode(checkpoint))

    def ended(self, frame_id: int, checkpoint: Checkpoint) -> None:
        with self._writing() as sql:
            sql.execute("UPDATE keyframes SET owed = 0 WHERE frame_id = ?", (frame_id,))
            _put(sql, "checkpoint", encode(checkpoint))

    def correct(self, keyframes: Sequence[Keyframe]) -> None:
        rows = ((schema_name(Keyframe), encode(keyframe), keyframe.frame_id) for keyframe in keyframes)
        with self._writing() as sql:
            sql.executemany("UPDATE keyframes SET schema = ?, payload = ? WHERE frame_id = ?", rows)

    def mark(self, checkpoint: Checkpoint) -> None:
        with self._writing() as sql:
            _put(sql, "checkpoint", encode(checkpoint))

    def begin(self) -> None:
        with self._writing() as sql:
            sql.execute("DELETE FROM keyframes")
            sql.execute("DELETE FROM about")
            for name, value in (*self._origin.items(), ("opened", THIS_PROCESS)):
                _put(sql, name, value.encode())

    def close(self) -> None:
        self._sql.close()

    def _about(self, name: str) -> bytes | None:
        row = self._sql.execute("SELECT value FROM about WHERE name = ?", (name,)).fetchone()
        return None if row is None else row[0] if isinstance(row[0], bytes) else b""

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction. After a failure the file would be behind the stream: it is removed, and nothing kept."""
        try:
            with self._sql:
                yield self._sql
        except sqlite3.Error as error:
            self.close()
            _each(self._path, lambda name: Path(name).unlink())
            raise NotKeptError(str(error)) from error


def _differs(name: str, found: str) -> str:
    return "it was read with other settings" if name == SETTINGS else f"its {name} is {found}"


def _put(sql: sqlite3.Connection, name: str, value: bytes) -> None:
    sql.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (name, value))


def _each(path: Path, does: Callable[[str], object]) -> None:
    """Do something with the file and what SQLite keeps beside it, as far as that is possible."""
    for ending in ("", "-wal", "-shm"):
        with contextlib.suppress(OSError):
            does(f"{path}{ending}")


def origin_of(cfg: Config, robot: str) -> dict[str, str]:
    """What an archive is of: a robot, a source, and how that is read."""
    source = cfg.source if is_live(cfg.source) else str(Path(cfg.source).resolve())
    settings = {k: v for k, v in msgspec.to_builtins(cfg).items() if k not in (*WITHOUT_EFFECT, "source")}
    digest = sha256(msgspec.json.encode(settings)).hexdigest()
    return {"robot": robot, "source": source, SETTINGS: digest}


def opened(cfg: Config, robot: str, clock_s: Callable[[], float]) -> tuple[ArchiveFile | None, Kept | None]:
    """The archive that the settings name and what was left in it. Where it cannot be gone on with, that is said once,
    the file is put aside, and a new one begins.
    """
    if not (cfg.archive_path and cfg.source and cfg.archive_mb > 0):
        return None, None
    path, origin = Path(cfg.archive_path), origin_of(cfg, robot)
    try:
        try:
            return _gone_on_with(path, origin, clock_s if is_live(cfg.source) else None)
        except ForeignError as error:
            _each(path, lambda name: Path(name).replace(f"{path}{ASIDE}{name.removeprefix(str(path))}"))
            log.warning(f"what {path} kept is not gone on with: {error}; it is now {path}{ASIDE}, a new one begins")
            return ArchiveFile(path, origin), None
    except (NotKeptError, ForeignError) as error:
        log.warning(f"no keyframes are kept in {path}: {error}; an ingest that dies will read its source again")
        return None, None


def _gone_on_with(
    path: Path, origin: dict[str, str], clock_s: Callable[[], float] | None
) -> tuple[ArchiveFile, Kept | None]:
    """An archive and what was left in it, that of a robot if it is recent. Raises NotKeptError, ForeignError."""
    age_s = _age_s(path, clock_s) if clock_s is not None else 0.0
    file = ArchiveFile(path, origin)
    try:
        kept = file.kept()
        if kept is not None and not 0 <= age_s <= LIVE_GAP_S:
            raise ForeignError(f"it is {age_s:.0f} s old, and the robot's poses may be in another world by now")
    except ForeignError:
        file.close()
        raise
    return file, kept


def left_off(cfg: Config) -> Checkpoint | None:
    """Where the process before left off, of an archive that `opened` has found good in this process."""
    if not cfg.archive_path or not Path(cfg.archive_path).exists():
        return None
    with contextlib.suppress(sqlite3.Error, DecodeError), closing(sqlite3.connect(cfg.archive_path)) as sql:
        found = dict(sql.execute("SELECT name, value FROM about WHERE name IN ('checkpoint', 'opened')"))
        if found.get("opened") == THIS_PROCESS.encode() and "checkpoint" in found:
            return decode(Checkpoint, found["checkpoint"])
    return None


def _age_s(path: Path, clock_s: Callable[[], float]) -> float:
    """Since it was last written; 0 where it does not exist."""
    stamps_s = [Path(f"{path}{ending}").stat().st_mtime for ending in ("", "-wal") if Path(f"{path}{ending}").exists()]
    return clock_s() - max(stamps_s, default=clock_s())
