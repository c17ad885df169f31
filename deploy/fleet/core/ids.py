"""Numbers of the fleet that never change: one for each place, object and keyframe of each robot's session (pure).

What several robots have made of one thing bears the number of whoever told of it first; when a corrected frame takes
them apart again, each goes on under its own.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

Kind = Literal["place", "object", "frame"]
KINDS: tuple[Kind, ...] = ("place", "object", "frame")


class Name(NamedTuple):
    """Whose number: a robot, and which life of its map (the epoch of its first writer, or of a stored scene)."""

    robot: str
    session: int


@dataclass
class Ids:
    """All numbers given so far; only ever grows."""

    given: dict[Kind, dict[tuple[Name, int], int]] = field(default_factory=lambda: {kind: {} for kind in KINDS})
    following: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))

    def of(self, kind: Kind, name: Name, numbers: Iterable[int]) -> np.ndarray:
        """The fleet's numbers (n,) of a robot's, in their order; new ones are given out."""
        known = self.given[kind]
        found = []
        for number in numbers:
            key = name, int(number)
            if key not in known:
                known[key] = self.following[kind]
                self.following[kind] += 1
            found.append(known[key])
        return np.array(found, np.int64)

    def adopt(self, kind: Kind, name: Name, number: int, into: int) -> None:
        """A robot's number is from now on this one of the fleet's, which it was before in another session."""
        self.given[kind][name, number] = into
        self.following[kind] = max(self.following[kind], into + 1)
