"""The ground truth of a recording: its regions and objects, and which place owns which piece of free space."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.schemas.levels import LevelName
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.geometry import inside_polygon
from prior_sg.services.ingest.sources import ReadOptions, open_source


@dataclass(frozen=True)
class TrueRegion:
    """One ground-truth region: a polygon on a floor."""

    id: int
    label: str
    polygon_m: np.ndarray  # (corner, 2) x, y
    z_min_m: float
    z_max_m: float


@dataclass(frozen=True)
class TrueNode:
    """One ground-truth node of a level above regions."""

    level: LevelName
    label: str
    regions: tuple[int, ...]  # ids of the true regions in it


@dataclass(frozen=True)
class GroundTruth:
    """The regions of one sequence."""

    regions: tuple[TrueRegion, ...]
    nodes: tuple[TrueNode, ...] = ()  # of the levels above, where they are known

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> "GroundTruth":
        """From the content of a `regions.json`. Raises ValueError when it is not one."""
        try:
            heights = {floor["id"]: (float(floor["z_min_m"]), float(floor["z_max_m"])) for floor in data["floors"]}
            regions = [
                TrueRegion(
                    int(region["id"]),
                    str(region["label"]),
                    np.array(region["polygon_m"], float).reshape(-1, 2),
                    *heights[region["floor"]],
                )
                for region in data["regions"]
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"regions.json is not in the documented layout ({type(error).__name__}: {error})"
            ) from error
        return cls(tuple(sorted(regions, key=lambda region: region.id)))

    def region_of(self, positions_m: np.ndarray) -> np.ndarray:
        """Id of the region that holds each position (n, 3), -1 = none; where polygons overlap, the smallest id."""
        ids = np.full(len(positions_m), NO_REGION, np.int64)
        for region in self.regions:
            z_m = positions_m[:, 2]
            inside = (z_m >= region.z_min_m) & (z_m < region.z_max_m)
            inside &= inside_polygon(np.asarray(positions_m[:, :2], float), region.polygon_m)
            ids[inside & (ids == NO_REGION)] = region.id
        return ids


def truth_of(source: str | Path, options: ReadOptions | None = None) -> dict[str, Any] | None:
    """The content of the source's regions.json, or None when it has no ground truth. Raises SourceError."""
    return open_source(source, options=options).ground_truth


@dataclass(frozen=True)
class TrueObject:
    """One object of the ground truth: an axis-aligned box in the world."""

    label: str
    min_m: np.ndarray  # (3,)
    max_m: np.ndarray  # (3,)


def read_objects(path: Path, origin_m: Sequence[float] = (0.0, 0.0, 0.0)) -> tuple[TrueObject, ...]:
    """The objects of an `objects.json` in a dataset's folder; none where there is no such file.

    `origin_m` is where the recording's poses were recentred: boxes move with them.
    """
    file = path / "objects.json"
    if not file.exists():
        return ()
    boxes, zero = json.loads(file.read_text())["objects"], np.array(origin_m, float)
    return tuple(
        TrueObject(str(b["label"]), np.array(b["min_m"], float) - zero, np.array(b["max_m"], float) - zero)
        for b in boxes
    )


def in_view(objects: Sequence[TrueObject], voxels: VoxelMap) -> np.ndarray:
    """Which objects the robot has seen (n,): their box holds the centre of an occupied voxel, or nearly does."""
    occupied_m = (voxels.occupied + 0.5) * voxels.voxel_m
    margin_m = voxels.voxel_m / 2
    inside = ((occupied_m >= item.min_m - margin_m) & (occupied_m <= item.max_m + margin_m) for item in objects)
    return np.array([held.all(axis=1).any() for held in inside], bool)


def voxel_owners(voxels: np.ndarray, voxel_m: float, centers_m: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
    """Index of the sphere that owns each voxel (n, 3), -1 = outside all; the centre of voxel i is (i + 0.5) voxel_m."""
    if not len(voxels):
        return np.zeros(0, np.int64)
    voxels = voxels.astype(np.int64)
    low = voxels.min(axis=0)
    shape = voxels.max(axis=0) - low + 1
    best = np.zeros(shape)  # a sphere holds a voxel where its power distance is not positive
    owner = np.full(shape, -1, np.int64)
    axes = [(np.arange(count) + start + 0.5) * voxel_m for count, start in zip(shape, low, strict=True)]
    for index, (center, radius) in enumerate(zip(centers_m.astype(float), radii_m.astype(float), strict=True)):
        box = tuple(
            slice(*np.searchsorted(axis, (at - radius - voxel_m, at + radius + voxel_m)))
            for axis, at in zip(axes, center, strict=True)
        )
        x2, y2, z2 = ((axis[part] - at) ** 2 for axis, part, at in zip(axes, box, center, strict=True))
        power = x2[:, None, None] + y2[:, None] + z2 - radius**2
        nearer = (power < best[box]) | ((power == 0) & (owner[box] == -1))
        best[box][nearer] = power[nearer]
        owner[box][nearer] = index
    return owner[tuple((voxels - low).T)]
