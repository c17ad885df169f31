"""Numbers of the fleet that never change: one for each place, object and keyframe of each robot's session (pure).

What several robots have made of one thing bears the number of whoever told of it first; when a corrected frame takes
them apart again, each goes on under its own.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

Kind = Literal["place", "object", "frame"]
KINDS: tuple[Kind, ...] = ("place", "object", "frame")
SPOTS = 64  # places of a session by which it is known again, at most
SAME_SPOT_M, SAME_SHARE = 0.2, 0.5  # it is known again where so many of them are within that distance


class Name(NamedTuple):
    """Whose number: a robot, and which life of its map, see `Sessions`."""

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


@dataclass
class Session:
    """By what a life of a map is known again."""

    epochs: set[int] = field(default_factory=set)  # of those who wrote its places
    spots_m: dict[int, tuple[float, float, float]] = field(default_factory=dict)  # of some places, by id, own frame


@dataclass
class Sessions:
    """Which life of each robot's map bears which number; only grows.

    A number is never another life's, so that (robot, session, id) says the same for ever. What cannot be known again
    gets a new one, the highest of its robot.
    """

    known: dict[Name, Session] = field(default_factory=dict)
    followed: set[Name] = field(default_factory=set)  # by this process: no second map is one of these

    def name_of(self, robot: str, places: Mapping[int, Sequence[float]], epoch: int | None = None) -> Name:
        """The session of a map that this process has not followed yet, by its writer's epoch or where its places are
        (by id, metres, own frame); a stored map has no writer."""
        waiting = sorted((name for name in self.known if name.robot == robot), reverse=True)
        waiting = [name for name in waiting if name not in self.followed]
        written = [name for name in waiting if epoch in self.known[name].epochs]
        found = next(iter(written or [name for name in waiting if _same(self.known[name], places)]), None)
        name = self.following(robot) if found is None else found
        self.note(name, epoch)
        self.followed.add(name)
        return name

    def following(self, robot: str) -> Name:
        """The number that the next session of a robot gets."""
        return Name(robot, max((name.session + 1 for name in self.known if name.robot == robot), default=0))

    def begin(self, robot: str, epoch: int) -> Name:
        """A new session."""
        name = self.following(robot)
        self.note(name, epoch)
        self.followed.add(name)
        return name

    def note(self, name: Name, epoch: int | None = None) -> None:
        """A session is there, and has this writer."""
        epochs = self.known.setdefault(name, Session()).epochs
        if epoch is not None:
            epochs.add(epoch)

    def remember(self, name: Name, places: Mapping[int, Sequence[float]]) -> None:
        """Where places of a session are now, by id."""
        ids = sorted(places)
        chosen = ids[:: -(-len(ids) // SPOTS) or 1]
        self.known[name].spots_m = {number: _point(places[number]) for number in chosen}


def _point(spot_m: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in spot_m)
    return x, y, z


def _same(session: Session, places: Mapping[int, Sequence[float]]) -> bool:
    """Whether a map's places are those of a session."""
    there = [
        float(np.linalg.norm(np.subtract(places[number], spot_m))) < SAME_SPOT_M
        for number, spot_m in session.spots_m.items()
        if number in places
    ]
    return sum(there) > SAME_SHARE * len(session.spots_m)
