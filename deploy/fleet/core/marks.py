"""The printed markers of several maps as those of one (pure)."""

from collections.abc import Iterable

import msgspec
import numpy as np

from prior_sg.deploy.fleet.core.finding.marking import pose_of
from prior_sg.deploy.fleet.core.fusing import Placed
from prior_sg.schemas.markers import MarkerKey, SceneMarker
from prior_sg.services.geometry import quaternion_of

GONE = "no map that is merged shows it any more"
APART_M = 0.5  # farther from each other, the markers of two maps under one number are two


def markers_of(maps: Iterable[Placed]) -> list[SceneMarker]:
    """Each marker once, by its key: where the first map that knows it has it, from the keyframes of all maps that have
    it there. Doubted where any of them doubts it, or has it elsewhere."""
    found: dict[MarkerKey, tuple[str, SceneMarker]] = {}
    for one in maps:
        for marker in one.scene.markers:
            here = _moved(marker, one.fleet_from_own)
            if marker.key not in found:
                doubt = _doubt(one.name.robot, one.name.robot, marker, 0.0)
                found[marker.key] = one.name.robot, msgspec.structs.replace(here, doubt=doubt)
                continue
            robot, known = found[marker.key]
            gap_m = float(np.linalg.norm(np.subtract(here.position_m, known.position_m)))
            frames = known.frames + (here.frames if gap_m <= APART_M else 0)
            doubt = known.doubt or _doubt(robot, one.name.robot, marker, gap_m)
            found[marker.key] = robot, msgspec.structs.replace(known, frames=frames, doubt=doubt)
    return [marker for _, (_, marker) in sorted(found.items())]


def _doubt(robot: str, other: str, of_other: SceneMarker, gap_m: float) -> str:
    """Why nothing may be concluded from a marker that two maps have so far from each other; empty where it may be."""
    if of_other.doubt:
        return f"in {other} {of_other.doubt}"
    return f"{robot} and {other} have it {gap_m:.1f} m from each other" if gap_m > APART_M else ""


def _moved(marker: SceneMarker, fleet_from_own: np.ndarray) -> SceneMarker:
    pose = fleet_from_own @ pose_of(marker)
    x, y, z = pose[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_of(pose).tolist()
    return msgspec.structs.replace(marker, position_m=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))
