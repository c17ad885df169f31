"""Finds a scene, and what is known beside it, in what a run or another program left on disk."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.deploy.api.history import open_history
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.showing import moments
from prior_sg.deploy.showing.material import Material
from prior_sg.deploy.showing.scene_reading import scene_of_json
from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.topics import PRIOR
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.record import attachments, read_log

IN_FOLDER = ("log.mcap", "scene.sqlite", "scene.json", "dsg.json")  # of a run; the first tells most
SCORES = ("scores.json", "metrics.json")


class SourceUnreadable(UserError):
    """A source holds no scene; the message says what would."""


OTHERWISE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)  # what content of other types raises


def read_material(path: str | Path, robot: str, *, moments_wanted: int = 0, cloud_wanted: bool = False) -> Material:
    """A scene with what lies beside it; how it came about and coloured points are read only when wanted, from a log.

    `path` is a run's folder, scene.json, scene.sqlite, log.mcap, or a file of Spark-DSG (JSON or .sparkdsg); `robot`
    names one of those in a database or log. Raises SourceUnreadable.
    """
    path = Path(path)
    if not path.exists():
        raise SourceUnreadable(f"{path} does not exist; name a run's folder, such as out/demo, or a file of a scene")
    if not path.is_dir():
        return _read_file(path, robot, moments_wanted, cloud_wanted)
    file = next((path / name for name in IN_FOLDER if (path / name).exists()), None)
    if file is None:
        raise SourceUnreadable(f"{path} holds no scene: none of {', '.join(IN_FOLDER)} is in it")
    return replace(_read_file(file, robot, moments_wanted, cloud_wanted), scores=_scores(path))


def _scores(folder: Path) -> dict[str, float | None]:
    file = next((folder / name for name in SCORES if (folder / name).exists()), None)
    if file is None:
        return {}
    try:
        told = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise SourceUnreadable(f"{file} cannot be read: {error}; mend it, or move it away") from error
    if not isinstance(told, dict):
        raise SourceUnreadable(f"{file} holds no scores by name: mend it, or move it away")
    return {name: value for name, value in told.items() if value is None or isinstance(value, int | float)}


def _read_file(path: Path, robot: str, moments_wanted: int, cloud_wanted: bool) -> Material:
    try:
        match path.suffix:
            case ".mcap":
                return _read_log(path, robot, moments_wanted, cloud_wanted)
            case ".sqlite":
                return _read_database(path, robot, moments_wanted)
            case ".json" | ".sparkdsg":
                return _read_graph(path)
    except OSError as error:
        raise SourceUnreadable(f"{path} cannot be read ({error.strerror})") from error
    raise SourceUnreadable(
        f"{path} is none of what holds a scene: .json (scene.json or Spark-DSG), .sparkdsg, .sqlite, .mcap"
    )


def _read_graph(path: Path) -> Material:
    """scene.json and Spark-DSG's JSON are told apart by what they hold."""
    told: Any = None
    if path.suffix == ".json":
        try:
            told = json.loads(path.read_bytes())
        except (ValueError, RecursionError) as error:
            raise SourceUnreadable(f"{path} is not JSON ({error})") from error
    if isinstance(told, dict) and "embedding_space" in told:
        try:
            return Material(_sound(scene_of_json(told)), losses=told.get("losses"))
        except OTHERWISE as error:
            raise SourceUnreadable(
                f"{path} is not in the layout of scene.json: {type(error).__name__} {error}"
            ) from error
    extras.require("dsg", f"reading {path}")
    from prior_sg.deploy.showing.dsg_reading import load_spark_dsg

    try:
        return Material(_sound(load_spark_dsg(path)))
    except OTHERWISE as error:
        raise SourceUnreadable(f"{path} tells no scene: {error}; our own layout is that of scene.json") from error


def _sound(scene: Scene) -> Scene:
    """The scene, whose fields are of their types and whose columns name places that there are. Raises ValueError."""
    scene = decode(Scene, encode(scene))
    known = scene.place_ids
    if (np.diff(known) <= 0).any():
        raise ValueError("its places are not sorted by id, each once")
    for what in ("edges", "frontier_ids", "surface_ids", "predicted_ids"):
        if (unknown := np.setdiff1d(getattr(scene, what), known)).size:
            raise ValueError(f"its {what} name place {unknown[0]}, which it does not hold")
    return scene


def _read_log(path: Path, robot: str, moments_wanted: int, cloud_wanted: bool) -> Material:
    """The scene that a run left in its log, else that its last deltas make."""
    attached = attachments(path)
    try:
        scene = decode(Scene, attached["scene.msgpack"]) if "scene.msgpack" in attached else None
        voxels = decode(VoxelMap, attached["voxels.msgpack"]) if "voxels.msgpack" in attached else None
    except DecodeError as error:
        raise SourceUnreadable(f"{path} holds a scene that this version cannot read: {error}") from error
    left = scene is not None and scene.robot == robot
    story = []
    if moments_wanted or not left:
        with open_history(path) as history:
            story = moments.moments_of(history, robot, max(1, moments_wanted))
    if not left:
        scene, voxels = story[-1].scene if story else None, None
    found = _some(scene, path, robot)
    return Material(
        scene=found,
        prior=_prior_in(path, found.prior_digest),
        log=path,
        voxels=voxels,
        cloud=moments.cloud_of(path, robot) if cloud_wanted else None,
        moments=story if moments_wanted else [],
        settings=moments.settings_of(path),
        losses=json.loads(attached["losses.json"]) if "losses.json" in attached else None,
    )


def _read_database(path: Path, robot: str, moments_wanted: int) -> Material:
    with open_history(path) as history:
        scene = history.scene(robot).message
        return Material(
            _some(scene, path, robot),
            prior=history.prior(scene.prior_digest),
            moments=moments.moments_of(history, robot, moments_wanted),
        )


def _prior_in(path: Path, digest: str) -> Prior | None:
    """The prior of a digest, where the log holds it; one that cannot be decoded was refused by everybody."""
    for entry in read_log(path, [PRIOR]):
        with contextlib.suppress(DecodeError):
            prior = decode(Prior, entry.payload)
            if prior.digest() == digest:
                return prior
    return None


def _some(scene: Scene | None, path: Path, robot: str) -> Scene:
    if scene is None or not len(scene.place_ids):
        with open_history(path) as history:
            others = [one for one in history.robots if one != robot]
        instead = f"name one of {', '.join(others)} with --robot" if others else "nor of any other robot"
        raise SourceUnreadable(f"{path} holds no places of {robot}; {instead}")
    return scene
