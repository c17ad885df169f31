"""What all methods are compared on: places, map, encoded crops and detections of one sequence, made in this process.

Making them takes minutes and judging methods takes seconds, so they are kept on disk, under a digest of what
determines them: the names, times and sizes of the source's files, the settings, and the code that made them, other than
the loaders of sources: whoever changes one of those deletes the cache.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.settings import Layers
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.objects import Detections
from prior_sg.schemas.places import MapRequest, PlaceDelta, SnapshotRequest, VoxelMap
from prior_sg.schemas.topics import DETECTIONS, KEYFRAME, PLACE_SNAPSHOT, PYRAMID, TEXT, VOXEL_MAP
from prior_sg.services.feature_pyramid.detectors.load import is_prompted
from prior_sg.services.ingest.sources import Source, open_source
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.config import resolve
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity

ROBOT = "eval"
CODE = {"ingest": "core/*.py", "place_graph": "**/*.py", "feature_pyramid": "**/*.py"}  # what makes a perception

Report = Callable[[str, int, int], None]  # what is being done, steps done, steps in all (0 = unknown)
TextOf = Callable[[Sequence[Sequence[str]]], TextEmbeddings]


class EvaluationError(UserError):
    """An evaluation cannot run; the message is one sentence that says what to do."""


@dataclass(frozen=True)
class Perception:
    """One sequence, perceived."""

    name: str
    places: PlaceDelta  # the whole place graph
    voxels: VoxelMap
    pyramids: tuple[Pyramid, ...]
    space: str
    text: TextOf  # concept descriptors in that space
    detections: tuple[Detections, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)  # what making it took, by part; 0 = was on disk


class Cache:
    """Lists of byte strings on disk, by kind and by everything that determines them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, kind: str, key: Any) -> list[bytes] | None:
        """What was kept, or None."""
        path = self._path(kind, key)
        return msgspec.msgpack.decode(path.read_bytes(), type=list[bytes]) if path.exists() else None

    def put(self, kind: str, key: Any, content: list[bytes]) -> None:
        """Keep it; a half-written file never counts."""
        path = self._path(kind, key)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_bytes(msgspec.msgpack.encode(content))
        partial.replace(path)

    def _path(self, kind: str, key: Any) -> Path:
        digest = hashlib.blake2b(json.dumps(msgspec.to_builtins(key), sort_keys=True).encode(), digest_size=16)
        return self.folder / f"{kind}-{digest.hexdigest()}.msgpack"


