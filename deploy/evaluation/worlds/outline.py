"""Rectangles, straight borders between them, and the outline of several that touch. Metres, in the plane."""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np


class Segment(NamedTuple):
    """A straight border along x at y = `at`, or along y at x = `at`."""

    along_x: bool
    at: float
    start: float
    end: float

    @property
    def length(self) -> float:
        """Its length."""
        return round(self.end - self.start, 6)

    @property
    def middle(self) -> tuple[float, float]:
        """Its middle."""
        center = (self.start + self.end) / 2
        return (center, self.at) if self.along_x else (self.at, center)

    def part(self, start: float, end: float) -> "Segment":
        """A piece of the same line."""
        return self._replace(start=round(start, 6), end=round(end, 6))

    def shortened(self, margin: float) -> "Segment":
        """Without its ends."""
        return self.part(self.start + margin, self.end - margin)

    def divided(self, count: int) -> Iterator["Segment"]:
        """Equal pieces."""
        cuts = np.linspace(self.start, self.end, count + 1)
        return (self.part(a, b) for a, b in itertools.pairwise(cuts.tolist()))

    def thick(self, thickness: float, ends: float = 0.0) -> "Rect":
        """A rectangle with the border in its middle, longer by `ends` at both."""
        half = thickness / 2
        if self.along_x:
            return Rect(self.start - ends, self.at - half, self.end + ends, self.at + half)
        return Rect(self.at - half, self.start - ends, self.at + half, self.end + ends)

    def overlaps(self, rect: "Rect") -> Iterator["Segment"]:
        """What of the border lies on the edges of a rectangle."""
        for edge in rect.edges():
            start, end = max(self.start, edge.start), min(self.end, edge.end)
            if edge.along_x == self.along_x and abs(edge.at - self.at) < 1e-6 and end - start > 1e-6:
                yield self.part(start, end)


class Rect(NamedTuple):
    """An axis-aligned rectangle."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        """Along x."""
        return self.x1 - self.x0

    @property
    def depth(self) -> float:
        """Along y."""
        return self.y1 - self.y0

    @property
    def area(self) -> float:
        """Its area."""
        return self.width * self.depth

    @property
    def center(self) -> tuple[float, float]:
        """Its middle."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    def grown(self, margin: float) -> "Rect":
        """Larger on all sides; smaller with a negative margin."""
        return Rect(self.x0 - margin, self.y0 - margin, self.x1 + margin, self.y1 + margin)

    def edges(self) -> tuple[Segment, ...]:
        """South, north, west and east."""
        return (
            Segment(True, self.y0, self.x0, self.x1),
            Segment(True, self.y1, self.x0, self.x1),
            Segment(False, self.x0, self.y0, self.y1),
            Segment(False, self.x1, self.y0, self.y1),
        )

    def overlaps(self, other: "Rect") -> bool:
        """Whether they share area."""
        apart = 1e-6
        return (
            self.x0 < other.x1 - apart
            and other.x0 < self.x1 - apart
            and self.y0 < other.y1 - apart
            and other.y0 < self.y1 - apart
        )

    def holds(self, other: "Rect") -> bool:
        """Whether the other lies inside."""
        near = 1e-6
        return (
            self.x0 - near <= other.x0
            and self.y0 - near <= other.y0
            and other.x1 <= self.x1 + near
            and other.y1 <= self.y1 + near
        )

    def holds_point(self, point: tuple[float, float]) -> bool:
        """Whether the point lies inside."""
        return self.x0 < point[0] < self.x1 and self.y0 < point[1] < self.y1

    def cut_x(self, cuts: Sequence[float]) -> list["Rect"]:
        """Pieces beside each other along x, of these widths."""
        ends = np.round(self.x0 + np.cumsum(cuts), 6).tolist()
        return [Rect(a, self.y0, b, self.y1) for a, b in zip([self.x0, *ends[:-1]], ends, strict=True)]

    def cut_y(self, cuts: Sequence[float]) -> list["Rect"]:
        """Pieces beside each other along y, of these depths."""
        ends = np.round(self.y0 + np.cumsum(cuts), 6).tolist()
        return [Rect(self.x0, a, self.x1, b) for a, b in zip([self.y0, *ends[:-1]], ends, strict=True)]


def shared_edges(one: Rect, other: Rect) -> list[Segment]:
    """The borders of two rectangles that touch from outside."""
    return [edge for side in one.edges() for edge in side.overlaps(other)]


def outline(rects: Sequence[Rect], margin: float) -> np.ndarray:
    """Corners (n, 2), counterclockwise, of the union of rectangles that touch and enclose no hole, moved inwards."""
    xs = sorted({x for rect in rects for x in (rect.x0, rect.x1)})
    ys = sorted({y for rect in rects for y in (rect.y0, rect.y1)})
    filled = np.zeros((len(xs) + 1, len(ys) + 1), bool)  # a rim of nothing around the cells
    for rect in rects:
        filled[xs.index(rect.x0) + 1 : xs.index(rect.x1) + 1, ys.index(rect.y0) + 1 : ys.index(rect.y1) + 1] = True
    following: dict[tuple[int, int], tuple[int, int]] = {}
    for i, j in np.argwhere(filled).tolist():
        a, b = i - 1, j - 1
        for beside, start, end in (
            ((i, j - 1), (a, b), (a + 1, b)),
            ((i + 1, j), (a + 1, b), (a + 1, b + 1)),
            ((i, j + 1), (a + 1, b + 1), (a, b + 1)),
            ((i - 1, j), (a, b + 1), (a, b)),
        ):
            if not filled[beside]:
                following[start] = end
    path = [min(following)]
    while (after := following[path[-1]]) != path[0]:
        path.append(after)
    corners = np.array([(xs[i], ys[j]) for i, j in path])
    before, behind = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    turning = before[:, 0] * behind[:, 1] - before[:, 1] * behind[:, 0] != 0
    return _inset(corners[turning], margin)


def _inset(corners: np.ndarray, margin: float) -> np.ndarray:
    ahead = np.sign(np.roll(corners, -1, axis=0) - corners)
    inwards = np.stack((-ahead[:, 1], ahead[:, 0]), axis=1)  # of the edge that starts at the corner
    return np.round(corners + margin * (inwards + np.roll(inwards, 1, axis=0)), 6)
