"""`prior-sg bench learning`: does a prior that is wrong about the world come right while robots explore homes?

The prior in hand is the library's. In each world some pairs of regions have exchanged their objects, neighbours and
frequencies, or none, where learning must do no harm. Robots explore home after home, each labelled by the segmenter
under the prior as revised so far; what the segmenter sees revises it. Other homes of the same world, the same for every
prior, give F1_S.
"""

import statistics
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.benches import homes
from prior_sg.deploy.benches.homes import ROBOT, WIDTH, Home, Sight
from prior_sg.deploy.evaluation.metrics import Overlap, scores_of
from prior_sg.deploy.settings import DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.schemas.features import TextRequest
from prior_sg.schemas.priors import Prior, PriorEvidence, Task
from prior_sg.schemas.status import Tick
from prior_sg.services.prior_gateway.core import learning
from prior_sg.services.prior_gateway.core.config import Config as GatewayConfig
from prior_sg.services.prior_gateway.outside import library
from prior_sg.services.segmenter.core import inference, prior_evidence, update
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.regions.components import numbered
from prior_sg.services.segmenter.core.state import State, empty

REGIONS = [
    *("kitchen", "dining room", "living room", "bedroom", "bathroom", "hallway"),
    *("home office", "laundry room", "garage", "balcony", "pantry", "entrance"),
]
EXPLORED = (0, 1, 3, 10)
WORLDS = 8
EXCHANGED_PAIRS = 3  # half of the regions
TEST_HOMES = 8  # of each world
TRUTH_HOMES = 3_000  # in which the frequency of touching is counted
GROSS = 0.3  # entries of containment by which the prior in hand is wrong at least
SIGHTS = {  # by the suffix of their figures; the main one gives about the F1_S of the sample home
    "": Sight(lookalike=1.1, detected=0.8, mistaken=0.15),
    "_dim": Sight(lookalike=1.5, detected=0.8, mistaken=0.15),
}
HANDS = {"": EXCHANGED_PAIRS, "_right": 0}  # by the suffix of their figures: how many pairs the prior in hand has wrong
LEARNING = learning.LearningConfig()
CFG = Config(evidence_ticks=0)
MOST_TICKS = 8  # until a segmenter rests


def learning_bench(worlds: int = WORLDS, first: int = 0) -> tuple[dict[str, Any], dict[str, Any]]:
    """Errors of the matrices and F1_S after some homes, means and standard deviations over worlds, which have the seeds
    from `first` on; and the least gain of any."""
    found: dict[str, list[float]] = {}
    for seed in range(first, first + worlds):
        for suffix, sight in SIGHTS.items():
            for hand, pairs in HANDS.items():
                for name, value in World(seed, sight, pairs).run().items():
                    found.setdefault(name + suffix + hand, []).append(value)
    metrics: dict[str, Any] = {name: statistics.mean(values) for name, values in found.items()}
    metrics |= {f"{name}_sd": statistics.stdev(values) for name, values in found.items()}
    metrics |= {f"{name}_least": min(values) for name, values in found.items() if name.startswith("f1_s_gain")}
    settings = {"worlds": worlds, "first": first, "test_homes": TEST_HOMES, "rooms": WIDTH**2, "regions": len(REGIONS)}
    return metrics, settings | {"exchanged_pairs": EXCHANGED_PAIRS, "strength": LEARNING.strength}


def prior_in_hand() -> Prior:
    """The library's, for fixed regions."""
    task = Task(robot=ROBOT, stamp_ns=1, environment=DEMO_ENVIRONMENT, task=DEMO_TASK, regions=REGIONS)
    return library.load().answer(task, GatewayConfig())


