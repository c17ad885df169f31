"""`prior-sg bench learning --worlds KIND`: does a prior that is wrong about the world come right in generated worlds?

The worlds are those of one kind, of the generator that `prior-sg eval` takes. A robot explores some of them, each
labelled under the prior as revised so far; others are segmented before and after. The prior in hand is the library's
for all labels of those worlds, once as it is and once half wrong: half of the regions have exchanged objects,
neighbours and frequencies. Looks come from a simulated encoder. Of the objects in view, which are named as the
generator names them, a detector that is simulated, too, misses some and mistakes some.
"""

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.benches.homes import Sight, exchanged
from prior_sg.deploy.benches.learning import EXPLORED, LEARNING, MOST_TICKS
from prior_sg.deploy.evaluation import oracles
from prior_sg.deploy.evaluation.datasets import Dataset, WorldName, of_world
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.methods import labelling, put_in_force, scene_of
from prior_sg.deploy.evaluation.metrics import evaluate
from prior_sg.deploy.evaluation.perception import CACHE, Perception, simulated_perception
from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.schemas.priors import Prior, PriorEvidence
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PLACE_DELTA, PYRAMID
from prior_sg.services.prior_gateway.core import learning
from prior_sg.services.segmenter.core import prior_evidence
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.inference import see_objects

TASK = "find the way around"
SIGHT = Sight(lookalike=0.0, detected=0.8, mistaken=0.15)  # of the detector; looks are the encoder's
SEEDS = tuple(range(60, 70)), tuple(range(70, 76))  # of the worlds to explore, of those to test
ENCODER = "simlike:0.4"  # most like a real encoder, see `simulated`
HANDS = {"": True, "_right": False}  # by the suffix of their figures: whether the prior in hand is half wrong
LEAST_TESTED = 2  # for a standard error
CFG = Config(evidence_ticks=0)

Say = Callable[[str], None]


@dataclass(frozen=True)
class SeenWorld:
    """One world as a robot saw it."""

    dataset: Dataset
    perception: Perception
    objects: ObjectView


