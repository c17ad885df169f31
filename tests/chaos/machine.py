"""What this machine lets us do: namespaces of our own, in which a small disk is mounted and packets are lost."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.chaos.faketime import LIBRARY

INSIDE = "CHAOS_NAMESPACE"
DISK_MB = 192


def enter(arguments: list[str]) -> None:
    """Begin again in a network and a mount namespace of our own, where this is allowed; else return."""
    if INSIDE in os.environ:
        return
    own = ["unshare", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
    own += [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        subprocess.run([*own, "true"], check=True, capture_output=True)
        os.environ[INSIDE] = "1"
        os.execvp(own[0], [*own, sys.executable, "-m", "tests.chaos", *arguments])


def means() -> set[str]:
    """What faults may need and is there: `netem`, `mount`, `faketime`."""
    found = {"faketime"} if LIBRARY else set()
    if INSIDE in os.environ:
        subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
        found |= {"mount"}
        emulating = ["tc", "qdisc", "add", "dev", "lo", "root", "netem", "delay", "1ms"]
        with contextlib.suppress(OSError):
            if subprocess.run(emulating, capture_output=True, check=False).returncode == 0:
                subprocess.run(["tc", "qdisc", "del", "dev", "lo", "root"], check=True)
                found.add("netem")
    return found


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A disk of DISK_MB in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "chaos", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
