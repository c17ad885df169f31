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
    """Each marker once, by its key: where the first map that knows it has it. Doubted where any of them doubts it, or
    has it elsewhere."""
    found: dict[MarkerKey, tuple[str, SceneMarker]] = {}
    for one in maps:
        for marker in one.scene.markers:
            here = _moved(marker, one.fleet_from_own)
            robot, known = found.setdefault(marker.key, (one.name.robot, here))
            gap_m = float(np.linalg.norm(np.subtract(here.position_m, known.position_m)))
            if not known.doubt and (marker.doubt or gap_m > APART_M):
                doubt = marker.doubt or f"{robot} and {one.name.robot} have it {gap_m:.1f} m from each other"
                found[marker.key] = robot, msgspec.structs.replace(known, doubt=doubt)
    return [marker for _, (_, marker) in sorted(found.items())]


def _moved(marker: SceneMarker, fleet_from_own: np.ndarray) -> SceneMarker:
    pose = fleet_from_own @ pose_of(marker)
    x, y, z = pose[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_of(pose).tolist()
    return msgspec.structs.replace(marker, position_m=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))
