"""The one way to the terminal: outside text is text.

Names, tasks, paths and notes come from users, models, files and other robots. None of them is read as markup, and none
can move the cursor, colour or turn what others read. Styles are given beside the text (`line`), never inside it.
"""

from typing import Any

from rich.console import Console
from rich.progress import Task, TextColumn
from rich.status import Status
from rich.table import Table as PlainTable
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


class Table(PlainTable):
    """A table in which nothing is cut off: a word wider than its column goes on below."""

    def add_column(self, *heading: Any, no_wrap: bool = False, **options: Any) -> None:
        """As rich's; what may not be wrapped shows where it had to be cut."""
        super().add_column(*heading, no_wrap=no_wrap, **({"overflow": "ellipsis" if no_wrap else "fold"} | options))


def line(*parts: Part) -> Text:
    """One line of text, parts of it in a style."""
    return Text.assemble(*(_plain(part) if isinstance(part, str) else (shown(part[0]), part[1]) for part in parts))


def _plain(text: Any) -> Any:
    return Text(shown(text)) if isinstance(text, str) else text
