"""What the poses and units of a folder mean, by how well its depth images agree under each meaning (pure)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.agreement import DepthView, agreement
from prior_sg.services.ingest.core.poses import Convention

UNITS_M = (1e-3, 1 / 5000, 1 / 6553.5, 1 / 4000, 1e-4, 1 / 256, 1e-2)  # metres per unit that tools write
USUAL_UNIT_M = 1e-3
LIKELY_M = 2.5  # median depth of a room
ROOM_M = (0.15, 80.0)  # median depths of rooms, halls and streets
CLEARLY = 1.25  # times as much agreement as any other meaning
LEAST_SHARE = 0.5  # of the points that agree under the right meaning, with noise
MOVED_M, TURNED_RAD, REACH = 0.15, 0.12, 20
UPRIGHT = 0.8  # cosine: cameras are held so, on average
OPTIONS = {"poses": "--poses", "axes": "--axes", "quaternion": "--quaternion"}
CHOICES = {
    "poses": ("world_from_camera", "camera_from_world"),
    "axes": ("opencv", "opengl", "ros", "ned"),
    "quaternion": ("xyzw", "wxyz"),
}


@dataclass(frozen=True)
class Written:
    """One frame as it is written: depth in its own units, and the pose as a matrix or as tx ty tz and a quaternion."""

    depth: np.ndarray  # (h, w), 0 = no measurement
    pose: np.ndarray  # (4, 4) or (7,)

    def source_from_camera(self, convention: Convention) -> np.ndarray:
        """The pose under a convention. Raises PoseError."""
        if self.pose.shape == (7,):
            return convention.of_words([str(number) for number in self.pose])
        return convention.of_matrix(self.pose)


@dataclass(frozen=True)
class Meaning:
    """A convention and a unit."""

    convention: Convention
    unit_m: float


@dataclass(frozen=True)
class Verdict:
    """The meaning that was found, how well depth agrees under it, and what could not be told (options' names)."""

    meaning: Meaning
    share: float
    unclear: tuple[str, ...]


def moving_pairs(poses: Sequence[np.ndarray], wanted: int) -> list[tuple[int, int]]:
    """Pairs of indices, from all over the sequence, between which the camera moved or turned enough to tell."""
    if len(poses) < 2:
        return []
    starts = np.unique(np.linspace(0, len(poses) - 2, min(wanted, len(poses) - 1)).astype(int)).tolist()
    found = []
    for i in starts:
        for j in range(i + 1, min(i + 1 + REACH, len(poses))):
            moved = inverse(poses[i]) @ poses[j]
            if np.linalg.norm(moved[:3, 3]) >= MOVED_M or rotation_angle_rad(moved) >= TURNED_RAD:
                found.append((i, j))
                break
    return found


def meaning_of(
    pairs: Sequence[tuple[Written, Written]],
    camera: Intrinsics,
    conventions: Sequence[Convention],
    units_m: Sequence[float],
) -> Verdict:
    """The meaning, of these, under which depth agrees best."""
    scores = {
        meaning: _agreement(pairs, camera, meaning)
        for meaning in (Meaning(c, u) for c, u in product(conventions, units_m))
    }
    best = max(scores, key=lambda meaning: scores[meaning][0])
    near = [meaning for meaning, (score, _) in scores.items() if score * CLEARLY >= scores[best][0]]
    unclear = tuple(name for name in CHOICES if len({getattr(meaning.convention, name) for meaning in near}) > 1)
    if len({meaning.unit_m for meaning in near}) > 1:
        usual = replace(best, unit_m=USUAL_UNIT_M)
        best = usual if usual in near else best
        unclear += ("unit",)
    return Verdict(best, scores[best][1], unclear)


def _agreement(pairs: Sequence[tuple[Written, Written]], camera: Intrinsics, meaning: Meaning) -> tuple[float, float]:
    """A score that rises with agreement and overlap, and the share of points that agree."""
    views = [
        DepthView(written.depth * meaning.unit_m, camera, written.source_from_camera(meaning.convention))
        for pair in pairs
        for written in pair
    ]
    found = agreement(views, [(i, i + 1) for i in range(0, len(views), 2)])
    share = 0.0 if np.isnan(found.share) else found.share
    return share * min(1.0, 2 * found.overlap), share


def plausible_units(depths: Sequence[np.ndarray]) -> list[float]:
    """Units under which the median depth is that of a room or a street."""
    values = np.concatenate([depth[depth > 0].ravel() for depth in depths]) if depths else np.zeros(0)
    median = float(np.median(values)) if values.size else 0.0
    return [unit_m for unit_m in UNITS_M if ROOM_M[0] <= median * unit_m <= ROOM_M[1]]


def likely_unit_m(median_units: float) -> float:
    """The usual metres per unit that come nearest to making a room of a median depth."""
    return min((1.0, *UNITS_M), key=lambda unit_m: abs(math.log(max(median_units, 1e-9) * unit_m / LIKELY_M)))


def up_of(poses: Sequence[np.ndarray]) -> tuple[tuple[float, float, float], bool]:
    """The axis of the world to which cameras (x right, y down) are upright, and whether that is clear."""
    if not poses:
        return (0.0, 0.0, 1.0), False
    mean = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-9)
    axis = int(np.abs(mean).argmax())
    if abs(mean[axis]) < UPRIGHT:
        return (0.0, 0.0, 1.0), False
    up = [0.0, 0.0, 0.0]
    up[axis] = float(np.sign(mean[axis]))
    return (up[0], up[1], up[2]), True
