"""What all methods are compared on: places, map, encoded crops and detections of one sequence, made in this process.

Making them takes minutes and judging methods takes seconds, so they are kept on disk, under a digest of what
determines them: the names, times and sizes of the source's files, the settings, and the code that made them, other than
the loaders of sources: whoever changes one of those deletes the cache.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.datasets import Dataset
from prior_sg.deploy.evaluation.simulated import SimulatedEncoder, simulated
from prior_sg.deploy.settings import Layers
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.objects import Detections
from prior_sg.schemas.places import MapRequest, PlaceDelta, SnapshotRequest, VoxelMap
from prior_sg.schemas.topics import DETECTIONS, KEYFRAME, PLACE_DELTA, PLACE_SNAPSHOT, PYRAMID, TEXT, VOXEL_MAP
from prior_sg.services.feature_pyramid.core.crops import smallest_crop_px
from prior_sg.services.feature_pyramid.detectors.load import is_prompted, load_detector
from prior_sg.services.feature_pyramid.worker import Worker
from prior_sg.services.place_graph.core.config import AT_ONCE
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.config import resolve
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity

ROBOT = "eval"
CODE = {"ingest": "core/*.py", "place_graph": "**/*.py", "feature_pyramid": "**/*.py"}  # what makes a perception

CACHE = Path("out/eval/cache")
IMAGE_PX = 480  # shorter side of the images for which crops and the coarse surface were chosen

Report = Callable[[str, int, int], None]  # what is being done, steps done, steps in all (0 = unknown)
TextOf = Callable[[Sequence[Sequence[str]]], TextEmbeddings]


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
        return self.folder / f"{kind.replace(':', '-')}-{digest.hexdigest()}.msgpack"


class Layout:
    """In an encoder's place where only the choice of crops is wanted: what they look like is empty."""

    dim, side_px, batch_size = 0, 1, 1

    def __init__(self, space: str) -> None:
        self.space = space

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Nothing (crop, 0) of each crop."""
        return np.zeros((len(crops), 0), np.float32)

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Never asked: whoever simulates an encoder has text of its own."""
        raise NotImplementedError


