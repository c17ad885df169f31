"""Worlds as an explorer with a prior meets them: what it takes regions for, and what it could foresee when."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from prior_sg.deploy.evaluation.foresight.explorer import Explorer, Frontiers, Plan, crossings, plan_of, starts_of
from prior_sg.deploy.evaluation.foresight.surroundings import surroundings
from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.deploy.evaluation.worlds import KINDS, world_of
from prior_sg.deploy.evaluation.worlds.plan import Unbuildable
from prior_sg.deploy.settings import DEMO_TASK
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.segmenter.core.foresight.beyond import Views
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import Found

ERRORS = 0.15  # share of the regions that are taken for another label
SURE = 0.85  # belief of the label that a region is taken for
FOUND_M2 = 2.0  # seen of a region before it is recognised: what a look through a door shows is not yet a region
DRAWS = 40  # plans of a kind that make its vocabulary; none of them is a world that is judged
SAME = -1  # what an opening reveals: more of the region that it opens from
MOST_DECISIONS = 250


@dataclass(frozen=True, eq=False)
class Trial:
    """One world, its prior, and what its regions are taken for."""

    kind: str
    seed: int
    plan: Plan
    prior: Prior
    labels: np.ndarray  # (region,) true label, as a number of the prior's regions, -1 = the prior lacks it
    taken: np.ndarray  # (region,) what it is taken for
    crossings: tuple[np.ndarray, np.ndarray]  # nodes on both sides of borders
    starts: np.ndarray

    def random(self, purpose: int) -> np.random.Generator:
        """Random numbers of this trial."""
        return np.random.default_rng([zlib.crc32(self.kind.encode()), self.seed, purpose])

    def found(self, explorer: Explorer, seen_m2: np.ndarray) -> Found:
        """What the explorer has found so far."""
        count = len(self.prior.regions)
        here = seen_m2 >= FOUND_M2
        regions = np.bincount(self.taken[here], minlength=count).astype(float)
        a, b = self.crossings
        met = explorer.known[a] & explorer.known[b]
        pairs = np.unique(np.sort(np.stack((self.plan.regions[a[met]], self.plan.regions[b[met]]), axis=1)), axis=0)
        pairs = pairs[here[pairs].all(axis=1)].reshape(-1, 2)
        borders = np.zeros((count, count))
        one, other = self.taken[pairs].T
        np.add.at(borders, (one, other), 1)
        np.add.at(borders, (other, one), one != other)
        return Found(regions, borders)

    def origins(self, explorer: Explorer, frontiers: Frontiers, seen_m2: np.ndarray) -> np.ndarray:
        """The region (frontier,) that each opens from: its own, or, while that is not recognised yet, the recognised
        one that most of its seen border is with."""
        found = seen_m2 >= FOUND_M2
        a, b = self.crossings
        met = explorer.known[a] & explorer.known[b]
        sides = np.stack((self.plan.regions[a[met]], self.plan.regions[b[met]]), axis=1)
        sides = np.concatenate((sides, sides[:, ::-1]))
        sides = sides[~found[sides[:, 0]] & found[sides[:, 1]]]
        origin = np.arange(len(self.labels))
        for region in np.unique(sides[:, 0]).tolist():
            origin[region] = np.bincount(sides[sides[:, 0] == region, 1]).argmax()
        return origin[frontiers.regions]

    def views(
        self,
        explorer: Explorer,
        frontiers: Frontiers,
        origins: np.ndarray,
        seen_m2: np.ndarray,
        cfg: ForesightConfig = ForesightConfig(),
    ) -> Views:
        """The openings of one moment."""
        count = len(self.prior.regions)
        beliefs = np.full((len(origins), count), (1 - SURE) / max(count - 1, 1))
        beliefs[np.arange(len(beliefs)), self.taken[origins]] = SURE
        around = surroundings(explorer, frontiers, origins, self.crossings, found=seen_m2 >= FOUND_M2, cfg=cfg)
        return Views(beliefs, frontiers.widths_m, seen_m2[origins], around)


@dataclass(frozen=True)
class Moment:
    """All openings at one moment of a walk, and what each reveals."""

    views: Views
    found: Found
    outcomes: np.ndarray  # (opening,) SAME or the label of another region
    met: np.ndarray  # (opening, label) bool: such a region, not found yet, begins within REACH_M
    left: np.ndarray  # (label,) bool: one more region of it is to be found
    led: np.ndarray | None = None  # (opening,) bool: something unseen to stand on is behind; None = behind all
    ways: tuple[np.ndarray, np.ndarray] | None = None  # (label,) and (label,), as `ways_left` tells; None = not asked


@lru_cache(32)
def vocabulary(kind: str) -> dict[str, tuple[str, ...]]:
    """Labels that plans of a kind hold, by the environment's name."""
    found: dict[str, dict[str, None]] = {}
    for draw in range(DRAWS):
        try:
            plan = KINDS[kind](np.random.default_rng([zlib.crc32(kind.encode()), draw]))
        except Unbuildable:
            continue
        found.setdefault(plan.environment, {}).update(dict.fromkeys(room.label for room in plan.rooms))
    return {environment: tuple(sorted(labels)) for environment, labels in found.items()}


