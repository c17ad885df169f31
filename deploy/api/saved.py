"""Scenes that runs have left behind."""

from pathlib import Path

from prior_sg.deploy.api.errors import NotInSceneError
from prior_sg.deploy.api.scene import Scene
from prior_sg.deploy.settings import DEFAULT_ROBOT
from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene as SceneMessage
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.topics import PRIOR, SCENE

LOG, DATABASE = "log.mcap", "scene.sqlite"  # what `run` and `demo` leave in their folder
ATTACHMENT = "scene.msgpack"


def open_scene(path: str | Path, robot: str = DEFAULT_ROBOT) -> Scene:
    """The scene that a run has left: of its folder, its log (.mcap) or a database of the store (.sqlite).

    A log of `run` and `demo` holds the scene as it was and the prior; a database holds the robot's scene. `scene.json`
    is rounded and cannot be read back. Raises NotInSceneError, LogError, StoreError.
    """
    path = Path(path)
    file = next((one for one in (path / LOG, path / DATABASE) if one.exists()), path) if path.is_dir() else path
    if file.is_dir() or not file.exists():
        raise NotInSceneError(f"there is no scene at {path}: name the folder of a run, its {LOG} or a .sqlite file")
    if file.suffix == ".mcap":
        return _from_log(file)
    if file.suffix in (".sqlite", ".db"):
        return Scene(_from_database(file, robot))
    if file.suffix == ".json":
        raise NotInSceneError(f"{file} is rounded and cannot be read back; name the folder it lies in, or its {LOG}")
    raise NotInSceneError(f"{file} holds no scene: name the folder of a run, its {LOG} or a .sqlite file")


def _from_log(file: Path) -> Scene:
    from prior_sg.services.runtime.record import attachments, read_log

    saved = attachments(file).get(ATTACHMENT)
    if saved is None:
        raise NotInSceneError(f"{file} holds no final scene: it was written by neither `run` nor `demo`")
    message = decode(SceneMessage, saved)
    priors: dict[str, Prior] = {}
    for entry in read_log(file, [PRIOR]):
        try:
            prior = decode(Prior, entry.payload)
        except DecodeError:
            continue  # such a prior was refused by everybody
        priors[prior.digest()] = prior
    return Scene(message, priors.get(message.prior_digest))


def _from_database(file: Path, robot: str) -> SceneMessage:
    from prior_sg.services.registry import BY_NAME
    from prior_sg.services.runtime.runner import Runner

    store = BY_NAME["scene_store"]
    with Runner(store, store.config(path=str(file))) as runner:
        scene: SceneMessage = runner.answer(SCENE, SceneRequest(robot=robot))
    if not len(scene.place_ids):
        raise NotInSceneError(f"{file} holds no places of {robot}; name another robot")
    return scene
