"""What no map can hold: a robot that tells it is not followed there, so that it harms no other's map (pure)."""

import numpy as np

from prior_sg.deploy.fleet.core.members import Delta
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.scene import Scene

FARTHEST_M = 1e6  # from the zero of a map's frame; beyond a few times that, squares of 32 bits overflow
WIDEST_M = 100.0  # of free space around a place: no sensor and no place graph tells more


def fault_of_delta(delta: Delta) -> str:
    """Why a delta is not believed, as a sentence; empty when it is. Regions hold no measure that is used."""
    match delta:
        case PlaceDelta():
            cameras_m = [delta.past_cameras_m, np.array(delta.camera_m or (0.0, 0.0, 0.0))]
            return _fault(delta.robot, delta.radii_m, delta.positions_m, *cameras_m)
        case ObjectDelta():
            spots = [item.position_m for item in delta.objects] + [marker.position_m for marker in delta.markers]
            return _fault(delta.robot, np.zeros(0), np.array(spots))
        case _:
            return ""


def fault_of_scene(scene: Scene) -> str:
    """The same of a stored scene."""
    spots = [item.position_m for item in scene.objects] + [marker.position_m for marker in scene.markers]
    return _fault(scene.robot, scene.radii_m, scene.positions_m, scene.trajectory, np.array(spots))


def _fault(robot: str, radii_m: np.ndarray, *spots_m: np.ndarray) -> str:
    far_m = max((float(np.abs(some_m).max(initial=0.0)) for some_m in spots_m), default=0.0)
    if far_m > FARTHEST_M:
        return f"{robot} tells of something {far_m:.3g} m away: not believed beyond {FARTHEST_M:g} m"
    for wrong_m in (radii_m.max(initial=0.0), radii_m.min(initial=0.0)):
        if not 0 <= wrong_m <= WIDEST_M:
            return f"{robot} tells of a place with {wrong_m:.3g} m of free space around it: not believed"
    return ""
