"""Log files of child processes, which write to them until they end: what is full is put aside once."""

import os
import shutil
from pathlib import Path

MOST_LOG_BYTES = 16 * 2**20  # of one process; as much again is put aside
ASIDE = ".1"  # behind the name


def bound(log_path: Path, most_bytes: int = MOST_LOG_BYTES) -> bool:
    """Put what a log holds aside, over what was put aside before, where it is larger; whether it was.

    Its writer has it open to append, and so goes on at the beginning. A line written meanwhile can be lost. A disk that
    is full or was taken away is no reason to fail.
    """
    try:
        if log_path.stat().st_size <= most_bytes:
            return False
        shutil.copyfile(log_path, log_path.with_name(log_path.name + ASIDE))
        os.truncate(log_path, 0)
    except OSError:
        return False
    return True
