"""Which service processes this user has on this host, or in this container: each leaves a note while it runs.

So `prior-sg health --here` needs no name: what checks a container knows none.
"""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

import psutil

from prior_sg.services.folders import temporary_cache

log = logging.getLogger(__name__)
FOLDER = "running"
CLOCK_S = 2.0  # by which a file may seem older than the process that wrote it


@contextlib.contextmanager
def noted(instance: str) -> Iterator[None]:
    """This process is found here under its name on the bus for as long as the body takes."""
    try:
        path = temporary_cache(FOLDER) / instance
        path.write_text(str(psutil.Process().pid))
    except OSError as error:
        log.warning("`prior-sg health --here` will not find this process: %s", error)
        yield
        return
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def processes_here() -> dict[str, int]:
    """Process ids by instance. Notes of processes that were killed are removed."""
    try:
        notes = sorted(temporary_cache(FOLDER).iterdir())
    except OSError:
        return {}
    found = {}
    for note in notes:
        pid = _writer_of(note)
        if pid:
            found[note.name] = pid
        else:
            note.unlink(missing_ok=True)
    return found


def _writer_of(note: Path) -> int:
    """The process that wrote the note; 0 where it is gone, also if another has its number now."""
    try:
        pid, written_s = int(note.read_text() or 0), note.stat().st_mtime
        return pid if pid and psutil.Process(pid).create_time() <= written_s + CLOCK_S else 0
    except (OSError, ValueError, psutil.Error):
        return 0
