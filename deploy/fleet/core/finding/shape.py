"""A map's free space as its places tell it: balls that touch obstacles (pure).

A place's radius is its distance to the nearest obstacle: nothing stands inside a ball, and something stands on its
surface. Where the balls of a map end sideways there is a wall, or furniture, or nothing has been seen yet.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.scene import Scene

NEIGHBOURS = 24  # balls looked at around a point
SURFACE_POINTS = 42  # on each ball
UPRIGHT = 0.35  # sine of the angle between a wall's direction and the level
INSIDE_M = 0.06  # a surface point that deep in another ball is none of the union's


@dataclass(frozen=True)
class Shape:
    """The balls of one map."""

    centers_m: np.ndarray  # (place, 3) float64
    radii_m: np.ndarray  # (place,)

    @cached_property
    def tree(self) -> cKDTree:
        """Of the centres."""
        return cKDTree(self.centers_m)

    def near(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances and rows (point, k) of the nearest centres."""
        count = min(NEIGHBOURS, len(self.centers_m))
        distances_m, rows = self.tree.query(points_m, k=count)
        return distances_m.reshape(len(points_m), count), rows.reshape(len(points_m), count)

    def depth_m(self, points_m: np.ndarray) -> np.ndarray:
        """How deep each point (n, 3) lies inside the union, metres; negative outside."""
        distances_m, rows = self.near(points_m)
        return np.asarray((self.radii_m[rows] - distances_m).max(axis=1))

    @cached_property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) of the union's surface and the directions (n, 3) out of it."""
        out = _directions(SURFACE_POINTS)
        points_m = (self.centers_m[:, None] + self.radii_m[:, None, None] * out).reshape(-1, 3)
        normals = np.tile(out, (len(self.centers_m), 1))
        kept = self.depth_m(points_m) < INSIDE_M
        return points_m[kept], normals[kept]

    @cached_property
    def surface_tree(self) -> cKDTree:
        """Of the surface's points."""
        return cKDTree(self.surface[0])

    @cached_property
    def walls(self) -> tuple[np.ndarray, np.ndarray]:
        """The upright parts of the surface: floors and ceilings lie together in any two maps."""
        points_m, normals = self.surface
        upright = np.abs(normals[:, 2]) < UPRIGHT
        return points_m[upright], normals[upright]

    @cached_property
    def wall_tree(self) -> cKDTree:
        """Of the walls' points."""
        return cKDTree(self.walls[0])


def shape_of(scene: Scene) -> Shape:
    """The balls of a scene."""
    return Shape(scene.positions_m.astype(float), scene.radii_m.astype(float))


def _directions(count: int) -> np.ndarray:
    """Unit vectors (count, 3) spread evenly: a Fibonacci sphere."""
    at = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * at / count), np.pi * (1 + 5**0.5) * at
    return np.stack((np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)), axis=1)
