"""How well regions fit the ground truth (paper, Evaluation Metrics; after Hughes et al., Hydra).

Places are compared by the free space they fill. A free voxel whose centre lies in the spheres of several places
belongs to the one with the smallest power distance d^2 - r^2 (then the smallest id), which cuts two overlapping
spheres along the plane of their common circle. A place belongs to the ground-truth region whose polygon and floor
hold its centre; places in no polygon are left out before anything else. An estimated region is all places that carry
its id, and places without a region take part on the ground-truth side only. Regions that own no voxel do not count on
either side.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from schemas.places import VoxelMap
from schemas.scene import Scene
from services.geometry import inside_polygon

NO_REGION = -1


@dataclass(frozen=True)
class TrueRegion:
    """One ground-truth region: a polygon on a floor."""

    id: int
    label: str
    polygon_m: np.ndarray  # (corner, 2) x, y
    z_min_m: float
    z_max_m: float


@dataclass(frozen=True)
class GroundTruth:
    """The regions of one sequence."""

    regions: tuple[TrueRegion, ...]

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


@dataclass(frozen=True)
class Overlap:
    """Voxel counts of estimated (rows) against ground-truth regions (columns)."""

    shared: np.ndarray  # (estimated, true) voxels in both
    estimated: np.ndarray  # (estimated,) voxels of each estimated region
    true: np.ndarray  # (true,) voxels of each true region
    same_label: np.ndarray  # (estimated, true) bool


def evaluate(scene: Scene, free: VoxelMap, truth: GroundTruth) -> dict[str, float]:
    """The paper's scores of a scene, each in [0, 1].

    Precision, recall and F1 (p, r, f1) and mean intersection over union (miou), each for labels and shape (s) and for
    shape alone (g). `miou_*` averages over the matched pairs, min(estimated, true) of them, as the paper does;
    `miou_*_penalised` lets every unmatched region count as 0. `accuracy` is the share of the scored volume whose label
    is right. Without estimated regions every score is 0.
    """
    overlap = overlap_of(scene, free, truth)
    semantic, geometric = _scores(overlap, overlap.same_label), _scores(overlap, np.ones_like(overlap.same_label))
    scores = {f"{key}_s": value for key, value in semantic.items()} | {f"{k}_g": v for k, v in geometric.items()}
    right = (overlap.shared * overlap.same_label).sum()
    return {
        "f1_s": scores["f1_s"],
        "f1_g": scores["f1_g"],
        "p_s": scores["p_s"],
        "r_s": scores["r_s"],
        "p_g": scores["p_g"],
        "r_g": scores["r_g"],
        "miou_s": scores["miou_s"],
        "miou_g": scores["miou_g"],
        "miou_s_penalised": scores["penalised_s"],
        "miou_g_penalised": scores["penalised_g"],
        "accuracy": _ratio(right, overlap.true.sum()),
    }


def overlap_of(scene: Scene, free: VoxelMap, truth: GroundTruth) -> Overlap:
    """Voxel volumes of the estimated and true regions and of what they share."""
    true_ids = truth.region_of(scene.positions_m)
    scored = true_ids != NO_REGION
    owners = voxel_owners(free.free, free.voxel_m, scene.positions_m[scored], scene.radii_m[scored])
    volumes = np.bincount(owners[owners >= 0], minlength=int(scored.sum()))
    filled = volumes > 0
    volumes, true_ids, estimated_ids = volumes[filled], true_ids[scored][filled], scene.place_regions[scored][filled]
    truths, columns = np.unique(true_ids, return_inverse=True)
    labelled = estimated_ids != NO_REGION
    estimates, rows = np.unique(estimated_ids[labelled], return_inverse=True)
    shared = np.zeros((len(estimates), len(truths)), np.int64)
    np.add.at(shared, (rows, columns[labelled]), volumes[labelled])
    names = {region.id: region.label for region in scene.regions}
    true_names = {region.id: region.label for region in truth.regions}
    same = [[names.get(e) == true_names[t] for t in truths.tolist()] for e in estimates.tolist()]
    return Overlap(
        shared,
        shared.sum(axis=1),
        np.bincount(columns, volumes, minlength=len(truths)).astype(np.int64),
        np.array(same, bool).reshape(shared.shape),
    )


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


def _scores(overlap: Overlap, counted: np.ndarray) -> dict[str, float]:
    shared = overlap.shared * counted
    union = overlap.estimated[:, None] + overlap.true[None, :] - overlap.shared
    precision = _mean((shared / overlap.estimated[:, None]).max(axis=1, initial=0.0))
    recall = _mean((shared / overlap.true[None, :]).max(axis=0, initial=0.0))
    iou = shared / union
    total = iou[linear_sum_assignment(iou, maximize=True)].sum()
    return {
        "p": precision,
        "r": recall,
        "f1": _ratio(2 * precision * recall, precision + recall),
        "miou": _ratio(total, min(iou.shape)),
        "penalised": _ratio(total, max(iou.shape)),
    }


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else 0.0


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else 0.0
