"""The one way to the terminal: outside text is text.

Names, tasks, paths and notes come from users, models, files and other robots. None of them is read as markup, and none
can move the cursor, colour or turn what others read. Styles are given beside the text (`line`), never inside it.
"""

import io
import os
import sys
from typing import Any

from rich.console import Console
from rich.progress import Task, TextColumn
from rich.status import Status
from rich.text import Text

from prior_sg.schemas.names import shown

Part = str | tuple[str, str]  # text, or text and its style


class Terminal(Console):
    """Prints strings as they are, but for what a terminal would obey."""

    def __init__(self, *, stderr: bool = False, **options: Any) -> None:
        super().__init__(stderr=stderr, highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Every string on its way out comes through here: printed, in a cell, as a title."""
        return super().render_str(shown(text), **(options | {"markup": False, "emoji": False}))

    def status(self, status: Any, **options: Any) -> Status:
        """A spinner with a text; `update` takes text as well."""
        return PlainStatus(_plain(status), console=self, **options)


class PlainStatus(Status):
    """A spinner whose text is text."""

    def update(self, status: Any = None, **options: Any) -> None:
        """Change the text."""
        super().update(None if status is None else _plain(status), **options)


class Description(TextColumn):
    """The description of a task of a progress bar, as text."""

    def __init__(self) -> None:
        super().__init__("{task.description}", markup=False)

    def render(self, task: Task) -> Text:
        """The text of one row."""
        return Text(shown(task.description))


def line(*parts: Part) -> Text:
    """One line of text, parts of it in a style."""
    return Text.assemble(*(_plain(part) if isinstance(part, str) else (shown(part[0]), part[1]) for part in parts))


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


def _plain(text: Any) -> Any:
    return Text(shown(text)) if isinstance(text, str) else text
