"""What methods are judged on: recorded sequences with ground truth, and generated worlds, which bring theirs along."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.deploy.truth import GroundTruth, TrueObject, read_objects
from prior_sg.schemas.priors import Prior
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.sources import Source, open_source

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.worlds.walk import Manner

WORLD = "world:"
SEQUENCE = "sequence"  # the kind of every dataset that is no world
MILLIMETRE = 0.001


class WorldName(NamedTuple):
    """Which generated world."""

    kind: str
    seed: int


@dataclass(frozen=True)
class Dataset:
    """One sequence or world to judge on."""

    name: str
    path: Path  # of a world, what the command line calls it
    truth: GroundTruth
    prior: Prior  # the library's
    objects: tuple[TrueObject, ...] = ()  # of the ground truth, where it names them
    world: WorldName | None = None
    outdoors: bool = False  # a world that is to be mapped with the place graph's outdoor preset

    @property
    def kind(self) -> str:
        """Its kind of world, or SEQUENCE."""
        return self.world.kind if self.world else SEQUENCE

    @property
    def seed(self) -> int:
        """Its world's seed, 0 for a sequence."""
        return self.world.seed if self.world else 0

    def source(self) -> Source:
        """Its frames. Raises SourceError."""
        return world_source(self.world) if self.world else open_source(self.path)


def chosen_datasets(paths: Sequence[Path], environments: Sequence[str], task: str) -> list[Dataset]:
    """Datasets with truth and prior; the vocabulary is the ground truth's. Raises EvaluationError or SourceError."""
    named = dict(text.split("=", 1) for text in environments if "=" in text)
    general = [text for text in environments if "=" not in text]
    datasets: list[Dataset] = []
    for path in paths:
        name = sequence_name(path)
        if str(path).startswith(WORLD):
            found = [of_world(world, task) for world in named_worlds(str(path))]
        else:
            found = [of_sequence(path, named.get(name, general[-1] if general else ""), task)]
        for dataset in found:
            if any(dataset.name == other.name for other in datasets):
                raise EvaluationError(f"two datasets are called {dataset.name}; rename one, for tables go by name")
            datasets.append(dataset)
    return datasets


def of_sequence(path: Path, environment: str, task: str) -> Dataset:
    """A recorded sequence. Raises EvaluationError or SourceError."""
    name, truth = sequence_name(path), ground_truth(path)
    if not environment:
        raise EvaluationError(f'say what kind of place {name} is, such as --environment "{name}=residential home"')
    return Dataset(name, path, truth, _prior(environment, task, truth), read_objects(path, open_source(path).origin_m))


def of_world(name: WorldName, task: str) -> Dataset:
    """A generated world. Raises EvaluationError."""
    from prior_sg.deploy.evaluation.worlds import world_of

    try:
        world = world_of(name.kind, name.seed)
    except ValueError as error:
        raise EvaluationError(str(error)) from error
    prior = _prior(world.environment, task, world.truth)
    return Dataset(world.name, Path(world.name), world.truth, prior, tuple(world.objects), name, world.outdoors)


def named_worlds(text: str) -> list[WorldName]:
    """The worlds of `world:KIND:SEEDS`, with SEEDS such as `3`, `0-9` or `1,4,7`. Raises EvaluationError."""
    from prior_sg.deploy.evaluation.worlds import KINDS

    kind, _, seeds = text.removeprefix(WORLD).partition(":")
    if kind not in KINDS:
        raise EvaluationError(f"there is no kind of world {kind!r}: choose from {', '.join(KINDS)}")
    chosen = seeds_of(seeds)
    if not chosen:
        raise EvaluationError(f"{text} names no seeds: write world:{kind}:3, world:{kind}:0-9 or world:{kind}:1,4,7")
    return [WorldName(kind, seed) for seed in chosen]


def seeds_of(text: str) -> tuple[int, ...]:
    """The seeds of `3`, `0-9` or `1,4,7`, each once; none where the text names none."""
    try:
        ranges = [part.partition("-") for part in text.split(",")]
        named = [seed for low, _, high in ranges for seed in range(int(low), int(high or low) + 1)]
    except ValueError:
        return ()
    return tuple(dict.fromkeys(named))


def world_source(name: WorldName, walk: "Manner" = "scanner") -> Source:
    """The frames of a world as a recording of it would have them, with depth and a blank colour image."""
    from prior_sg.deploy.evaluation.worlds import views_of, world_of

    world = world_of(name.kind, name.seed, walk)
    camera = world.intrinsics

    def frames() -> Iterator[RawFrame]:
        color = _png(np.zeros((camera.height_px, camera.width_px), np.uint8))
        for index, view in enumerate(views_of(world)):
            units = np.clip(np.rint(view.depth_m / MILLIMETRE), 0, np.iinfo(np.uint16).max - 1).astype(np.uint16)
            yield RawFrame(
                frame_id=index,
                stamp_ns=view.stamp_ns,
                intrinsics=camera,
                world_from_camera=view.world_from_camera,
                color=color,
                depth=_png(units),
                depth_scale_m=MILLIMETRE,
                index=index,
                total=0,
            )

    return Source("world", Path(world.name), camera, 0, frames)


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


def _prior(environment: str, task: str, truth: GroundTruth) -> Prior:
    return library_prior(environment, task, list(dict.fromkeys(region.label for region in truth.regions)))


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
