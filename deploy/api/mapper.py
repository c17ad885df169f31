"""The whole method in the calling process: frames in, a scene graph out, no bus, no processes, no threads of ours."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prior_sg.deploy.api.errors import NotInSceneError, SaveError
from prior_sg.deploy.api.frames import frame_of
from prior_sg.deploy.api.scene import Scene
from prior_sg.deploy.running.recorder import TICKS_AFTER
from prior_sg.deploy.settings import DEFAULT_ROBOT
from prior_sg.schemas.codec import Message
from prior_sg.schemas.frames import CameraState, IngestState, Intrinsics
from prior_sg.schemas.places import MapRequest, SnapshotRequest, VoxelMap
from prior_sg.schemas.priors import Keep, Kept, Prior, PriorList, PriorRequest, Recall, Recalled, Task
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.status import Loss, Tick
from prior_sg.schemas.topics import (
    INGEST_STATE,
    KEYFRAME,
    OBJECT_DELTA,
    OBJECT_SNAPSHOT,
    PLACE_DELTA,
    PLACE_SNAPSHOT,
    POSTERIOR,
    PRIORS,
    REGION_DELTA,
    REGION_SNAPSHOT,
    SCENE,
    TASK,
    VOXEL_MAP,
)
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.ingest.sources import Source, SourceError, open_source
from prior_sg.services.ingest.sources.base import Event
from prior_sg.services.losses import line, merged
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.client import NoPriorError
from prior_sg.services.runtime.config import ConfigError, check_sections, resolve
from prior_sg.services.runtime.runner import Pipeline, Published, Runner
from prior_sg.services.runtime.service import Identity, Service, ServiceError

SUFFIXES = (".json", ".sqlite")
NEWS = (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA)
MOST_TICKS = 1000  # until the map rests; it takes a few
IN_MEMORY: dict[str, dict[str, Any]] = {
    "scene_store": {"path": ":memory:", "history": "last", "history_last": 0},
    "prior_gateway": {"archive": ""},
}

Progress = Callable[[int, int], None]  # frames read, frames in all (0 = unknown)


class Mapper:
    """Builds one robot's scene graph for a task in an environment, both in plain words.

    `regions` fixes the names of regions; without it the prior chooses them. `settings` are those of the services, such
    as `{"place_graph.voxel_m": 0.2}`; files and variables of the environment are not read. Priors come from the
    library, nothing is kept on disk. The same frames give the same scene. Use as a context manager, or call `close`.
    Raises NoPriorError, ConfigError, ServiceError.
    """

    def __init__(
        self,
        environment: str,
        task: str,
        regions: Sequence[str] | None = None,
        robot: str = DEFAULT_ROBOT,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self.robot, self.environment = robot, environment
        self._pipeline = _pipeline(robot, settings or {})
        self._stamp_ns = 0  # of the newest frame or tick
        self._next_id = 0  # above the number of every frame so far
        self._tasks = 0
        self._ticked_ns: dict[str, int] = {}  # by service
        self._restless = True  # whether something has been fed since the map last rested
        try:
            self._give(task, regions)
        except NoPriorError:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of networks and files."""
        self._pipeline.close()

    def add(
        self,
        frame: RawFrame | None = None,
        *,
        color: NDArray[np.uint8] | None = None,
        depth: NDArray[Any] | None = None,
        intrinsics: Intrinsics | ArrayLike | None = None,
        world_from_camera: ArrayLike | None = None,
        stamp_ns: int | None = None,
    ) -> bool:
        """Take one frame of `open_source`, or one of arrays: `color` RGB (h, w, 3); `depth` (h, w), float in metres or
        uint16 in millimetres, 0 = no measurement; `intrinsics` an Intrinsics or a matrix (3, 3) in pixels;
        `world_from_camera` (4, 4), world z up, camera x right, y down, z forward; `stamp_ns` above the last frame's.

        True when the frame became a keyframe; others add nothing to the map. A frame whose stamp, number or pose cannot
        follow the last one's is logged and counted in `progress.rejected`. Raises SourceError for unusable arrays.
        """
        if frame is None:
            if color is None or depth is None or intrinsics is None or world_from_camera is None or stamp_ns is None:
                raise SourceError("add takes a frame, or color, depth, intrinsics, world_from_camera and stamp_ns")
            frame = frame_of(
                self._next_id,
                color=color,
                depth=depth,
                intrinsics=intrinsics,
                world_from_camera=world_from_camera,
                stamp_ns=stamp_ns,
            )
        return any(topic is KEYFRAME for topic, _ in self._take(frame))

    def read(self, source: str | Path | Source, progress: Progress | None = None) -> None:
        """Take all frames of a source, or of the file or folder of one, and the corrected poses that it carries.

        A source goes on where the one before it ended, as a second walk through the same world: frame numbers and
        stamps are moved so that they rise, which takes three frames. The same recording once more adds its keyframes
        once more: read each once.
        `progress` is called with the frames read so far and in all. Raises SourceError, also when no frame can be used.
        """
        opened = source if isinstance(source, Source) else open_source(source)
        before, count = self.progress, 0
        for event in opened.events():
            self._take(event)
            if progress is not None and isinstance(event, RawFrame | BadFrame):
                count += 1
                progress(count, opened.total)
        now = self.progress
        if now.frames_read - before.frames_read == now.rejected - before.rejected:
            why = "; ".join(line(loss, now.frames_read) for loss in now.losses[:1]) or "it holds none"
            raise SourceError(f"no frame of {opened.path} can be used: {why}")

    @property
    def progress(self) -> IngestState:
        """How many frames were read, became keyframes, and were rejected."""
        ingest = self._pipeline.of("ingest")
        ((_, state),) = (output for output in ingest.feed(Tick(stamp_ns=self._stamp_ns)) if output[0] is INGEST_STATE)
        assert isinstance(state, IngestState)
        return state

    @property
    def losses(self) -> list[Loss]:
        """What could not be used so far and why, most frequent first."""
        return merged(loss for runner in self._pipeline.runners for loss in runner.service.losses(runner.state))

    @property
    def scene(self) -> Scene:
        """The scene graph of all frames so far, once nothing is pending."""
        self._settle()
        return Scene(self._pipeline.of("scene_store").answer(SCENE, SceneRequest(robot=self.robot)), self._prior)

    @property
    def prior(self) -> Prior:
        """The prior graph in force."""
        return self._prior

    def task(self, text: str, regions: Sequence[str] | None = None) -> Scene:
        """Switch the task: new regions on the same map; no image is looked at again. Raises NoPriorError."""
        self._give(text, regions)
        return self.scene

    def explain(self, place_id: int) -> PosteriorReply:
        """Why a place carries its label: votes of experts, pull of neighbours, belief. Raises NotInSceneError."""
        self._settle()
        request = PosteriorRequest(robot=self.robot, place_id=place_id)
        reply: PosteriorReply = self._pipeline.of("segmenter").answer(POSTERIOR, request)
        if not reply.found:
            raise NotInSceneError(f"there is no labelled place {place_id}; Scene.places.ids lists them")
        return reply

    def save(self, path: str | Path) -> Path:
        """Write the scene: to a .json or .sqlite file, else to a folder with scene.json, dsg.json, map.png and
        map-3d.png, as `prior-sg run` does. Raises SaveError.
        """
        path = Path(path)
        if path.suffix and path.suffix not in SUFFIXES and not path.is_dir():
            raise SaveError(f"{path} ends in {path.suffix}; name a folder, or a file ending in {' or '.join(SUFFIXES)}")
        scene = self.scene
        try:
            (path.parent if path.suffix in SUFFIXES else path).mkdir(parents=True, exist_ok=True)
            if path.suffix == ".sqlite":
                self._save_database(path)
            elif path.suffix == ".json":
                scene.to_json(path)
            else:
                self._save_folder(scene, path)
        except OSError as error:
            raise SaveError(f"cannot write {path} ({error.strerror}); choose another place") from error
        return path

    def _give(self, text: str, regions: Sequence[str] | None) -> None:
        names = list(regions or ())
        request = PriorRequest(environment=self.environment, task=text, regions=names)
        gateway = self._pipeline.of("prior_gateway")
        known: PriorList = gateway.answer(PRIORS, request)
        if not known.priors:
            raise NoPriorError(known.reason)
        self._tasks += 1
        task = Task(robot=self.robot, stamp_ns=self._tasks, environment=self.environment, task=text, regions=names)
        self._pipeline.publish(TASK, task)
        self._task = task
        self._prior: Prior = gateway.answer(PRIORS, request).priors[0]
        self._restless = True

    def _take(self, event: Event) -> list[Published]:
        """One event of a source, then the ticks that are due by its stamp."""
        published = self._pipeline.feed(self._pipeline.of("ingest"), event)
        self._restless = True
        if isinstance(event, RawFrame):
            self._next_id = max(self._next_id, event.frame_id + 1)
        for camera in [message for _, message in published if isinstance(message, CameraState)]:
            published += self._pass_until(camera.stamp_ns)
        return published

    def _pass_until(self, stamp_ns: int) -> list[Published]:
        """The ticks that are due at the time of a frame, as the stream counts it."""
        published, self._stamp_ns = list[Published](), max(self._stamp_ns, stamp_ns)
        for runner in self._pipeline.runners:
            last_ns = self._ticked_ns.setdefault(runner.service.name, stamp_ns)
            if runner.service.tick_s is not None and stamp_ns - last_ns >= 1e9 * runner.service.tick_s:
                published += self._tick(runner)
        return published

    def _tick(self, runner: Runner) -> list[Published]:
        self._ticked_ns[runner.service.name] = self._stamp_ns
        return self._pipeline.feed(runner, Tick(stamp_ns=self._stamp_ns))

    def _settle(self) -> None:
        """Let time pass until as many ticks have brought nothing as a run waits for at its end."""
        quiet = 0 if self._restless else max(TICKS_AFTER.values())
        for _ in range(MOST_TICKS):
            if quiet >= max(TICKS_AFTER.values()):
                self._restless = False
                return
            published = [output for runner in self._pipeline.runners for output in self._pass_time(runner)]
            quiet = 0 if any(topic in NEWS for topic, _ in published) else quiet + 1
        raise ServiceError(f"the map does not come to rest within {MOST_TICKS} ticks; please report this as a fault")

    def _pass_time(self, runner: Runner) -> list[Published]:
        return [] if runner.service.tick_s is None else self._tick(runner)

    def _save_folder(self, scene: Scene, folder: Path) -> None:
        from prior_sg.deploy.showing import export

        place_graph = self._pipeline.of("place_graph")
        voxels: VoxelMap = place_graph.answer(VOXEL_MAP, MapRequest(robot=self.robot))
        scene.to_json(folder / "scene.json")
        try:
            extras.require("dsg", "dsg.json")
            from prior_sg.deploy.showing.dsg import save_spark_dsg

            save_spark_dsg(scene.message, folder / "dsg.json")
        except extras.ExtraMissing as error:
            warnings.warn(f"saved without dsg.json: {error}", stacklevel=3)
        export.map_png(scene.message, voxels, folder / "map.png")
        export.places_png(scene.message, voxels, folder / "map-3d.png")

    def _save_database(self, path: Path) -> None:
        """A store on this file reads everything as it would after having missed it all."""
        for leftover in path.parent.glob(f"{path.name}*"):
            leftover.unlink()
        memory, request = self._pipeline.of("scene_store"), SnapshotRequest(robot=self.robot)
        cfg = resolve(memory.service.config, "scene_store", {"scene_store": {"path": str(path)}})
        with Runner(memory.service, cfg, memory.identity, wire=True) as store:
            store.feed(self._task, self._prior)
            for name, query in (
                ("place_graph", PLACE_SNAPSHOT),
                ("segmenter", REGION_SNAPSHOT),
                ("segmenter", OBJECT_SNAPSHOT),
            ):
                store.feed(self._pipeline.of(name).answer(query, request))


