"""How well the objects of the map fit the ground truth's furniture.

A found object may stand for a true one when the middle of its box lies at most TOLERANCE_M from the true box (distance
to the box, 0 inside). True objects that the robot has seen and whose name is among the prior's objects are *wanted*.
Found and true objects are paired one to one: as many wanted ones as possible, then as many others as possible, then
the nearest. A found object paired with a true one that is not wanted is *ignored*: the thing is there, but nobody asked
for it, so it is neither right nor wrong. All else that is found and not paired with a wanted object is wrong.

The middle of a box that is far too large lies easily in some true box. The centred scores are stricter: there a pair's
two middles are at most TOLERANCE_M apart. The named scores do the same as the first with found objects that carry a
label alone, and a pair must have the same name on both sides, letter by letter: a claim under a wrong name is wrong
wherever it stands.
"""

import math
from collections.abc import Collection, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from prior_sg.deploy.truth import TrueObject, in_view
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import VoxelMap

TOLERANCE_M = 0.5
NO_DETECTOR = "none"  # with it no objects are looked for, and there is nothing to judge
NOTHING = -1  # paired with no true object
OBJECT_SHARES = (
    "objects_precision",
    "objects_recall",
    "objects_centred_precision",
    "objects_centred_recall",
    "objects_named_precision",
    "objects_named_recall",
)
OBJECT_COUNTS = ("objects_found", "objects_true", "objects_ignored", "objects_named")
OBJECT_SCORES = (*OBJECT_SHARES, *OBJECT_COUNTS)


def object_scores(
    found: Sequence[SceneObject],
    true: Sequence[TrueObject],
    names: Collection[str],
    voxels: VoxelMap,
    tolerance_m: float = TOLERANCE_M,
) -> dict[str, float]:
    """Precision and recall by place, by centre and by place and name, and counts; by OBJECT_SCORES.

    `names` are those of the prior's objects, `voxels` tell what the robot has seen. `objects_found` counts all found
    objects, `objects_named` those with a label, `objects_true` the wanted ones, `objects_ignored` found ones that stand
    for a true object that is not wanted. A share of nothing is NaN.
    """
    wanted = in_view(true, voxels) & np.array([item.label in names for item in true], bool)
    named = np.array([bool(item.label) for item in found], bool)
    same = np.array([[a.label == b.label for b in true] for a in found], bool).reshape(len(found), len(true))
    by_place, by_centre = distances_m(found, true), distances_m(found, [_middle(item) for item in true])
    for distances in (by_place, by_centre):
        distances[distances > tolerance_m] = np.inf
    by_name = np.where(same, by_place, np.inf)[named]
    pairings = [pairs(distances, wanted) for distances in (by_place, by_centre, by_name)]
    shares = [share for columns in pairings for share in _shares(columns, wanted)]
    counts = len(found), wanted.sum(), _ignored(pairings[0], wanted), named.sum()
    return dict(zip(OBJECT_SCORES, map(float, (*shares, *counts)), strict=True))


def _middle(item: TrueObject) -> TrueObject:
    """An object without extent, at the middle of its box."""
    middle_m = (item.min_m + item.max_m) / 2
    return TrueObject(item.label, middle_m, middle_m)


def distances_m(found: Sequence[SceneObject], true: Sequence[TrueObject]) -> np.ndarray:
    """From the middle of each found box to each true box (found, true), metres; 0 inside."""
    middles_m = np.array([item.position_m for item in found], float).reshape(-1, 1, 3)
    low_m, high_m = (np.array([getattr(t, end) for t in true], float).reshape(-1, 3) for end in ("min_m", "max_m"))
    return np.linalg.norm(np.maximum(np.maximum(low_m - middles_m, middles_m - high_m), 0), axis=2)


def pairs(distances_m: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Column of the true object that each found one stands for (found,), or NOTHING.

    `distances_m` (found, true) are infinite where a pair is impossible, `wanted` (true,) marks the true objects that
    count. The pairing has the most wanted objects, then the most others, then the least sum of distances.
    """
    columns = np.full(len(distances_m), NOTHING)
    possible = np.isfinite(distances_m)
    if not possible.any():
        return columns
    most = min(distances_m.shape)
    other = 1 + most * float(distances_m[possible].max())  # worth more than all distances together
    worth = np.where(wanted, other * (1 + most), other)  # and this more than all others together
    gains = np.where(possible, worth - np.where(possible, distances_m, 0), 0.0)
    rows, chosen = linear_sum_assignment(gains, maximize=True)
    real = possible[rows, chosen]
    columns[rows[real]] = chosen[real]
    return columns


def _shares(columns: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """Precision and recall of a pairing."""
    hits, claims = int(wanted[columns[columns != NOTHING]].sum()), len(columns) - _ignored(columns, wanted)
    return (hits / claims if claims else math.nan), (hits / int(wanted.sum()) if wanted.any() else math.nan)


def _ignored(columns: np.ndarray, wanted: np.ndarray) -> int:
    return int((~wanted[columns[columns != NOTHING]]).sum())
