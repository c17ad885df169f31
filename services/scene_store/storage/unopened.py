"""Whether a store could use its database, found out without a change to it and without waiting for others."""

import fcntl
import os
import sqlite3
import struct
import sys
import time
from pathlib import Path
from urllib.parse import quote

from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.storage import is_url, open_storage
from prior_sg.services.scene_store.storage.sqlite import check_whole, content, unusable
from prior_sg.services.scene_store.storage.tables import StoreError

FLOCK = struct.Struct("@hhqqi4x")  # of Linux: kind, whence, first, length, process
LOCKS = {  # which bytes SQLite locks: (first, length) by what is added to the name of the file
    "": (0x40000002, 510),  # a connection that lets no other one in; all others only share them
    "-shm": (120, 1),  # a transaction that writes, in WAL mode
}
LOOKS, PAUSE_S = 5, 0.1  # a store's own transactions take far less


def check_storage(cfg: Config) -> None:
    """Raises StoreError, ExtraMissing; a SQLite file that is not there yet is none of a fault."""
    if is_url(cfg.path):
        open_storage(cfg, read_only=True).close()
    elif Path(cfg.path).exists():
        for suffix, place in LOCKS.items():
            if pid := _stuck(Path(cfg.path + suffix), place):
                raise StoreError(
                    f"{cfg.path} is locked all the time by the process {pid}; wait for its end, or `kill {pid}`"
                )
        _check_file(cfg.path)


def _check_file(path: str) -> None:
    """Without a log that belongs to it, the file alone is read; with one, SQLite's index of it stays untouched. Where
    that index is not there, only a store may make it: until then nobody knows whether file and log are whole.
    """
    logged, indexed = (Path(path + suffix).exists() for suffix in ("-wal", "-shm"))
    options = "mode=ro&readonly_shm=1" if logged and indexed else "immutable=1"
    try:
        connection = sqlite3.connect(f"file:{quote(path)}?{options}", uri=True, timeout=LOOKS * PAUSE_S)
        try:
            content(connection)
            if indexed or not logged:
                check_whole(connection)
        finally:
            connection.close()
    except (sqlite3.Error, OSError) as error:
        raise unusable(path, error) from error


def _stuck(file: Path, place: tuple[int, int]) -> int:
    """The process that has held a lock at every look; 0 = none."""
    if sys.platform != "linux" or not file.is_file():
        return 0
    holders = set()
    for look in range(LOOKS):
        time.sleep(PAUSE_S if look else 0.0)
        holders.add(_holder(file, place))
        if len(holders) > 1 or 0 in holders:
            return 0
    return holders.pop()


def _holder(file: Path, place: tuple[int, int]) -> int:
    """Another process with a lock there for itself alone; 0 = none, also where the file cannot be read."""
    try:
        opened = os.open(file, os.O_RDONLY)
    except OSError:
        return 0
    try:
        asked = FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, *place, 0)
        kind, _, _, _, pid = FLOCK.unpack(fcntl.fcntl(opened, fcntl.F_GETLK, asked))
        return 0 if kind == fcntl.F_UNLCK else pid
    finally:
        os.close(opened)
