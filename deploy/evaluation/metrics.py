"""How well regions fit the ground truth (paper, Evaluation Metrics; after Hughes et al., Hydra).

Places are compared by the free space they fill. A free voxel whose centre lies in the spheres of several places
belongs to the one with the smallest power distance d^2 - r^2 (then the smallest id), which cuts two overlapping
spheres along the plane of their common circle. A place belongs to the ground-truth region whose polygon and floor
hold its centre; places in no polygon are left out before anything else. An estimated region is all places that carry
its id, and places without a region take part on the ground-truth side only. Regions that own no voxel do not count on
either side.

Three scores go beyond the paper. `boundary_f1` compares where regions end: a boundary is a pair of face neighbours
among the scored voxels whose regions differ, at the middle of the common face, and it is found when the other side has
one within BOUNDARY_TOLERANCE_M. A pair with a voxel that no estimated region holds is no estimated boundary. `ece` is
the expected calibration error: the mean distance between the confidence and the accuracy of CALIBRATION_BINS equal bins
of confidence, weighted by volume; the confidence is a place's posterior of its own label. `risk_half` is the share of
wrong labels in the half of the volume that is believed most firmly: what a planner gets that acts on those only.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from prior_sg.deploy.truth import GroundTruth, voxel_owners
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene

BOUNDARY_TOLERANCE_M = 0.5  # about half a doorway
CALIBRATION_BINS = 10
SCORES = (
    "f1_s",
    "f1_g",
    "p_s",
    "r_s",
    "p_g",
    "r_g",
    "miou_s",
    "miou_g",
    "miou_s_penalised",
    "miou_g_penalised",
    "accuracy",
    "boundary_f1",
    "ece",
    "risk_half",
)


@dataclass(frozen=True)
class Assignment:
    """Which places are scored, and the voxels that they own."""

    voxels: np.ndarray  # (voxel, 3) free voxels that a scored place owns
    owners: np.ndarray  # (voxel,) index into the arrays below
    rows: np.ndarray  # (scored,) rows of the scene's places that lie in a true region
    volumes: np.ndarray  # (scored,) voxels of each
    true_ids: np.ndarray  # (scored,)
    estimated_ids: np.ndarray  # (scored,) NO_REGION = not labelled


@dataclass(frozen=True)
class Overlap:
    """Voxel counts of estimated (rows) against ground-truth regions (columns)."""

    shared: np.ndarray  # (estimated, true) voxels in both
    estimated: np.ndarray  # (estimated,) voxels of each estimated region
    true: np.ndarray  # (true,) voxels of each true region
    same_label: np.ndarray  # (estimated, true) bool


@dataclass(frozen=True)
class Beliefs:
    """How firmly each scored place believes its label, and whether that is right."""

    volumes: np.ndarray  # (belief,) voxels
    confidence: np.ndarray  # (belief,) posterior of its own label
    right: np.ndarray  # (belief,) bool


@dataclass(frozen=True)
class Reliability:
    """What is believed against what is so, in equal bins of confidence from 0 to 1."""

    volumes: np.ndarray  # (bin,) voxels
    confidence: np.ndarray  # (bin,) mean, 0 in empty bins
    accuracy: np.ndarray  # (bin,) share whose label is right, 0 in empty bins

    @property
    def error(self) -> float:
        """Expected calibration error; NaN without any belief."""
        total = self.volumes.sum()
        gaps = np.abs(self.confidence - self.accuracy) * self.volumes
        return float(gaps.sum() / total) if total else float("nan")


def evaluate(scene: Scene, free: VoxelMap, truth: GroundTruth) -> dict[str, float]:
    """The scores of a scene by the names in SCORES, each in [0, 1].

    Precision, recall and F1 (p, r, f1) and mean intersection over union (miou), each for labels and shape (s) and for
    shape alone (g). `miou_*` averages over the matched pairs, min(estimated, true) of them, as the paper does;
    `miou_*_penalised` lets every unmatched region count as 0. `accuracy` is the share of the scored volume whose label
    is right. Without estimated regions every score is 0. `ece` and `risk_half`, where less is better, are NaN for a
    scene without posteriors.
    """
    assignment = assign(scene, free, truth)
    overlap = overlap_of(scene, assignment, truth)
    semantic = scores_of(overlap, overlap.same_label)
    geometric = scores_of(overlap, np.ones_like(overlap.same_label))
    scores = {f"{key}_s": value for key, value in semantic.items()} | {f"{k}_g": v for k, v in geometric.items()}
    scores["miou_s_penalised"], scores["miou_g_penalised"] = scores["penalised_s"], scores["penalised_g"]
    scores["accuracy"] = _ratio((overlap.shared * overlap.same_label).sum(), overlap.true.sum())
    scores["boundary_f1"] = boundary_f1(assignment, free.voxel_m)
    beliefs = beliefs_of(scene, assignment, truth)
    scores["ece"], scores["risk_half"] = reliability(beliefs).error, risk(beliefs, coverage=0.5)
    return {name: scores[name] for name in SCORES}


def assign(scene: Scene, free: VoxelMap, truth: GroundTruth) -> Assignment:
    """The places inside true regions with their voxels; places that own none are left out."""
    true_ids = truth.region_of(scene.positions_m)
    rows = np.flatnonzero(true_ids != NO_REGION)
    owners = voxel_owners(free.free, free.voxel_m, scene.positions_m[rows], scene.radii_m[rows])
    owned = owners >= 0
    volumes = np.bincount(owners[owned], minlength=len(rows))
    filled = volumes > 0
    index = np.cumsum(filled) - 1
    rows = rows[filled]
    return Assignment(
        free.free[owned], index[owners[owned]], rows, volumes[filled], true_ids[rows], scene.place_regions[rows]
    )


def overlap_of(scene: Scene, assignment: Assignment, truth: GroundTruth) -> Overlap:
    """Voxel volumes of the estimated and true regions and of what they share."""
    volumes, estimated_ids = assignment.volumes, assignment.estimated_ids
    truths, columns = np.unique(assignment.true_ids, return_inverse=True)
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


def boundary_f1(assignment: Assignment, voxel_m: float) -> float:
    """F1 of the estimated boundaries' midpoints against the true ones; 1 where both sides rightly have none."""
    if (assignment.estimated_ids == NO_REGION).all():
        return 0.0
    one, other = _face_neighbours(assignment.voxels)
    midpoints = assignment.voxels[one].astype(np.int64) + assignment.voxels[other]  # in half voxels, hence exact
    one, other = assignment.owners[one], assignment.owners[other]
    true, estimated = assignment.true_ids, assignment.estimated_ids
    labelled = (estimated[one] != NO_REGION) & (estimated[other] != NO_REGION)
    true_points = midpoints[true[one] != true[other]]
    points = midpoints[labelled & (estimated[one] != estimated[other])]
    if not (len(true_points) or len(points)):
        return 1.0
    reach = 2 * BOUNDARY_TOLERANCE_M / voxel_m
    precision, recall = _near(points, true_points, reach), _near(true_points, points, reach)
    return _ratio(2 * precision * recall, precision + recall)