class Perceiver:
    """Perceives datasets, with one loaded encoder per setting at most, or with a simulated one (see `simulated`)."""

    def __init__(self, layers: Layers, cache: Cache, report: Report, encoder: str = "") -> None:
        self.layers, self.cache, self.report, self.encoder = layers, cache, report, encoder
        self._workers: dict[Any, Any] = {}
        self._code = {name: code_digest(name, files) for name, files in CODE.items()}

    def perceive(
        self, dataset: Dataset, features: Mapping[str, Any] | None = None, sought: tuple[str, ...] = ()
    ) -> Perception:
        """Places, pyramids and detections of a dataset; `features` are settings of the feature pyramid that differ.

        A prompted detector looks for what its settings name, else for `sought`, the prior's objects. A simulated
        encoder sees the crops that the real one of the settings would see, and detects nothing.
        """
        encoder = simulated(self.encoder, dataset.seed)
        if encoder is not None:
            return seen_by(encoder, self.layout(dataset, features), dataset)
        cfg = self._config("feature_pyramid", features)
        if not cfg.detector_prompts and is_prompted(cfg):
            cfg = msgspec.structs.replace(cfg, detector_prompts=sought)
        mapped = self._mapped(dataset, cfg)
        made = self._kept("features", dataset, cfg, lambda: self._features(dataset, cfg), mapped.seconds)
        return replace(
            mapped,
            pyramids=tuple(decode(Pyramid, pyramid) for pyramid in made[::2]),
            detections=tuple(decode(Detections, found) for found in made[1::2]),
        )

    def layout(self, dataset: Dataset, features: Mapping[str, Any] | None = None) -> Perception:
        """Places and pyramids whose crops are chosen and not encoded: what simulated encoders start from."""
        cfg = layout_config(self._config("feature_pyramid", features), dataset)
        mapped = self._mapped(dataset, cfg)
        made = self._kept("layout", dataset, cfg, lambda: self._layouts(dataset, cfg), mapped.seconds)
        mapped.seconds["features"] = mapped.seconds.pop("layout")
        return replace(mapped, pyramids=tuple(decode(Pyramid, pyramid) for pyramid in made))

    def deltas(self, dataset: Dataset) -> list[PlaceDelta]:
        """The changes of the place graph, one for each keyframe."""
        kept = self._kept("deltas", dataset, None, lambda: self._walk(dataset, self._config("place_graph"))[:-2], {})
        return [decode(PlaceDelta, delta) for delta in kept]

    def walk(self, dataset: Dataset) -> list[PlaceDelta]:
        """The same with the preset that suits a world; the whole place graph and the map are kept with them."""
        kept = self._kept("walk", dataset, None, lambda: self._walk(dataset, self.mapping(dataset)), {})
        self._kept("places", dataset, None, lambda: kept[-2:], {})
        return [decode(PlaceDelta, delta) for delta in kept[:-2]]

    def _mapped(self, dataset: Dataset, cfg: Any) -> Perception:
        """Places and voxels, without any crops."""
        seconds: dict[str, float] = {}
        snapshot, voxels = self._kept("places", dataset, None, lambda: self._places(dataset), seconds)
        return Perception(
            name=dataset.name,
            places=decode(PlaceDelta, snapshot),
            voxels=decode(VoxelMap, voxels),
            pyramids=(),
            space=cfg.space,
            text=lambda concepts: self._text(concepts, cfg),
            seconds=seconds,
        )

    def _kept(
        self, kind: str, dataset: Dataset, features: Any, make: Callable[[], list[bytes]], seconds: dict[str, float]
    ) -> list[bytes]:
        made_by: dict[str, Any] = {"ingest": (self._config("ingest"), self._code["ingest"])}
        if features is None:
            made_by["place_graph"] = (self.mapping(dataset), self._code["place_graph"])
        else:
            made_by["feature_pyramid"] = (features, self._code["feature_pyramid"], "pyramids and detections")
        key = {"source": dataset_digest(dataset), "made_by": made_by}
        seconds[kind] = 0.0
        content = self.cache.get(f"{dataset.name}-{kind}", key)
        if content is None:
            started_s = time.perf_counter()
            content = make()
            seconds[kind] = time.perf_counter() - started_s
            self.cache.put(f"{dataset.name}-{kind}", key, content)
        return content

    def mapping(self, dataset: Dataset) -> Any:
        """Settings of the place graph, with the preset that suits a world unless they name one."""
        chosen = "preset" in self.layers.get("place_graph", {})
        return self._config("place_graph", {"preset": "outdoor"} if dataset.outdoors and not chosen else None)

    def _config(self, name: str, changes: Mapping[str, Any] | None = None) -> Any:
        layers = {name: {**self.layers.get(name, {}), **(changes or {})}}
        return resolve(BY_NAME[name].config, name, layers)

    def _places(self, dataset: Dataset) -> list[bytes]:
        return self._walk(dataset, self.mapping(dataset))[-2:]

    def _walk(self, dataset: Dataset, cfg: Any) -> list[bytes]:
        """The deltas of all keyframes, one for each, then the whole place graph, then the map."""
        runner = self._runner("place_graph", msgspec.structs.replace(cfg, slice_blocks=AT_ONCE))
        published = (output for keyframe in self._keyframes(dataset, "places") for output in runner.feed(keyframe))
        deltas = [encode(message) for topic, message in published if topic is PLACE_DELTA]
        requests = ((PLACE_SNAPSHOT, SnapshotRequest(robot=ROBOT)), (VOXEL_MAP, MapRequest(robot=ROBOT)))
        return deltas + [encode(runner.answer(query, request)) for query, request in requests]

    def _layouts(self, dataset: Dataset, cfg: Any) -> list[bytes]:
        """The pyramid of each keyframe, its crops chosen and not encoded."""
        state = Worker("layout", Layout(cfg.space), load_detector(cfg))
        with self._runner("feature_pyramid", cfg, state) as worker:
            frames = self._keyframes(dataset, "layout")
            return [encode(dict(worker.feed(frame))[PYRAMID]) for frame in frames]

    def _features(self, dataset: Dataset, cfg: Any) -> list[bytes]:
        """Pyramid and detections of each keyframe in turn."""
        worker = self._worker(cfg)
        made: list[bytes] = []
        for frame in self._keyframes(dataset, "features"):
            messages = dict(worker.feed(frame))
            made += [encode(messages[PYRAMID]), encode(messages[DETECTIONS])]
        return made

    def _keyframes(self, dataset: Dataset, what: str) -> Iterator[Keyframe]:
        """The keyframes that ingest selects, each with a report of how far the source is."""
        source = dataset.source()
        runner = self._runner("ingest", self._config("ingest"))
        for index, frame in enumerate(source):
            self.report(f"{dataset.name}: {what}", index, source.total)
            for topic, message in runner.feed(frame):
                if topic is KEYFRAME and isinstance(message, Keyframe):
                    yield message
        self.report(f"{dataset.name}: {what}", source.total, source.total)

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


