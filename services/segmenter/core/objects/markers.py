"""Printed markers over time: where each stands in the world, and whether it stands at one spot (pure).

Every keyframe that shows a marker poses it; those that agree with most others give its mean. Sightings keep the pose of
their camera, so that a correction moves them. A marker that several keyframes show elsewhere has been printed twice, or
has been moved, or the map has drifted: nobody can tell which, so it is told with that doubt, and nothing is averaged.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.schemas.markers import MarkerKey, SceneMarker
from prior_sg.schemas.objects import Detections
from prior_sg.services.geometry import pose_from_quaternion, quaternion_of, rotation_angle_rad

VISIBLE_M, VISIBLE_RAD = 0.01, 0.01  # smaller changes are not told
LEAST_TWICE = 2  # keyframes that show a marker twice: one may have misread another
TRIMMED, LEAST_TRIM_M = 3.0, 0.03  # median deviations, at least so many metres, beyond which a sighting is left out


class MarkerConfig(msgspec.Struct, frozen=True, kw_only=True):
    """When a marker is believed."""

    least_frames: int = 3  # keyframes that must show it at one spot
    apart_m: float = 0.5  # sightings farther from each other
    apart_rad: float = 0.5  # or turned more are of two spots
    sightings: int = 64  # kept of each spot: those that show the marker largest

    def __post_init__(self) -> None:
        if min(self.least_frames, self.sightings) < 1 or not (self.apart_m > 0 and self.apart_rad > 0):
            raise ValueError("least_frames, sightings, apart_m and apart_rad must be positive")


class Sighting(NamedTuple):
    """One marker in one keyframe."""

    world_from_camera: np.ndarray  # (4, 4)
    camera_from_marker: np.ndarray  # (4, 4)
    side_px: float
    size_m: float

    @property
    def world_from_marker(self) -> np.ndarray:
        """The marker's pose (4, 4)."""
        return np.asarray(self.world_from_camera @ self.camera_from_marker)


@dataclass
class MarkerMap:
    """All markers, and what they were made from."""

    seen: dict[MarkerKey, dict[tuple[int, int], Sighting]] = field(default_factory=dict)  # by frame id and which of
    # those with that number in the frame
    changed: set[MarkerKey] = field(default_factory=set)  # since news were last asked for

    def observe(self, detections: Detections, world_from_camera: np.ndarray, cfg: MarkerConfig) -> None:
        """Keep what one frame shows; a repeated frame, or one of another space, says nothing new."""
        counted: dict[int, int] = {}
        for row, number in enumerate(detections.marker_ids.tolist()):
            which = counted.get(number, 0)
            counted[number] = which + 1
            key = MarkerKey(detections.marker_dictionary, number)
            sightings = self.seen.setdefault(key, {})
            if (detections.frame_id, which) not in sightings:
                sightings[detections.frame_id, which] = Sighting(
                    world_from_camera.copy(),
                    detections.camera_from_marker[row].copy(),
                    float(detections.marker_sides_px[row]),
                    detections.marker_size_m,
                )
                _forget_one(sightings, (detections.frame_id, which), cfg)
                self.changed.add(key)

    def move(self, poses: Mapping[int, np.ndarray]) -> None:
        """Frames have other poses (4, 4), by frame id."""
        for key, sightings in self.seen.items():
            for name in [name for name in sightings if name[0] in poses]:
                sightings[name] = sightings[name]._replace(world_from_camera=poses[name[0]].copy())
                self.changed.add(key)

    def news(self, told: Mapping[MarkerKey, SceneMarker], cfg: MarkerConfig) -> list[SceneMarker]:
        """The markers that stand otherwise than was told, by key."""
        keys, self.changed = sorted(self.changed), set()
        found = (located(key, self.seen[key], cfg) for key in keys)
        return [one for one in found if one is not None and _differs(one, told.get(one.key))]


