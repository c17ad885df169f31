"""Lists of answers, which know how much was left out of them."""

import warnings
from collections.abc import Iterable
from typing import TypeVar

from prior_sg.schemas.queries import MOST_LISTED

T = TypeVar("T")


class CutWarning(UserWarning):
    """There is more than was listed."""


class Listed(list[T]):
    """What was found; `total` is how much there is."""

    def __init__(self, found: Iterable[T], total: int) -> None:
        super().__init__(found)
        self.total = total

    def told(self, limit: int, callers: int) -> "Listed[T]":
        """Itself. Whoever allows as many as are listed unasked, or more, wants all there is: where that is more still,
        a CutWarning says so to who stands so many `callers` above."""
        if len(self) < self.total and limit >= MOST_LISTED:
            said = f"{len(self)} of {self.total} are listed; limit={self.total} lists all"
            warnings.warn(said, CutWarning, stacklevel=callers + 1)
        return self
