"""A floor plan while it is built: regions, boxes of matter, furniture; metres, z up, x and y along the walls.

Boxes count in the order in which they were added: a doorway is a box of nothing in a wall that was there before. All
edges lie on a grid of STEP_M; those of rooms on one of 2 STEP_M, so that walls, which stand half on each side of the
edge, do as well.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from prior_sg.deploy.evaluation.worlds.outline import Rect, Segment, outline, shared_edges
from prior_sg.deploy.truth import TrueNode, TrueObject, TrueRegion
from prior_sg.schemas.levels import LEVELS, LevelName

STEP_M = 0.05
WALL_M = 0.1
SLAB_M = 0.2
BODY_M = 0.45  # nothing may come nearer to the way between two doors of a room
DOOR_HEIGHT_M = 2.05
DOOR_SPACE_M = 0.9  # on both sides of a door, kept free of furniture

NOTHING, STRUCTURE, GLASS, FURNITURE = range(4)  # what a box, and later a voxel, is made of


class Unbuildable(Exception):
    """This draw of random numbers makes no plan: two rooms that should be joined share no wall that takes a door."""


class Box(NamedTuple):
    """An axis-aligned box, metres, of one matter."""

    min_m: tuple[float, float, float]
    max_m: tuple[float, float, float]
    matter: int


class Level(NamedTuple):
    """A storey: where its floor is, and how high it is to the ceiling, metres."""

    z_m: float
    height_m: float


@dataclass
class Room:
    """One region: rectangles on one level, with walls around them or without."""

    label: str
    rects: tuple[Rect, ...]
    z_m: float
    height_m: float
    walled: bool
    top_m: float  # the region ends here; above z_m + height_m for stairs
    portals: list[tuple[float, float]] = field(default_factory=list)  # where one comes in; they stay joined
    kept_free: list[Rect] = field(default_factory=list)
    taken: list[Rect] = field(default_factory=list)  # footprints of what stands on the floor
    within: dict[LevelName, tuple[str, int]] = field(default_factory=dict)  # label and number of the nodes above

    @property
    def area_m2(self) -> float:
        """Floor area."""
        return sum(rect.area for rect in self.rects)

    @property
    def bounds(self) -> Rect:
        """The rectangle around it."""
        x0, y0, x1, y1 = zip(*self.rects, strict=True)
        return Rect(min(x0), min(y0), max(x1), max(y1))


@dataclass
class Plan:
    """Everything that a world is made of."""

    rng: np.random.Generator
    environment: str  # plain words, for the prior
    voxel_m: float = STEP_M
    range_m: float = 10.0  # of the depth camera
    stride_m: float = 0.75  # between views on the way
    outdoors: bool = False  # in large part: to be mapped as such
    rooms: list[Room] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)
    objects: list[TrueObject] = field(default_factory=list)

    def slab(self, rect: Rect, top_m: float, thickness_m: float = SLAB_M) -> None:
        """A floor or a ceiling."""
        self.box(rect, top_m - thickness_m, top_m)

    def box(self, rect: Rect, low_m: float, high_m: float, matter: int = STRUCTURE) -> None:
        """A box over a rectangle."""
        low, high = (rect.x0, rect.y0, low_m), (rect.x1, rect.y1, high_m)
        self.boxes.append(Box(snapped(low), snapped(high), matter))

    def storey(self, rect: Rect, level: Level) -> None:
        """Floor, ceiling and outer walls."""
        self.slab(rect.grown(WALL_M / 2), level.z_m)
        self.slab(rect.grown(WALL_M / 2), level.z_m + level.height_m + SLAB_M)
        self.walls(rect, level)

    def walls(self, rect: Rect, level: Level, matter: int = STRUCTURE) -> None:
        """Four walls on the edges of a rectangle."""
        for edge in rect.edges():
            self.box(edge.thick(WALL_M, WALL_M / 2), level.z_m, level.z_m + level.height_m, matter)

    def hollow(self, rect: Rect, level: Level) -> None:
        """Take away walls that cross a rectangle."""
        self.box(rect.grown(-WALL_M / 2), level.z_m, level.z_m + level.height_m, NOTHING)

    def room(self, label: str, rects: Rect | Sequence[Rect], level: Level, walled: bool = True) -> Room:
        """A region; with walls, these stand on the outline."""
        z_m, height_m = level
        parts = (rects,) if isinstance(rects, Rect) else tuple(rects)
        room = Room(label, parts, z_m, height_m, walled, z_m + height_m)
        if walled:
            for edge in outline_edges(parts):
                self.box(edge.thick(WALL_M, WALL_M / 2), z_m, z_m + height_m)
        self.rooms.append(room)
        return room

    def glaze(self, room: Room, post_m: float = 1.2) -> None:
        """Turn a room's walls to glass between posts, above a plinth and below a beam."""
        for edge in outline_edges(room.rects):
            count = max(1, round(edge.length / post_m))
            for part in edge.divided(count):
                pane = part.shortened(WALL_M).thick(WALL_M)
                self.box(pane, room.z_m + 0.1, room.z_m + min(room.height_m, 2.4) - 0.1, GLASS)

    def door(self, one: Room, other: Room, width_m: float | None = None) -> None:
        """A doorway somewhere in the wall between two rooms. Raises Unbuildable."""
        width = width_m or float(self.rng.choice([0.8, 0.9]))
        edges = [edge for edge in self.edges(one, other) if edge.length >= width + 2 * WALL_M]
        if not edges:
            raise Unbuildable(f"no door from {one.label} to {other.label}")
        edge = edges[int(self.rng.integers(len(edges)))]
        slack = max(edge.length - width - 2 * WALL_M, 0.0)  # of a wall that just suffices rounding makes less than none
        at = edge.start + WALL_M + rounded(self.rng.uniform(0, slack), 0.1)
        self._open(one, other, edge.part(at, at + width), min(DOOR_HEIGHT_M, one.height_m))

    def opening(self, one: Room, other: Room, share: float = 0.7, height_m: float = 2.3) -> None:
        """A wide doorway in the middle of the longest wall between two rooms. Raises Unbuildable."""
        edge = self.longest_edge(one, other)
        width = max(1.0, rounded(share * (edge.length - 0.4), 0.2))
        at = rounded(edge.start + (edge.length - width) / 2, 0.1)
        self._open(one, other, edge.part(at, at + width), min(height_m, one.height_m))

    def join(self, one: Room, other: Room, partition_m: float = 0.0, gap_m: float = 1.4) -> None:
        """Let two zones meet without a wall; with a half-height partition of that height but for a gap. Nothing stands
        at the border. Raises Unbuildable."""
        edge = self.longest_edge(one, other)
        if partition_m and edge.length > gap_m + 1:
            at = rounded(edge.start + self.rng.uniform(0.1, edge.length - gap_m - 0.1), 0.1)
            for part in (edge.part(edge.start, at), edge.part(at + gap_m, edge.end)):
                self.box(part.thick(WALL_M), one.z_m, one.z_m + partition_m, FURNITURE)
            edge = edge.part(at, at + gap_m)
        self._pass(one, other, edge, 0.45)

    def edges(self, one: Room, other: Room) -> list[Segment]:
        """Where the outlines of two rooms meet."""
        return [edge for a in one.rects for b in other.rects for edge in shared_edges(a, b)]

    def longest_edge(self, one: Room, other: Room) -> Segment:
        """The longest straight piece of border. Raises Unbuildable."""
        edges = self.edges(one, other)
        if not edges or max(edge.length for edge in edges) < 1.3:
            raise Unbuildable(f"{one.label} and {other.label} hardly touch")
        return max(edges, key=lambda edge: edge.length)

    def window(self, room: Room, shell: Rect, chance: float = 0.8) -> None:
        """Panes in the room's walls that are the building's."""
        for rect in room.rects:
            for edge in (edge for side in shell.edges() for edge in side.overlaps(rect)):
                if edge.length > 1.6 and self.rng.random() < chance and not self._behind(room, edge):
                    pane = edge.shortened(float(self.rng.uniform(0.5, min(1.2, edge.length / 2 - 0.25))))
                    self.box(pane.thick(2 * WALL_M), room.z_m + 0.9, room.z_m + 2.1, GLASS)

    def fits(self, room: Room, footprint: Rect, gap_m: float = 0.0) -> bool:
        """Whether something can stand there: inside, on nothing else, in nobody's way."""
        inside = any(rect.holds(footprint) for rect in room.rects)
        around = footprint.grown(gap_m)
        if not inside or any(around.overlaps(other) for other in [*room.taken, *room.kept_free]):
            return False
        return not room.portals or _portals_joined(room, [*room.taken, footprint])

    def regions(self) -> tuple[TrueRegion, ...]:
        """The ground truth."""
        inset = [WALL_M / 2 if room.walled else 0.0 for room in self.rooms]
        return tuple(
            TrueRegion(number, room.label, outline(room.rects, margin), room.z_m - SLAB_M, room.top_m)
            for number, (room, margin) in enumerate(zip(self.rooms, inset, strict=True))
        )

    def nodes(self) -> tuple[TrueNode, ...]:
        """The ground truth of the levels above."""
        held: dict[tuple[int, str, int], list[int]] = {}
        for number, room in enumerate(self.rooms):
            for level, (label, which) in room.within.items():
                held.setdefault((LEVELS.index(level), label, which), []).append(number)
        return tuple(TrueNode(LEVELS[rank], label, tuple(ids)) for (rank, label, _), ids in sorted(held.items()))

    def _behind(self, room: Room, edge: Segment) -> bool:
        """Whether another room lies on the other side."""
        strip, low_m, high_m = edge.thick(2 * WALL_M), room.z_m, room.top_m
        others = (other for other in self.rooms if other is not room and other.z_m < high_m and low_m < other.top_m)
        return any(strip.overlaps(rect) for other in others for rect in other.rects)

    def _open(self, one: Room, other: Room, way: Segment, height_m: float) -> None:
        low_m = max(one.z_m, other.z_m)  # one of them may be a staircase, which begins below
        self.box(way.thick(3 * WALL_M), low_m, low_m + height_m, NOTHING)
        self._pass(one, other, way, DOOR_SPACE_M)

    def _pass(self, one: Room, other: Room, way: Segment, space_m: float) -> None:
        for room in (one, other):
            room.kept_free.append(way.thick(2 * space_m))
            room.portals.append(_inside(room, way))


