"""Folders of the user's, and what there is in place of them where no home can be written."""

import os
import stat
import tempfile
from pathlib import Path


def expanded(path: str) -> Path:
    """The path with the home for a leading `~`; as it is where no home is known (an unnamed user of a container)."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def user_cache() -> Path:
    """Where a user's programs keep what they can make again; it need not exist, nor be one that can be written."""
    return Path(os.environ.get("XDG_CACHE_HOME") or expanded("~/.cache")) / "prior-sg"


def user_settings() -> Path:
    """Where what a user has set up for this program lies; it need not exist."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or expanded("~/.config")) / "prior-sg"


def temporary_cache(name: str) -> Path:
    """A folder of this user's alone below the temporary folder, the same for every process. Raises OSError."""
    folder = _private(Path(tempfile.gettempdir()) / f"prior-sg-{os.getuid()}") / name
    folder.mkdir(exist_ok=True)
    return folder


def _private(path: Path) -> Path:
    """The folder, created where it is not there; a new one when somebody else could have put something into it."""
    path.mkdir(mode=0o700, exist_ok=True)
    found = path.lstat()
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return path if ours and os.access(path, os.W_OK) else Path(tempfile.mkdtemp(prefix="prior-sg-"))