def seen_by(encoder: SimulatedEncoder, layout: Perception, dataset: Dataset) -> Perception:
    """A perception whose crops are not encoded, as a simulated encoder sees it."""
    started_s = time.perf_counter()
    pyramids = tuple(encoder.encode(one, dataset.truth, dataset.objects) for one in layout.pyramids)
    features_s = layout.seconds.get("features", 0.0) + time.perf_counter() - started_s
    seconds = {**layout.seconds, "features": features_s}
    return replace(layout, pyramids=pyramids, space=encoder.space, text=encoder.text, seconds=seconds)


def simulated_perception(dataset: Dataset, encoder: str, seed: int | None = None, folder: Path = CACHE) -> Perception:
    """A dataset as a simulated encoder such as `sim:0.3` sees it, with the settings' defaults.

    `seed` is of the encoder's errors, the dataset's own if None; `folder` keeps places and the choice of crops. Raises
    ValueError for what is no simulated encoder.
    """
    chosen = simulated(encoder, dataset.seed if seed is None else seed)
    if chosen is None:
        raise ValueError(f"{encoder!r} is no simulated encoder, such as sim:0.3")
    return seen_by(chosen, Perceiver({}, Cache(folder), lambda *_: None).layout(dataset), dataset)


def layout_config(cfg: Any, dataset: Dataset) -> Any:
    """Settings of the choice of crops: those of `cfg`, of a world's small images in proportion."""
    cfg = msgspec.structs.replace(cfg, detector="none", detector_masks="depth", detector_prompts=())
    if dataset.world is None:
        return cfg
    camera = dataset.source().intrinsics
    share = min(camera.width_px, camera.height_px) / IMAGE_PX
    return msgspec.structs.replace(
        cfg,
        smallest_crop_px=max(1, round(share * smallest_crop_px(cfg))),
        surface_cell_px=max(1, round(share * cfg.surface_cell_px)),
    )


def dataset_digest(dataset: Dataset) -> dict[str, Any]:
    """What tells one state of a dataset from another: its files, or which world it is and what makes worlds."""
    if dataset.world is None:
        return source_digest(dataset.path)
    return {"world": list(dataset.world), "code": files_digest(Path(__file__).parent / "worlds", "**/*.py")}


def source_digest(path: Path) -> dict[str, Any]:
    """What tells one state of a source from another without reading it: its place, and times and sizes of its files."""
    path = path.resolve()
    entries = [path, *sorted(path.iterdir())] if path.is_dir() else [path]
    stats = [(entry.name, entry.stat()) for entry in entries]
    return {"path": str(path), "entries": [(name, stat.st_mtime_ns, stat.st_size) for name, stat in stats]}


def code_digest(service: str, files: str) -> str:
    """Digest of a service's source files: whoever changes the code does not judge what the former code made."""
    return files_digest(Path(__file__).parent.parent.parent / "services" / service, files)


def files_digest(folder: Path, files: str) -> str:
    """Digest of the files in a folder that fit a pattern, and of their names."""
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(folder.glob(files)):
        digest.update(str(file.relative_to(folder)).encode() + file.read_bytes())
    return digest.hexdigest()
