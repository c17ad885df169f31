"""Standard output and error of a process, without what draws tables (`deploy/terminal.py`): a service has no use for
that, and it takes 2 MB.
"""

import io
import os
import sys

from prior_sg.schemas.names import shown


def complain(text: str) -> None:
    """One sentence on standard error."""
    print(shown(f"prior-sg: {text}"), file=sys.stderr)


def forgive() -> None:
    """What the terminal's encoding lacks is printed as `?`."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def keep_apart() -> None:
    """What libraries write past Python, as Zenoh does its errors, goes to standard error from now on, so that nothing
    but results is on standard output. Where `sys.stdout` is something else than the process's, nothing changes."""
    stream, errors = sys.stdout, sys.__stderr__
    if not isinstance(stream, io.TextIOWrapper) or stream is not sys.__stdout__ or errors is None:
        return
    stream.flush()
    file = os.fdopen(os.dup(stream.fileno()), "wb", 0 if isinstance(stream.buffer, io.RawIOBase) else -1)
    os.dup2(errors.fileno(), stream.fileno())
    sys.stdout = io.TextIOWrapper(
        file, stream.encoding, stream.errors, line_buffering=stream.line_buffering, write_through=stream.write_through
    )


def settle() -> None:
    """What was printed is on standard output. Raises OSError where it cannot be there."""
    if sys.stdout is not None:
        sys.stdout.flush()


def give_up() -> None:
    """What cannot be on standard output any more, for its reader or the disk's room has gone, is nobody's: Python would
    complain of it at its end."""
    try:
        settle()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
