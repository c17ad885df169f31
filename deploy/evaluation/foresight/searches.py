"""Searches for a named region that has not been seen: metres walked, by who chooses the next opening."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from prior_sg.deploy.evaluation.foresight.explorer import Explorer, Frontiers
from prior_sg.deploy.evaluation.foresight.trials import FOUND_M2, MOST_DECISIONS, Moment, Trial, go, moment_of
from prior_sg.deploy.evaluation.worlds.ways import CELL_M
from prior_sg.services.exploring import chances_per_metre
from prior_sg.services.segmenter.core.foresight.beyond import beyond
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import expected
from prior_sg.services.segmenter.core.foresight.telling import DIGITS, told_labels

STRAIGHT = 5  # cost of a straight step of one cell
STRAYING = 0.3  # of the decisions of searches that are learned from: so many are for the nearest
GOAL_SHARE = 0.5  # of a region too small to be recognised otherwise, seen: it is found


@dataclass(frozen=True)
class Quest:
    """A region that is looked for, and where from."""

    trial: Trial
    goal: int  # label
    start: int  # node


@dataclass(frozen=True)
class Sight:
    """What a policy may choose by."""

    quest: Quest
    explorer: Explorer
    frontiers: Frontiers
    seen_m2: np.ndarray
    rng: np.random.Generator
    cfg: ForesightConfig


Policy = Callable[[Sight], int]


def ours(sight: Sight) -> int:
    """The largest chance by metre of those that the product tells planners; the nearest where it tells none."""
    one, cfg = sight.quest.trial, sight.cfg
    expectation = expected(one.prior, one.found(sight.explorer, sight.seen_m2), cfg)
    origins = one.origins(sight.explorer, sight.frontiers, sight.seen_m2)
    foreseen = beyond(one.views(sight.explorer, sight.frontiers, origins, sight.seen_m2, cfg), expectation, cfg)
    ways_m = sight.frontiers.steps * CELL_M / STRAIGHT
    toward = np.where(told_labels(foreseen, cfg), foreseen.toward, 0.0)[:, sight.quest.goal].round(DIGITS)
    if toward.any():
        ways_m = np.where(toward > 0, ways_m, np.inf)
    return int(chances_per_metre(ways_m, toward, cfg.look_m).argmax())


POLICIES: dict[str, Policy] = {
    "ours": ours,
    "nearest": lambda sight: int(sight.frontiers.steps.argmin()),
    "largest": lambda sight: int(sight.frontiers.widths_m.argmax()),
    "random": lambda sight: int(sight.rng.integers(len(sight.frontiers.targets))),
}


def quests(one: Trial, count: int) -> list[Quest]:
    """Different goals of one world, none of them seen at the start; fewer where there are not so many."""
    rng = one.random(2)
    found: list[Quest] = []
    for _ in range(10 * count):
        start = int(rng.choice(one.starts))
        seen_m2 = Explorer(one.plan, start).seen_m2()
        reachable = np.unique(one.plan.regions[one.starts])
        seen = {int(label) for label in one.labels[seen_m2 > 0]}
        goals = sorted(
            {int(one.labels[region]) for region in reachable} - seen - {quest.goal for quest in found} - {-1}
        )
        if goals:
            found.append(Quest(one, int(rng.choice(goals)), start))
        if len(found) == count:
            break
    return found


def metres(quest: Quest, policy: Policy, cfg: ForesightConfig) -> float:
    """Metres walked until enough of the goal has been seen; those of the whole walk where it never is."""
    explorer = Explorer(quest.trial.plan, quest.start)
    for _ in sights(quest, explorer, policy, cfg):
        pass
    return explorer.walked_m


def searched(one: Trial, count: int, cfg: ForesightConfig) -> Iterator[Moment]:
    """What openings reveal at each decision of so many searches, some of which stray."""
    for quest in quests(one, count):
        explorer = Explorer(one.plan, quest.start)
        for sight in sights(quest, explorer, _straying, cfg):
            yield moment_of(one, explorer, sight.frontiers)


def _straying(sight: Sight) -> int:
    """Ours, or sometimes the nearest, so that moments are seen that a search seldom comes to."""
    return POLICIES["nearest"](sight) if sight.rng.random() < STRAYING else ours(sight)


def sights(quest: Quest, explorer: Explorer, policy: Policy, cfg: ForesightConfig) -> Iterator[Sight]:
    """Each decision of a search, before the explorer goes where the policy chooses."""
    one = quest.trial
    whole_m2 = np.bincount(one.plan.regions[one.starts], minlength=len(one.labels)) * CELL_M**2
    enough_m2 = np.minimum(FOUND_M2, GOAL_SHARE * whole_m2)
    goals = np.flatnonzero((one.labels == quest.goal) & (whole_m2 > 0))
    rng = one.random(3)
    for _ in range(MOST_DECISIONS):
        seen_m2 = explorer.seen_m2()
        if (seen_m2[goals] >= enough_m2[goals]).any():
            break
        cost, before = explorer.reach()
        frontiers = explorer.frontiers(cost)
        if not len(frontiers.targets):
            break
        sight = Sight(quest, explorer, frontiers, seen_m2, rng, cfg)
        yield sight
        go(explorer, before, frontiers, policy(sight))
