"""`python -m prior_sg.deploy.benches.learning_worlds`: `prior-sg bench learning` in generated worlds.

The robot explores worlds of one kind, of the generator that `prior-sg eval` takes, and other worlds are segmented
before and after. The prior in hand is the library's for all labels of those worlds, once as it is and once half wrong:
half of the regions have exchanged objects, neighbours and frequencies. Looks come from a simulated encoder; of the
objects in view a detector that is simulated, too, misses some and mistakes some.
"""

import argparse
import json
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.deploy.benches.homes import Sight, exchanged
from prior_sg.deploy.evaluation import oracles
from prior_sg.deploy.evaluation.datasets import Dataset, WorldName, of_world
from prior_sg.deploy.evaluation.methods import Case, Variant
from prior_sg.deploy.evaluation.metrics import evaluate
from prior_sg.deploy.evaluation.perception import CACHE, simulated_perception
from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.schemas.priors import Prior, PriorEvidence
from prior_sg.schemas.scene import Scene
from prior_sg.services.prior_gateway.core import learning
from prior_sg.services.segmenter.core import prior_evidence
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.inference import see_objects
from prior_sg.services.segmenter.core.state import State

TASK = "find the way around"
SIGHT = Sight(lookalike=0.0, detected=0.8, mistaken=0.15)  # of the detector; looks are the encoder's
EXPLORED = (0, 1, 3, 10)


@dataclass(frozen=True)
class SeenWorld:
    """One world as a robot saw it."""

    dataset: Dataset
    case: Case
    objects: ObjectView


def seen_worlds(kind: str, seeds: Iterable[int], encoder: str, prior: Prior, folder: Path) -> list[SeenWorld]:
    """Worlds with what is seen of them; `prior` names the objects that are looked for."""
    found = []
    for seed in seeds:
        dataset = of_world(WorldName(kind, seed), TASK)
        perception = simulated_perception(dataset, encoder, folder=folder)
        view = oracles.seen_objects(dataset.objects, prior, perception.voxels)
        case = Case(perception, prior, dataset.truth)
        found.append(SeenWorld(dataset, case, mistaken(view, SIGHT, np.random.default_rng(seed))))
    return found


def mistaken(view: ObjectView, sight: Sight, rng: np.random.Generator) -> ObjectView:
    """What a detector makes of the objects in view: it misses some and takes some for others."""
    kept = np.flatnonzero(rng.uniform(size=len(view.ids)) < sight.detected)
    kinds = view.concepts.shape[1]
    wrong = rng.uniform(size=len(kept)) < sight.mistaken
    taken_for = np.where(wrong, rng.integers(0, kinds, len(kept)), view.concepts[kept].argmax(axis=1))
    concepts = np.full((len(kept), kinds), sight.mistaken / (kinds - 1))
    concepts[np.arange(len(kept)), taken_for] = 1 - sight.mistaken
    return ObjectView(np.arange(len(kept)), view.positions_m[kept], concepts)


def segmented(world: SeenWorld, prior: Prior) -> tuple[Scene, PriorEvidence | None]:
    """The world's scene under a prior, and what it tells of the prior."""
    config, states = Config(), list[State]()

    def see(_: Case, state: State) -> None:
        states.append(state)
        see_objects(state, world.objects, config)

    scene = Variant(config, seen=see).run(replace(world.case, prior=prior))
    told = prior_evidence.evidence(states[0], msgspec.structs.replace(config, space=world.case.perception.space))
    robot = world.dataset.name.replace(":", "-")
    return scene, told and msgspec.structs.replace(told, robot=robot)


def f1_s(worlds: Sequence[SeenWorld], prior: Prior) -> list[float]:
    """F1_S of each world under a prior."""
    scenes = [segmented(world, prior)[0] for world in worlds]
    return [
        evaluate(scene, world.case.perception.voxels, world.dataset.truth)["f1_s"]
        for world, scene in zip(worlds, scenes, strict=True)
    ]


def learnt(explored: Sequence[SeenWorld], prior: Prior) -> list[Prior]:
    """The prior after 0, 1, 2, ... worlds, each labelled under the one before and seen by another robot."""
    cfg, priors, seen = learning.LearningConfig(), [prior], list[PriorEvidence]()
    for world in explored:
        told = segmented(world, priors[-1])[1]
        seen += [told] if told is not None else []
        shown = learning.estimate(prior, seen, cfg)
        priors.append(learning.revised(prior, shown.totals, cfg.strength, prior.provenance))
    return priors


def vocabulary(kind: str, seeds: Iterable[int]) -> tuple[str, list[str]]:
    """Environment and labels of some worlds."""
    datasets = [of_world(WorldName(kind, seed), TASK) for seed in seeds]
    names = dict.fromkeys(region.label for dataset in datasets for region in dataset.truth.regions)
    return datasets[0].prior.environment, list(names)


def measured(kind: str, explored: Sequence[int], tested: Sequence[int], encoder: str, folder: Path) -> dict[str, float]:
    """F1_S of the tested worlds after some explored ones, with a half wrong prior and with the library's."""
    environment, names = vocabulary(kind, [*explored, *tested])
    right = library_prior(environment, TASK, names)
    hands = {
        "wrong": exchanged(right, max(1, len(names) // 4), np.random.default_rng(explored[0])),
        "right": right,
    }
    seen = [seen_worlds(kind, seeds, encoder, right, folder) for seeds in (explored, tested)]
    figures: dict[str, float] = {"regions": len(names), "objects": len(right.objects)}
    for hand, prior in hands.items():
        priors = learnt(seen[0], prior)
        scores = {n: f1_s(seen[1], priors[n]) for n in EXPLORED if n < len(priors)}
        figures |= {f"{hand}_f1_s_{n}": statistics.mean(found) for n, found in scores.items()}
        gains = [after - before for after, before in zip(scores[max(scores)], scores[0], strict=True)]
        figures[f"{hand}_gain"] = statistics.mean(gains)
        figures[f"{hand}_gain_se"] = statistics.stdev(gains) / len(gains) ** 0.5
        figures[f"{hand}_gain_least"] = min(gains)
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", default="home")
    parser.add_argument("--explored", default="60-69", help="seeds of the worlds to explore, such as 60-69")
    parser.add_argument("--tested", default="70-75", help="seeds of those that are segmented before and after")
    parser.add_argument("--encoder", default="simlike:0.4")
    parser.add_argument("--cache", type=Path, default=CACHE)
    given = parser.parse_args()
    seeds = [range(int(low), int(high) + 1) for low, high in (s.split("-") for s in (given.explored, given.tested))]
    figures = measured(given.kind, list(seeds[0]), list(seeds[1]), given.encoder, given.cache)
    print(json.dumps({name: round(value, 4) for name, value in figures.items()}, indent=1))


if __name__ == "__main__":
    main()