class Perceiver:
    """Perceives sequences, with one loaded encoder per setting at most."""

    def __init__(self, layers: Layers, cache: Cache, report: Report) -> None:
        self.layers, self.cache, self.report = layers, cache, report
        self._workers: dict[Any, Any] = {}
        self._code = {name: code_digest(name, files) for name, files in CODE.items()}

    def perceive(
        self, path: Path, features: Mapping[str, Any] | None = None, sought: tuple[str, ...] = ()
    ) -> Perception:
        """Places, pyramids and detections of a sequence; `features` are settings of the feature pyramid that differ.

        A prompted detector looks for what its settings name, else for `sought`, the prior's objects.
        """
        source = open_source(path)
        cfg = self._config("feature_pyramid", features)
        if not cfg.detector_prompts and is_prompted(cfg):
            cfg = msgspec.structs.replace(cfg, detector_prompts=sought)
        seconds: dict[str, float] = {}
        snapshot, voxels = self._kept("places", path, None, lambda: self._places(source), seconds)
        features_made = self._kept("features", path, cfg, lambda: self._features(source, cfg), seconds)
        return Perception(
            name=sequence_name(path),
            places=decode(PlaceDelta, snapshot),
            voxels=decode(VoxelMap, voxels),
            pyramids=tuple(decode(Pyramid, pyramid) for pyramid in features_made[::2]),
            space=cfg.space,
            text=lambda concepts: self._text(concepts, cfg),
            detections=tuple(decode(Detections, found) for found in features_made[1::2]),
            seconds=seconds,
        )

    def _kept(
        self, kind: str, path: Path, features: Any, make: Callable[[], list[bytes]], seconds: dict[str, float]
    ) -> list[bytes]:
        made_by: dict[str, Any] = {"ingest": (self._config("ingest"), self._code["ingest"])}
        if features is None:
            made_by["place_graph"] = (self._config("place_graph"), self._code["place_graph"])
        else:
            made_by["feature_pyramid"] = (features, self._code["feature_pyramid"], "pyramids and detections")
        key = {"source": source_digest(path), "made_by": made_by}
        seconds[kind] = 0.0
        content = self.cache.get(f"{sequence_name(path)}-{kind}", key)
        if content is None:
            started_s = time.perf_counter()
            content = make()
            seconds[kind] = time.perf_counter() - started_s
            self.cache.put(f"{sequence_name(path)}-{kind}", key, content)
        return content

    def _config(self, name: str, changes: Mapping[str, Any] | None = None) -> Any:
        layers = {name: {**self.layers.get(name, {}), **(changes or {})}}
        return resolve(BY_NAME[name].config, name, layers)

    def _places(self, source: Source) -> list[bytes]:
        runner = self._runner("place_graph", self._config("place_graph"))
        for keyframe in self._keyframes(source, "places"):
            runner.feed(keyframe)
        requests = ((PLACE_SNAPSHOT, SnapshotRequest(robot=ROBOT)), (VOXEL_MAP, MapRequest(robot=ROBOT)))
        return [encode(runner.answer(query, request)) for query, request in requests]

    def _features(self, source: Source, cfg: Any) -> list[bytes]:
        """Pyramid and detections of each keyframe in turn."""
        worker = self._worker(cfg)
        made: list[bytes] = []
        for frame in self._keyframes(source, "features"):
            messages = dict(worker.feed(frame))
            made += [encode(messages[PYRAMID]), encode(messages[DETECTIONS])]
        return made

    def _keyframes(self, source: Source, what: str) -> Iterator[Keyframe]:
        """The keyframes that ingest selects, each with a report of how far the source is."""
        runner = self._runner("ingest", self._config("ingest"))
        for index, frame in enumerate(source):
            self.report(f"{sequence_name(source.path)}: {what}", index, source.total)
            for topic, message in runner.feed(frame):
                if topic is KEYFRAME and isinstance(message, Keyframe):
                    yield message
        self.report(f"{sequence_name(source.path)}: {what}", source.total, source.total)

    def _text(self, concepts: Sequence[Sequence[str]], cfg: Any) -> TextEmbeddings:
        request = TextRequest(space=cfg.space, concepts=[list(phrases) for phrases in concepts])
        key = {"request": request, "code": self._code["feature_pyramid"]}
        content = self.cache.get("text", key)
        if content is None:
            content = [encode(self._worker(cfg).answer(TEXT, request))]
            self.cache.put("text", key, content)
        return decode(TextEmbeddings, content[0])

    def _worker(self, cfg: Any) -> Runner:
        """A worker with these settings; its weights, which settings share, are loaded when something is not on disk."""
        detector = (cfg.detector, cfg.detector_masks, cfg.detector_threshold, cfg.segments)
        key = (cfg.space, cfg.runtime, cfg.device, cfg.threads, cfg.batch_size, *detector)
        if key not in self._workers:
            self.report(f"loading {cfg.space}", 0, 0)
            self._workers[key] = self._runner("feature_pyramid", cfg).state
        return self._runner("feature_pyramid", cfg, self._workers[key])

    def _runner(self, name: str, cfg: Any, state: Any = None) -> Runner:
        return Runner(BY_NAME[name], cfg, Identity(ROBOT, name, 1), state=state)


def sequence_name(path: Path) -> str:
    """What a sequence is called in tables: its folder, or its file without the suffix."""
    return path.stem if path.is_file() else path.resolve().name


def ground_truth(path: Path) -> GroundTruth:
    """The true regions of a sequence. Raises EvaluationError when it has none."""
    truth = open_source(path).ground_truth
    if truth is None:
        raise EvaluationError(f"{path} has no ground truth: put a regions.json beside its frames")
    try:
        return GroundTruth.from_json(truth)
    except ValueError as error:
        raise EvaluationError(f"{path}: {error}") from error


def source_digest(path: Path) -> dict[str, Any]:
    """What tells one state of a source from another without reading it: its place, and times and sizes of its files."""
    path = path.resolve()
    entries = [path, *sorted(path.iterdir())] if path.is_dir() else [path]
    stats = [(entry.name, entry.stat()) for entry in entries]
    return {"path": str(path), "entries": [(name, stat.st_mtime_ns, stat.st_size) for name, stat in stats]}


def code_digest(service: str, files: str) -> str:
    """Digest of a service's source files: whoever changes the code does not judge what the former code made."""
    folder = Path(__file__).parent.parent.parent / "services" / service
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(folder.glob(files)):
        digest.update(str(file.relative_to(folder)).encode() + file.read_bytes())
    return digest.hexdigest()
