"""Clocks that jump, by Debian's libfaketime where it is installed."""

from pathlib import Path

PLACES = ("/usr/lib/{}-linux-gnu/faketime/libfaketimeMT.so.1", "/usr/lib/{}-linux-gnu/faketime/libfaketime.so.1")
LIBRARY = next(
    (path for machine in ("x86_64", "aarch64") for place in PLACES if Path(path := place.format(machine)).exists()), ""
)


def set_clock(file: Path, off_s: float) -> None:
    """Let the processes that follow a file see a clock that is off by so many seconds."""
    partial = file.with_suffix(".partial")
    partial.write_text(f"{off_s:+.0f}")
    partial.replace(file)
