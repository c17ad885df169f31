"""What pictures are made of: few large arrays by name, and how two pictures differ (pure).

Names are paths; the first part names the layer (`/places/0`). Arrays are compared by content, so that what has not
changed is not sent again.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from prior_sg.deploy.showing.colors import Color


@dataclass(frozen=True, eq=False)
class Points:
    """Round dots."""

    points_m: np.ndarray  # (point, 3) float32, world
    colors: np.ndarray  # (point, 3) uint8
    size_m: float


@dataclass(frozen=True, eq=False)
class Lines:
    """Straight segments."""

    points_m: np.ndarray  # (segment, 2, 3) float32, world
    colors: np.ndarray  # (segment, 2, 3) uint8, or (3,) for all
    width_px: float


@dataclass(frozen=True, eq=False)
class Mesh:
    """Flat ground of one colour."""

    vertices_m: np.ndarray  # (vertex, 3) float32, world
    faces: np.ndarray  # (face, 3) uint32
    color: Color
    opacity: float


@dataclass(frozen=True, eq=False)
class Arrows:
    """From their first point to their second."""

    points_m: np.ndarray  # (arrow, 2, 3) float32, world
    color: Color
    shaft_m: float


@dataclass(frozen=True, eq=False)
class Name:
    """A line of text that always faces the eye."""

    text: str
    position_m: tuple[float, float, float]  # world
    scale: float


Shape = Points | Lines | Mesh | Arrows | Name
Picture = dict[str, Shape]


@dataclass(frozen=True)
class Difference:
    """What makes the second of two pictures of the first."""

    changed: Picture
    removed: list[str]

    @property
    def nbytes(self) -> int:
        """About how much has to be sent for it."""
        return sum(nbytes(shape) for shape in self.changed.values())


def difference(old: Picture, new: Picture) -> Difference:
    """Shapes of `new` that `old` lacks or has otherwise, and names that are gone."""
    changed = {name: shape for name, shape in new.items() if name not in old or not same(old[name], shape)}
    return Difference(changed, [name for name in old if name not in new])


def same(one: Shape, other: Shape) -> bool:
    """Whether two shapes look alike."""
    return one is other or (
        type(one) is type(other)
        and all(_equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    )


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    return bool(one == other)


def nbytes(shape: Shape) -> int:
    """Size of a shape's arrays and text."""
    values = [getattr(shape, field.name) for field in fields(shape)]
    return sum(value.nbytes if isinstance(value, np.ndarray) else len(str(value)) for value in values)


def dashed(lines_m: np.ndarray, dash_m: float) -> np.ndarray:
    """Dashes (dash, 2, 3) of about twice that distance from one to the next, along segments (segment, 2, 3)."""
    along = lines_m[:, 1] - lines_m[:, 0]
    counts = np.maximum(np.ceil(np.linalg.norm(along, axis=1) / (2 * dash_m)).astype(int), 1)
    rows = np.repeat(np.arange(len(lines_m)), counts)
    nth = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    shares = np.stack(((nth + 0.25) / counts[rows], (nth + 0.75) / counts[rows]), axis=1)
    return (lines_m[rows, :1] + shares[:, :, None] * along[rows, None]).astype(np.float32)