def located(key: MarkerKey, sightings: Mapping[tuple[int, int], Sighting], cfg: MarkerConfig) -> SceneMarker | None:
    """Where the sightings of one marker put it; None as long as too few agree."""
    names, poses = list(sightings), np.array([one.world_from_marker for one in sightings.values()])
    spots = [rows for rows in _spots(poses, cfg) if len({names[row][0] for row in rows}) >= cfg.least_frames]
    if not spots:
        return None
    values = list(sightings.values())
    best, *others = [_mean(poses[rows], np.array([values[row].side_px for row in rows])) for rows in spots]
    if not np.isfinite(best).all():  # of sightings without size, or beyond all numbers
        return None
    doubt = ""
    if sum(which > 0 for _, which in names) >= LEAST_TWICE:
        doubt = "it has been seen twice in one keyframe"
    elif others:
        gap_m = max(float(np.linalg.norm(other[:3, 3] - best[:3, 3])) for other in others)
        doubt = f"it has been seen at {len(spots)} spots, up to {gap_m:.1f} m from each other"
    x, y, z = best[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_of(best).tolist()
    return SceneMarker(
        dictionary=key.dictionary,
        id=key.id,
        size_m=values[spots[0][0]].size_m,
        position_m=(x, y, z),
        quaternion_xyzw=(qx, qy, qz, qw),
        frames=len({names[row][0] for row in spots[0]}),
        doubt=doubt,
    )


def _spots(poses: np.ndarray, cfg: MarkerConfig) -> list[np.ndarray]:
    """Rows of sightings that agree, most first: again and again those around the one with which most others agree."""
    gaps_m = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    cosines = (np.einsum("iab,jab->ij", poses[:, :3, :3], poses[:, :3, :3]) - 1) / 2
    agree = (gaps_m <= cfg.apart_m) & (cosines >= np.cos(cfg.apart_rad))
    left, spots = np.ones(len(poses), bool), []
    while left.any():
        counts = np.where(left, (agree & left).sum(axis=1), -1)
        rows = np.flatnonzero(agree[int(counts.argmax())] & left)
        spots.append(rows)
        left[rows] = False
    return spots


def _mean(poses: np.ndarray, sides_px: np.ndarray) -> np.ndarray:
    """Mean of poses (n, 4, 4) that agree, by how large they show the marker and without the farthest."""
    spots_m = poses[:, :3, 3]
    off_m = np.linalg.norm(spots_m - np.median(spots_m, axis=0), axis=1)
    weights = sides_px**2 * (off_m <= max(TRIMMED * float(np.median(off_m)), LEAST_TRIM_M))
    u, _, vt = np.linalg.svd((weights[:, None, None] * poses[:, :3, :3]).sum(axis=0))
    mean = np.eye(4)
    mean[:3, :3] = u @ np.diag((1.0, 1.0, np.linalg.det(u @ vt))) @ vt
    mean[:3, 3] = weights @ spots_m / weights.sum()
    return mean


def _forget_one(sightings: dict[tuple[int, int], Sighting], newest: tuple[int, int], cfg: MarkerConfig) -> None:
    """Of too many sightings at the newest one's spot, the one that shows the marker smallest goes."""
    spot_m = sightings[newest].world_from_marker[:3, 3]
    off_m = {name: np.linalg.norm(one.world_from_marker[:3, 3] - spot_m) for name, one in sightings.items()}
    near = [name for name, gap_m in off_m.items() if gap_m <= cfg.apart_m]
    if len(near) > cfg.sightings:
        del sightings[min(near, key=lambda name: sightings[name].side_px)]


def _differs(now: SceneMarker, before: SceneMarker | None) -> bool:
    if before is None or bool(now.doubt) != bool(before.doubt) or now.frames >= 2 * before.frames:
        return True
    one, other = (pose_from_quaternion(np.array(m.position_m), np.array(m.quaternion_xyzw)) for m in (now, before))
    turn = one.copy()
    turn[:3, :3] = one[:3, :3] @ other[:3, :3].T
    return bool(np.linalg.norm(one[:3, 3] - other[:3, 3]) > VISIBLE_M) or rotation_angle_rad(turn) > VISIBLE_RAD