def beliefs_of(scene: Scene, assignment: Assignment, truth: GroundTruth) -> Beliefs:
    """The scored places that have a label and a posterior of it."""
    names = {region.id: region.label for region in scene.regions}
    true_names = {region.id: region.label for region in truth.regions}
    columns = {label: column for column, label in enumerate(scene.labels[: scene.posteriors.shape[1]])}
    labels = [names.get(region, "") for region in assignment.estimated_ids.tolist()]
    kept = np.array([label in columns for label in labels], bool)
    column = np.array([columns.get(label, 0) for label in labels], int)[kept]
    right = [label == true_names[true] for label, true in zip(labels, assignment.true_ids.tolist(), strict=True)]
    confidence = scene.posteriors[assignment.rows[kept], column].astype(float)
    return Beliefs(assignment.volumes[kept], confidence, np.array(right, bool)[kept])


def reliability(beliefs: Beliefs) -> Reliability:
    """Confidence against accuracy."""
    bins = np.clip((beliefs.confidence * CALIBRATION_BINS).astype(int), 0, CALIBRATION_BINS - 1)
    volumes, believed, found = (
        np.bincount(bins, beliefs.volumes * weight, minlength=CALIBRATION_BINS)
        for weight in (1.0, beliefs.confidence, beliefs.right)
    )
    some = np.maximum(volumes, 1)
    return Reliability(volumes, believed / some, found / some)


def risk(beliefs: Beliefs, coverage: float) -> float:
    """Share of wrong labels in the part `coverage`, in (0, 1], of the volume that is believed most firmly.

    Equal beliefs count alike; NaN without any belief.
    """
    levels, level = np.unique(-beliefs.confidence, return_inverse=True)
    volumes = np.bincount(level, beliefs.volumes, minlength=len(levels))
    wrong = np.bincount(level, beliefs.volumes * ~beliefs.right, minlength=len(levels))
    wanted = coverage * volumes.sum()
    taken = np.clip(wanted - (np.cumsum(volumes) - volumes), 0.0, volumes)
    return float((wrong * taken / np.maximum(volumes, 1)).sum() / wanted) if wanted else float("nan")


def _face_neighbours(voxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of rows of voxels (n, 3), all different, that share a face."""
    if not len(voxels):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    shifted = voxels.astype(np.int64) - voxels.min(axis=0)
    row = np.full(shifted.max(axis=0) + 2, -1)
    row[tuple(shifted.T)] = np.arange(len(voxels))
    next_rows = [row[tuple((shifted + step).T)] for step in np.eye(3, dtype=np.int64)]
    ones = [np.flatnonzero(rows >= 0) for rows in next_rows]
    return np.concatenate(ones), np.concatenate([rows[rows >= 0] for rows in next_rows])


def _near(points: np.ndarray, others: np.ndarray, reach: float) -> float:
    """Share of points (n, 3) with one of the others within `reach`."""
    if not (len(points) and len(others)):
        return 0.0
    distances, _ = cKDTree(others).query(points)
    return float((distances <= reach * (1 + 1e-9)).mean())


def scores_of(overlap: Overlap, counted: np.ndarray) -> dict[str, float]:
    """Precision, recall, F1 and mean intersection over union, where only the pairs `counted` may match."""
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
