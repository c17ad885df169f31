"""Buildings with corridors: a hall of open zones at the front, then rooms on both sides of a corridor, at times with a
second corridor across."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from prior_sg.deploy.evaluation.worlds.layouts import between, connect, meet, row
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan, Room, rounded


class Wing(NamedTuple):
    """What lies along a corridor."""

    south: Sequence[str]
    north: Sequence[str]
    widths_m: dict[str, float]  # usual width of rooms by label; others the usual one
    usual_m: float
    depth_m: tuple[float, float]  # of rooms, from and to
    corridor_m: tuple[float, float]
    open_labels: frozenset[str] = frozenset()  # rooms without a wall to the corridor
    ensuite: frozenset[str] = frozenset()  # rooms with their own bathroom

    def sized(self, labels: Sequence[str]) -> list[tuple[str, float]]:
        """Labels with their widths."""
        return [(label, self.widths_m.get(label, self.usual_m)) for label in labels]

    def length_m(self, labels: Sequence[str]) -> float:
        """Of a corridor with these rooms on one side."""
        return rounded(sum(width for _, width in self.sized(labels)), 0.1)


def front_and_wing(plan: Plan, front: Sequence[str], wing: Wing, level: Level) -> tuple[Room, Rect]:
    """Two or three open zones over the whole depth of the building, and a wing behind them; returns its corridor and
    the shell."""
    rng = plan.rng
    south, way, north = (between(rng, *wing.depth_m), between(rng, *wing.corridor_m), between(rng, *wing.depth_m))
    length = max(wing.length_m(wing.south), wing.length_m(wing.north))
    shell = Rect(0, 0, between(rng, 6.5, 9.5) + length, south + way + north)
    plan.storey(shell, level)
    hall, behind = shell.cut_x([shell.width - length, length])
    corridor = _along(plan, behind.cut_y([south, way, north]), wing, level)
    borders = [south + way * float(rng.random() < 0.5)] if len(front) == 2 else [south, south + way]
    cuts = [b - a for a, b in itertools.pairwise([0.0, *borders, shell.depth])]
    zones = [plan.room(label, piece, level, walled=False) for label, piece in zip(front, hall.cut_y(cuts), strict=True)]
    meet(plan, [*zones, corridor])
    return corridor, shell


def crossing(plan: Plan, corridor: Room, wing: Wing, level: Level) -> Rect:
    """A corridor across the far end of another, with rooms beyond it; returns the shell."""
    rng, first = plan.rng, corridor.bounds
    way, depth, length = between(rng, *wing.corridor_m), between(rng, *wing.depth_m), wing.length_m(wing.south)
    south = rounded(first.y0 - rng.uniform(0.2, 0.8) * (length - first.depth), 0.1)
    shell = Rect(first.x1, south, first.x1 + way + depth, south + length)
    plan.storey(shell, level)
    along, behind = shell.cut_x([way, depth])
    second = plan.room("corridor", along, level, walled=False)
    rooms = row(plan, behind, wing.sized(wing.south), level, wing.open_labels)
    plan.hollow(Rect(first.x1 - 0.2, first.y0, first.x1 + 0.2, first.y1), level)
    connect(plan, second, rooms)
    plan.join(corridor, second)
    return shell


def _along(plan: Plan, strips: Sequence[Rect], wing: Wing, level: Level) -> Room:
    south, way, north = strips
    corridor = plan.room("corridor", way, level, walled=False)
    for rect, labels in ((south, wing.south), (north, wing.north)):
        rooms = row(plan, rect, wing.sized(labels), level, wing.open_labels)
        baths = [(_bathroom(plan, room, corridor, level), room) for room in rooms if room.label in wing.ensuite]
        connect(plan, corridor, rooms)
        for bath, room in baths:
            plan.door(bath, room, 0.8)
    return corridor


def _bathroom(plan: Plan, room: Room, corridor: Room, level: Level) -> Room:
    """Taken from a room beside the corridor, so that one passes it on the way in."""
    width, depth = between(plan.rng, 1.7, 2.0), between(plan.rng, 1.9, 2.3)
    (rect,) = room.rects
    cuts = [width, rect.width - width] if plan.rng.random() < 0.5 else [rect.width - width, width]
    below = corridor.bounds.y0 >= rect.y1 - 1e-6
    halves = rect.cut_y([rect.depth - depth, depth] if below else [depth, rect.depth - depth])
    main, near = halves if below else halves[::-1]
    pieces = near.cut_x(cuts)
    bath, passage = pieces if cuts[0] == width else pieces[::-1]
    room.rects = (main, passage)
    return plan.room("bathroom", bath, level)