def learning_worlds_bench(
    kind: str,
    say: Say,
    seeds: tuple[Sequence[int], Sequence[int]] = SEEDS,
    encoder: str = ENCODER,
    folder: Path = CACHE,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """F1_S of the tested worlds after some explored ones, and the gain of each over none: mean, standard error, least.

    `seeds` are those of the worlds to explore and of those to test; `folder` keeps perceptions. Raises EvaluationError
    for a kind that does not exist, ValueError for what is no simulated encoder.
    """
    environment, names = vocabulary(kind, [*seeds[0], *seeds[1]])
    right = library_prior(environment, TASK, names)
    explored, tested = (
        [seen_world(WorldName(kind, seed), right, encoder, folder, say) for seed in each] for each in seeds
    )
    pairs = exchanged_pairs(names)
    metrics: dict[str, Any] = {}
    for suffix, wrong in HANDS.items():
        prior = exchanged(right, pairs, np.random.default_rng(seeds[0][0])) if wrong else right
        priors = learnt(explored, prior, lambda text, hand=suffix: say(f"{kind}{hand}: {text}"))  # type: ignore[misc]
        scores = {n: f1_s(tested, priors[n]) for n in EXPLORED if n < len(priors)}
        metrics |= {name + suffix: value for name, value in figures(scores).items()}
        say(f"{kind}{suffix}: F1_S {' / '.join(f'{statistics.mean(found):.3f}' for found in scores.values())}")
    settings = {"kind": kind, "encoder": encoder, "explored": list(seeds[0]), "tested": list(seeds[1])}
    return metrics, settings | {"regions": len(names), "exchanged_pairs": pairs, "strength": LEARNING.strength}


def parted(seeds: Sequence[int]) -> tuple[Sequence[int], Sequence[int]]:
    """Seeds of the worlds to explore, as many as are scored after, and of those to test. Raises EvaluationError."""
    explored, tested = seeds[: max(EXPLORED)], seeds[max(EXPLORED) :]
    if len(tested) < LEAST_TESTED:
        raise EvaluationError(
            f"{len(seeds)} seeds are too few: {max(EXPLORED)} worlds are explored and {LEAST_TESTED} or more tested, "
            "such as --seeds 0-15"
        )
    return explored, tested


def exchanged_pairs(names: Sequence[str]) -> int:
    """Pairs of regions that make half of all, as nearly as pairs can."""
    return max(1, round(len(names) / 4))


def figures(scores: Mapping[int, Sequence[float]]) -> dict[str, float]:
    """Means over the worlds of F1_S (world,) by number of explored worlds, and what the largest number gains."""
    gains = np.subtract(scores[max(scores)], scores[0])
    return {f"f1_s_{number}": statistics.mean(found) for number, found in scores.items()} | {
        "f1_s_gain": float(gains.mean()),
        "f1_s_gain_se": float(gains.std(ddof=1) / len(gains) ** 0.5),
        "f1_s_gain_least": float(gains.min()),
    }


def vocabulary(kind: str, seeds: Iterable[int]) -> tuple[str, list[str]]:
    """Environment and labels of some worlds."""
    datasets = [of_world(WorldName(kind, seed), TASK) for seed in seeds]
    names = dict.fromkeys(region.label for dataset in datasets for region in dataset.truth.regions)
    return datasets[0].prior.environment, list(names)


def seen_world(name: WorldName, prior: Prior, encoder: str, folder: Path, say: Say) -> SeenWorld:
    """A world with what is seen of it; `prior` names the objects that are looked for."""
    dataset = of_world(name, TASK)
    say(f"{dataset.name}: seen by {encoder}")
    perception = simulated_perception(dataset, encoder, folder=folder)
    view = oracles.seen_objects(dataset.objects, prior, perception.voxels)
    return SeenWorld(dataset, perception, mistaken(view, SIGHT, np.random.default_rng(name.seed)))


def mistaken(view: ObjectView, sight: Sight, rng: np.random.Generator) -> ObjectView:
    """What a detector makes of the objects in view: it misses some and takes some for others."""
    kept = np.flatnonzero(rng.uniform(size=len(view.ids)) < sight.detected)
    kinds = view.concepts.shape[1]
    wrong = rng.uniform(size=len(kept)) < sight.mistaken
    taken_for = np.where(wrong, rng.integers(0, kinds, len(kept)), view.concepts[kept].argmax(axis=1))
    concepts = np.full((len(kept), kinds), sight.mistaken / (kinds - 1))
    concepts[np.arange(len(kept)), taken_for] = 1 - sight.mistaken
    return ObjectView(np.arange(len(kept)), view.positions_m[kept], concepts)


def learnt(explored: Sequence[SeenWorld], prior: Prior, say: Say) -> list[Prior]:
    """The prior after 0, 1, 2, ... worlds, each labelled under the one before and seen by another robot."""
    priors, seen = [prior], list[PriorEvidence]()
    for world in explored:
        say(f"learning from {world.dataset.name}")
        told = segmented(world, priors[-1])[1]
        seen += [told] if told is not None else []
        shown = learning.estimate(prior, seen, LEARNING)
        priors.append(learning.revised(prior, shown.totals, LEARNING.strength, prior.provenance, shown.looks))
    return priors


def f1_s(worlds: Sequence[SeenWorld], prior: Prior) -> list[float]:
    """F1_S (world,) under a prior."""
    scenes = [segmented(world, prior)[0] for world in worlds]
    return [
        evaluate(scene, world.perception.voxels, world.dataset.truth)["f1_s"]
        for world, scene in zip(worlds, scenes, strict=True)
    ]


def segmented(world: SeenWorld, prior: Prior) -> tuple[Scene, PriorEvidence | None]:
    """The world's scene under a prior once the segmenter rests, and what it tells of the prior."""
    seen = world.perception
    config, robot = msgspec.structs.replace(CFG, space=seen.space), seen.places.robot
    with labelling(config, robot, seen.text) as pipeline:
        pipeline.publish(PLACE_DELTA, seen.places)
        for pyramid in seen.pyramids:
            pipeline.publish(PYRAMID, pyramid)
        segmenter = pipeline.of("segmenter")
        see_objects(segmenter.state, world.objects, config)
        put_in_force(pipeline, robot, prior)
        for stamp_ns in range(1, MOST_TICKS):
            pipeline.feed(segmenter, Tick(stamp_ns=stamp_ns))
            if not segmenter.state.labelling.dirty:
                break
        told = prior_evidence.evidence(segmenter.state, config)
        scene = scene_of(pipeline, robot)
    return scene, told and msgspec.structs.replace(told, robot=world.dataset.name.replace(":", "-"))
