"""Reports of services that died by a fault of theirs: files in one folder, of which the newest are kept.

An exception leaves a JSON file. A signal such as a segmentation fault leaves what Python's faulthandler writes: where
each thread was.
"""

import contextlib
import faulthandler
import json
import os
import platform
import re
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import msgspec
import psutil

from prior_sg.schemas.status import Passage
from prior_sg.services.runtime.service import Identity

MOST_REPORTS = 20
MOST_CHARACTERS = 65_536  # of a traceback
LAST_INPUTS = 32
RECENT_S = 86_400.0  # reports that are still told
SUFFIX, SIGNAL_SUFFIX = ".json", ".fault"
PACKAGES = ("prior-sg", "eclipse-zenoh", "msgspec", "numpy", "numba", "scipy", "torch", "onnxruntime")
SECRET = re.compile(r"token|secret|password|passphrase|credential|api_?key", re.IGNORECASE)
LOGIN = re.compile(r"(?<=://)[^/@\s]+@")
HIDDEN = "(hidden)"


class Crash(NamedTuple):
    """One report: whose it is, when it was written, what it says in a line, and its file."""

    instance: str
    at_s: float  # since 1970
    error: str
    path: str


@contextlib.contextmanager
def watched(folder: str, instance: str) -> Iterator[None]:
    """Threads that a fatal signal interrupts within are written down in the folder; "" = nowhere."""
    if not folder:
        yield
        return
    path = Path(folder) / f"{instance}.{os.getpid()}{SIGNAL_SUFFIX}"
    try:
        _forget(_made(path).parent)
        file: TextIO = path.open("w")
    except OSError:  # a disk that is full keeps no service from starting
        yield
        return
    with file:
        faulthandler.enable(file)
        try:
            yield
        finally:
            faulthandler.disable()
    path.unlink(missing_ok=True)


def report(  # noqa: PLR0917
    folder: str, service: str, identity: Identity, error: BaseException, cfg: Any, inputs: Sequence[Passage]
) -> str:
    """Write a report; returns its path, "" where there is no folder or it cannot be written."""
    if not folder:
        return ""
    text = "".join(traceback.format_exception(error))
    told = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "service": service,
        "instance": identity.instance,
        "robot": identity.robot,
        "pid": os.getpid(),
        "error": _line(error),
        "traceback": text[-MOST_CHARACTERS:],
        "versions": versions(),
        "config": without_secrets(msgspec.to_builtins(cfg)),
        "last_inputs": [msgspec.to_builtins(one) for one in inputs],
    }
    path = Path(folder) / f"{identity.instance}{SUFFIX}"
    try:
        _made(path).write_text(json.dumps(without_logins(told), indent=1, default=str))
    except OSError:  # the log says the rest
        return ""
    _forget(path.parent)
    return str(path)


def crashes(folder: Path, now_s: float) -> list[Crash]:
    """Reports of the last day, newest first."""
    found = []
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
                if (one := _read(path)) is not None and now_s - one.at_s < RECENT_S:
                    found.append(one)
    return sorted(found, key=lambda one: -one.at_s)


def sentence(crash: Crash, now_s: float) -> str:
    """What a person is told of it."""
    ago_s = max(now_s - crash.at_s, 0.0)
    ago = f"{ago_s:.0f} s" if ago_s < 120 else f"{ago_s / 60:.0f} min"
    return f"{crash.instance} died {ago} ago: {crash.error} (report: {crash.path})"


def versions() -> dict[str, str]:
    """Of Python, the system and the packages that matter, where they are installed."""
    found = {"python": sys.version.split()[0], "system": platform.platform()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def without_secrets(value: Any) -> Any:
    """The same, but for the values of fields whose names speak of secrets."""
    if isinstance(value, dict):
        return {
            name: HIDDEN if SECRET.search(str(name)) and held and isinstance(held, str) else without_secrets(held)
            for name, held in value.items()
        }
    return [without_secrets(one) for one in value] if isinstance(value, list) else value


def without_logins(value: Any) -> Any:
    """The same, but for names and passwords in addresses."""
    if isinstance(value, dict):
        return {name: without_logins(held) for name, held in value.items()}
    if isinstance(value, list):
        return [without_logins(one) for one in value]
    return LOGIN.sub("", value) if isinstance(value, str) else value


def _line(error: BaseException) -> str:
    return (traceback.format_exception_only(error)[-1].strip() or type(error).__name__)[:300]


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _forget(folder: Path) -> None:
    """Drop the oldest reports, and what processes that were killed have left empty."""
    kept = []
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process tidies up as well
            about = path.stat()
            if path.suffix == SUFFIX or (path.suffix == SIGNAL_SUFFIX and about.st_size):
                kept.append((about.st_mtime, path))
            elif path.suffix == SIGNAL_SUFFIX and not psutil.pid_exists(int(path.stem.rpartition(".")[2])):
                path.unlink()
    for _, path in sorted(kept)[: max(len(kept) - MOST_REPORTS, 0)]:
        path.unlink(missing_ok=True)


def _read(path: Path) -> Crash | None:
    """What a file tells; None of an empty one, whose process runs or was ended from outside."""
    at_s = path.stat().st_mtime
    if path.suffix == SUFFIX:
        told = json.loads(path.read_text(errors="replace"))
        return Crash(str(told["instance"]), at_s, str(told["error"]), str(path))
    if path.suffix == SIGNAL_SUFFIX and (lines := path.read_text(errors="replace").splitlines()):
        return Crash(path.stem.rpartition(".")[0], at_s, lines[0], str(path))
    return None