@lru_cache(32)
def prior_of(kind: str, environment: str) -> Prior:
    """The library's, for all labels that such worlds may hold."""
    return library_prior(environment, DEMO_TASK, list(vocabulary(kind)[environment]))


def trial(kind: str, seed: int, errors: float = ERRORS) -> Trial:
    """One world. Raises ValueError."""
    world = world_of(kind, seed)
    plan = plan_of(world)
    prior = prior_of(kind, world.environment)
    numbers = {region.name: number for number, region in enumerate(prior.regions)}
    labels = np.array([numbers.get(label, -1) for label in plan.labels], np.int64)
    rng = np.random.default_rng([zlib.crc32(kind.encode()), seed, 7])
    other = rng.integers(len(prior.regions), size=len(labels))
    taken = np.where((rng.random(len(labels)) < errors) | (labels < 0), other, labels)
    return Trial(kind, seed, plan, prior, labels, taken, crossings(plan), starts_of(plan))


def moments(one: Trial) -> Iterator[Moment]:
    """An exploration, always to the nearest frontier, until nothing is left."""
    explorer = Explorer(one.plan, int(one.random(1).choice(one.starts)))
    for _ in range(MOST_DECISIONS):
        cost, before = explorer.reach()
        frontiers = explorer.frontiers(cost)
        if not len(frontiers.targets):
            return
        yield moment_of(one, explorer, frontiers)
        go(explorer, before, frontiers, int(frontiers.steps.argmin()))


def moment_of(one: Trial, explorer: Explorer, frontiers: Frontiers) -> Moment:
    """What the frontiers of a moment reveal."""
    seen_m2 = explorer.seen_m2()
    revealed = np.array([explorer.revealed(nodes) for nodes in frontiers.nodes], np.int64)
    known = revealed != NO_REGION
    origins = one.origins(explorer, frontiers, seen_m2)
    outcomes = np.where(revealed == origins, SAME, np.where(known, one.labels[revealed], SAME))
    kept = np.flatnonzero(known & (one.labels[np.maximum(revealed, 0)] >= 0))
    views = one.views(explorer, frontiers, origins, seen_m2)
    count = len(one.prior.regions)
    walkable = np.isin(np.arange(len(one.labels)), one.plan.regions[one.starts])
    new = (seen_m2 < FOUND_M2) & (one.labels >= 0) & walkable
    openings = [frontiers.nodes[at] for at in kept.tolist()]
    met = np.zeros((len(kept), count), bool)
    for row, nodes in enumerate(openings):
        regions = explorer.met(nodes)
        met[row, one.labels[regions[new[regions]]]] = True
    return Moment(
        Views(views.beliefs[kept], views.widths_m[kept], views.areas_m2[kept], views.around.of(kept)),
        one.found(explorer, seen_m2),
        outcomes[kept],
        met,
        np.bincount(one.labels[new], minlength=count) > 0,
        ways=ways_left(explorer, openings, np.where(new, one.labels, -1), count),
    )


def ways_left(
    explorer: Explorer, openings: list[np.ndarray], labels: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The opening (label,) through which one comes to the nearest region of each of `count` labels that is left, -1 =
    through none, and the unseen way from there in metres (label,). `labels` (region,) are those of regions that are
    left, -1 of others; `openings` are the nodes of each."""
    toward, deep_m = np.full(count, -1), np.full(count, np.inf)
    if not openings:
        return toward, deep_m
    through, ways_m = explorer.toward(openings)
    for region in np.flatnonzero((labels >= 0) & (through >= 0)).tolist():
        if ways_m[region] < deep_m[labels[region]]:
            toward[labels[region]], deep_m[labels[region]] = through[region], ways_m[region]
    return toward, deep_m


def go(explorer: Explorer, before: np.ndarray, frontiers: Frontiers, at: int) -> None:
    """Walk to a frontier; one that stays open even from there is a place that cannot be looked into, and is let be."""
    explorer.walk(before, int(frontiers.targets[at]), frontiers.nodes[at])
    if explorer.node == frontiers.targets[at] and explorer.open(frontiers.nodes[at]):
        explorer.close(frontiers.nodes[at])
