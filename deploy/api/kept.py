"""Whether an answer about the past is the one that was asked for."""

from prior_sg.deploy.api.errors import NotInSceneError
from prior_sg.deploy.api.scene import Scene


def kept(scene: Scene, revision: int | None, stamp_ns: int | None) -> Scene:
    """The scene that was asked for. Raises NotInSceneError where the answer is another, or there is none."""
    robot = scene.robot
    if revision is not None and scene.revision != revision:
        raise NotInSceneError(f"revision {revision} of {robot} is not kept; history() lists those that are")
    if scene.revision < 0 and stamp_ns is not None:
        raise NotInSceneError(f"nothing is kept of {robot} at {stamp_ns} ns; history() lists what is")
    return scene