class World:
    """Homes that differ from the prior in hand."""

    def __init__(self, seed: int, sight: Sight, pairs: int) -> None:
        self.sight, self.rng = sight, np.random.default_rng(seed)
        self.prior = prior_in_hand()
        self.truth = homes.exchanged(self.prior, pairs, self.rng)
        sample = homes.layouts(self.truth, TRUTH_HOMES, self.rng)
        self.adjacency = homes.touching_frequency(sample, len(REGIONS))
        self.test = [self._home(labels) for labels in homes.layouts(self.truth, TEST_HOMES, self.rng)]
        self.explored = [self._home(labels) for labels in homes.layouts(self.truth, max(EXPLORED), self.rng)]
        self.states = [explore(home) for home in self.test]

    def _home(self, labels: np.ndarray) -> Home:
        return homes.home(labels, self.truth, self.sight, CFG.space, self.rng)

    def run(self) -> dict[str, float]:
        """Figures after each number of homes, and what the true prior would give: without counts, and with those."""
        priors, metrics = self.learnt(), dict[str, float]()
        for number in EXPLORED:
            figures = self.errors(priors[number]) | {"f1_s": self.f1(priors[number])}
            metrics |= {f"{name}_{number}": value for name, value in figures.items()}
        metrics["f1_s_gain"] = metrics[f"f1_s_{max(EXPLORED)}"] - metrics["f1_s_0"]
        true = msgspec.structs.replace(self.truth, adjacency=self._statable())
        metrics["f1_s_true"] = self.f1(true)
        metrics["f1_s_true_counted"] = self.f1(msgspec.structs.replace(true, tested=priors[-1].tested))
        return metrics

    def _statable(self) -> np.ndarray:
        """The true frequencies as a prior may state them."""
        known = np.where(np.isfinite(self.adjacency), self.adjacency, self.truth.adjacency)
        return np.clip(known, learning.LEAST, learning.MOST).astype(np.float32)

    def learnt(self) -> list[Prior]:
        """The prior after 0, 1, 2, ... homes, each seen by another robot."""
        priors, seen = [self.prior], list[PriorEvidence]()
        for number, home in enumerate(self.explored):
            state = explore(home)
            label(state, home, priors[-1])
            told = prior_evidence.evidence(state, CFG)
            seen += [] if told is None else [msgspec.structs.replace(told, robot=f"{ROBOT}{number}")]
            shown = learning.estimate(self.prior, seen, LEARNING)
            strength, made = LEARNING.strength, self.prior.provenance
            priors.append(learning.revised(self.prior, shown.totals, strength, made, shown.looks))
        return priors

    def errors(self, prior: Prior) -> dict[str, float]:
        """Of a prior's entries, see `errors`."""
        return errors(prior, self.prior, self.truth, self.adjacency)

    def f1(self, prior: Prior) -> float:
        """Mean F1_S of the test homes."""
        scores = []
        for home, state in zip(self.test, self.states, strict=True):
            label(state, home, prior)
            scores.append(f1_s(home.truth, state))
        return statistics.mean(scores)


def errors(prior: Prior, in_hand: Prior, truth: Prior, adjacency: np.ndarray) -> dict[str, float]:
    """Mean absolute errors of a prior's entries; of adjacency (region, region), NaN = never met, those between
    different regions; of containment as well those by which the prior in hand is wrong by GROSS, if there are any."""
    met = np.isfinite(adjacency) & ~np.eye(len(adjacency), dtype=bool)
    gross = np.abs(in_hand.containment - truth.containment) >= GROSS
    held = np.abs(prior.containment - truth.containment)
    ours, theirs = ([region.existence for region in one.regions] for one in (prior, truth))
    found = {
        "containment_error": float(held.mean()),
        "adjacency_error": float(np.abs(prior.adjacency - adjacency)[met].mean()),
        "existence_error": float(np.abs(np.subtract(ours, theirs)).mean()),
    }
    return found | ({"containment_error_gross": float(held[gross].mean())} if gross.any() else {})


def explore(home: Home) -> State:
    """A segmenter that has seen all of a home, before any prior."""
    state = empty(CFG, ROBOT, 1)
    for message in (home.places, *home.pyramids):
        list(update.update(state, message, CFG))
    return state


def label(state: State, home: Home, prior: Prior) -> None:
    """Put a prior in force and let the segmenter come to rest."""
    task = Task(robot=ROBOT, stamp_ns=1, environment=prior.environment, task=prior.task, regions=prior.vocabulary)
    for message in (task, prior):
        for output in list(update.update(state, message, CFG)):
            if isinstance(output, TextRequest):
                list(update.update(state, homes.text(output, prior), CFG))
    assert state.aim.in_force is not None and state.aim.in_force.digest == prior.digest()
    inference.see_objects(state, home.objects, CFG)
    for stamp_ns in range(1, MOST_TICKS):
        list(update.update(state, Tick(stamp_ns=stamp_ns), CFG))
        if not state.labelling.dirty:
            return


def f1_s(truth: np.ndarray, state: State) -> float:
    """F1_S of the regions; every place stands for the same volume. `truth` (place,) labels."""
    places = state.map.places
    true_ids = numbered(truth, state.map.graph.edges)
    _, rows = np.unique(places.regions, return_inverse=True)
    shared = np.zeros((rows.max() + 1, true_ids.max() + 1), np.int64)
    np.add.at(shared, (rows, true_ids), 1)
    same = np.zeros(shared.shape, bool)
    same[rows, true_ids] = places.labels == truth  # a region has one label, so every place of a pair says the same
    return scores_of(Overlap(shared, shared.sum(axis=1), shared.sum(axis=0), same), same)["f1"]
