"""Frontiers: where the free space of a place ends at space that was not observed (pure).

A face between a free voxel and an unobserved one is open. It belongs to the nearest place whose sphere holds it. The
outward normals of a place's open faces, each weighed by its area, add up to its opening: holes in the depth are closed
surfaces, whose normals cancel, and a doorway not yet passed adds up to its width times its height.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.place_graph.core.columns import OpeningColumns
from prior_sg.services.place_graph.core.skeleton.graph import PlaceGraph
from prior_sg.services.place_graph.core.volume.grid import FREE, UNOBSERVED, Box, VoxelGrid

Normal = tuple[int, int, int]
CLOSED: Normal = (0, 0, 0)
BESIDE = 1.0  # voxels: a sphere ends on the voxel before an obstacle, and its faces one beside that
TOLD_AREA, TOLD_COSINE = 0.2, 0.966  # a change of a fifth of the area, or of 15 degrees, is told


@dataclass
class Openings:
    """The opening of each place as a sum of outward normals, in faces of voxels, and what readers were told of it."""

    reach: int  # voxels from a place's centre to the farthest face that can belong to it
    normals: dict[int, Normal] = field(default_factory=dict)
    told: dict[int, Normal] = field(default_factory=dict)

    def renew(self, grid: VoxelGrid, graph: PlaceGraph, changed: Box) -> set[int]:
        """Recompute what labels or places changed inside `changed` may concern; returns the ids looked at."""
        rivals = graph.within(changed.grown(2 * self.reach))
        voxels = graph.voxels(rivals)
        near = np.flatnonzero(changed.grown(self.reach).contains(voxels)).tolist()
        wanted = [n for n in near if rivals[n] not in graph.frozen]
        if wanted:
            radii = np.sqrt([float(graph.places[i].d2) for i in rivals]) + BESIDE
            window = Box.around(voxels[wanted]).grown(self.reach + 1).clipped(grid.bounds.grown(1))
            label = grid.gather("label", window)
            found = summed_normals(label, voxels - window.low, np.minimum(radii, self.reach))
            sums = zip(wanted, found[wanted].tolist(), strict=True)
            self.normals |= {rivals[n]: (x, y, z) for n, (x, y, z) in sums}
        return {rivals[n] for n in near}

    def update(self, ids: Iterable[int], shown: Iterable[int], voxel_m: float, min_area_m2: float) -> OpeningColumns:
        """What readers must hear of the places `ids`, of those that are `shown`; it is remembered as told."""
        news: dict[int, Normal] = {}
        for place_id in sorted(ids):
            normal = self.normals.get(place_id, CLOSED) if place_id in shown else CLOSED
            if _length(normal) * voxel_m**2 < min_area_m2:
                normal = CLOSED
            if _differs(self.told.get(place_id, CLOSED), normal):
                news[place_id] = normal
        for place_id, normal in news.items():
            self.told[place_id] = normal
            if normal == CLOSED:
                del self.told[place_id]
        return _columns({i: normal for i, normal in news.items() if i in shown}, voxel_m)

    def renumber(self, number: Mapping[int, int]) -> None:
        """Places have other ids."""
        self.normals = {number[i]: normal for i, normal in self.normals.items() if i in number}
        self.told = {number[i]: normal for i, normal in self.told.items() if i in number}

    def forget(self, ids: Iterable[int]) -> None:
        """Places that are no more."""
        for place_id in ids:
            self.normals.pop(place_id, None)
            self.told.pop(place_id, None)

    def snapshot(self, voxel_m: float) -> OpeningColumns:
        """All that readers have been told, ids ascending."""
        return _columns(dict(sorted(self.told.items())), voxel_m)


@compiled()
def summed_normals(label, voxels, reaches):  # noqa: ANN001, ANN201
    """Sum (place, 3) of the outward normals of the open faces nearest to each place (n, 3), within its reach."""
    nx, ny, nz = label.shape
    found = np.zeros((len(voxels), 3), np.int64)
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                if label[i, j, k] != FREE:
                    continue
                x = int(label[i + 1, j, k] == UNOBSERVED) - int(label[i - 1, j, k] == UNOBSERVED)
                y = int(label[i, j + 1, k] == UNOBSERVED) - int(label[i, j - 1, k] == UNOBSERVED)
                z = int(label[i, j, k + 1] == UNOBSERVED) - int(label[i, j, k - 1] == UNOBSERVED)
                if x == 0 and y == 0 and z == 0:
                    continue
                owner, nearest = -1, 1 << 30
                for n in range(len(voxels)):
                    dx, dy, dz = i - voxels[n, 0], j - voxels[n, 1], k - voxels[n, 2]
                    apart = dx * dx + dy * dy + dz * dz
                    if apart < nearest and apart <= reaches[n] * reaches[n]:
                        owner, nearest = n, apart
                if owner >= 0:
                    found[owner, 0] += x
                    found[owner, 1] += y
                    found[owner, 2] += z
    return found


def _differs(told: Normal, now: Normal) -> bool:
    if told == now:
        return False
    before, after = _length(told), _length(now)
    if not before or not after:
        return before != after
    along = told[0] * now[0] + told[1] * now[1] + told[2] * now[2]
    return abs(after - before) > TOLD_AREA * before or along < TOLD_COSINE * before * after


def _length(normal: Normal) -> float:
    x, y, z = normal
    return math.sqrt(x * x + y * y + z * z)


def _columns(openings: dict[int, Normal], voxel_m: float) -> OpeningColumns:
    normals = np.array(list(openings.values()), np.float64).reshape(-1, 3)
    lengths = np.linalg.norm(normals, axis=1)
    directions = np.divide(normals, lengths[:, None], out=np.zeros_like(normals), where=lengths[:, None] > 0)
    return OpeningColumns(
        frontier_ids=np.array(list(openings), np.int64),
        frontier_directions=directions.astype(np.float32),
        frontier_areas_m2=(lengths * voxel_m**2).astype(np.float32),
    )