def _pipeline(robot: str, settings: Mapping[str, Any]) -> Pipeline:
    """All services, joined as on a bus. Raises ConfigError, ServiceError."""
    layers = _layers(settings)
    configs = {service.name: resolve(service.config, service.name, layers) for service in SERVICES}
    return Pipeline([_runner(service, robot, configs[service.name]) for service in SERVICES])


def _runner(service: Service[Any, Any], robot: str, cfg: Any) -> Runner:
    identity = Identity(robot if service.scope == "robot" else "*", service.name, 1)
    answers = {errand: ERRANDS[errand.request] for errand in service.errands if errand.request in ERRANDS}
    return Runner(service, cfg, identity, dict[Any, Any](answers), wire=True)


def _layers(settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Settings by service and field, over those that keep everything in memory. Raises ConfigError."""
    layers = {name: dict(fields) for name, fields in IN_MEMORY.items()}
    for name, value in settings.items():
        section, dot, field = name.partition(".")
        if not dot:
            raise ConfigError(f"settings are named SERVICE.FIELD, such as segmenter.beta; got {name!r}")
        if field in IN_MEMORY.get(section, {}) or name == "prior_gateway.provider":
            raise ConfigError(
                f"{name} cannot be set here: a Mapper keeps nothing and asks the library; use `prior-sg run`"
            )
        layers.setdefault(section, {})[field] = value
    check_sections(layers, [service.name for service in SERVICES])
    return layers


def _recall(request: Recall) -> Recalled:
    return Recalled(question=request.question)


def _keep(request: Keep) -> Kept:
    return Kept(prior=request.prior, question=request.question)


ERRANDS: dict[type[Message], Callable[[Any], Message]] = {Recall: _recall, Keep: _keep}  # an archive that holds nothing