def outline_edges(rects: Sequence[Rect]) -> Iterator[Segment]:
    """The straight pieces of the outline of touching rectangles."""
    corners = outline(rects, 0.0)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along_x = y0 == y1
        start, end = sorted((x0, x1) if along_x else (y0, y1))
        yield Segment(along_x, float(y0 if along_x else x0), float(start), float(end))


def rounded(length_m: float, step_m: float = STEP_M) -> float:
    """A length on the grid of that step."""
    return round(round(length_m / step_m) * step_m, 6)


def snapped(point_m: tuple[float, float, float]) -> tuple[float, float, float]:
    """A point on the grid."""
    x, y, z = point_m
    return rounded(x), rounded(y), rounded(z)


def _inside(room: Room, way: Segment) -> tuple[float, float]:
    """The point behind the middle of the way."""
    x, y = way.middle
    behind_m = 0.5 if room.walled else 0.2
    for sign in (1, -1):
        point = (x, y + sign * behind_m) if way.along_x else (x + sign * behind_m, y)
        if any(rect.holds_point(point) for rect in room.rects):
            return point
    raise Unbuildable(f"{room.label} is too narrow for a door")


def _portals_joined(room: Room, taken: Sequence[Rect], cell_m: float = 0.1) -> bool:
    bounds = room.bounds
    shape = (round(bounds.width / cell_m), round(bounds.depth / cell_m))
    free = np.zeros(shape, bool)

    def cells(rect: Rect) -> tuple[slice, slice]:
        low = (max(0, round((rect.x0 - bounds.x0) / cell_m)), max(0, round((rect.y0 - bounds.y0) / cell_m)))
        high = (max(0, round((rect.x1 - bounds.x0) / cell_m)), max(0, round((rect.y1 - bounds.y0) / cell_m)))
        return slice(low[0], high[0]), slice(low[1], high[1])

    for rect in room.rects:
        free[cells(rect)] = True
    if room.walled:
        free = ndimage.minimum_filter(np.pad(free, 1), size=7)[1:-1, 1:-1]
    for rect in taken:
        free[cells(rect.grown(BODY_M))] = False
    parts = ndimage.label(free)[0]
    at = [
        parts[min(int((x - bounds.x0) / cell_m), shape[0] - 1), min(int((y - bounds.y0) / cell_m), shape[1] - 1)]
        for x, y in room.portals
    ]
    return at[0] != 0 and all(part == at[0] for part in at)
