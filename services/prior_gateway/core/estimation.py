"""What the maps of a fleet show of a prior, found without asking it what their regions are (beyond the paper; pure).

A map was labelled under the prior that it is to judge. Counting its labels confirms what the prior says: a kitchen that
the prior took for a bathroom speaks for stoves in bathrooms. So what each region of each map is stays open here, and is
estimated together with the prior by expectation-maximisation (Dempster et al., 1977) over all maps at once. It starts
from looks alone; then counting by belief and naming each region anew by looks, contents and neighbours take turns.

How much a statement of the prior is worth, in observed regions, is told by how well it foretold what was seen: of
STRENGTHS the one under which a region's counts are likeliest (beta-binomial). A row that is right stays firm, one that
is wrong gives way at once. An encoder is as sure of whole regions that it is wrong about as of others; what its looks
are worth is told likewise: of WORTHS the one under which regions, named by their looks, most likely hold what they do,
by what the other maps say of those names. No robot counts for more than a share of what all have seen.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import msgspec
import numpy as np
import scipy

from prior_sg.schemas.priors import Prior, PriorEvidence
from prior_sg.services.prior_gateway.core.turns import LEAST, MOST

STRENGTHS = (1 / 64, 1 / 16, 1 / 4, 1.0, 4.0, 16.0)  # times the first guess
MIXED = 0.1  # P(what is stated of a region is that of another)
DOUBT = 1.5  # standard deviation of the logarithm of such a factor
SAME = 0.1  # P(touching) of two regions of one name that were not taken for one
LEAST_SHARE = 1e-4
WORTHS = np.geomspace(1 / 8, 1.0, 19)  # of what looks weigh at their face value
LOOKS_DOUBT = 0.5  # standard deviation of the logarithm of what they are worth, about 1
FOLDS = 10  # of the maps, each judged by the others
TELLING = 5.0  # log odds of looks against names at random from which on contents know what looks are worth


class EstimationConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How the regions of maps are named anew."""

    looks: float = 2.0  # face value of what the average place of a region looks like, half of the visual expert's
    contents: float = 1.0  # of what it holds
    neighbours: float = 0.5  # of which regions it touches
    rounds: int = 12  # of naming and counting
    robot_share: float = 0.34  # of all observed regions that one robot brings at most, or its equal share if more

    def __post_init__(self) -> None:
        if not (min(self.looks, self.contents, self.neighbours) >= 0 and self.rounds >= 0):
            raise ValueError("looks, contents, neighbours or rounds is out of range")
        if not 0 < self.robot_share <= 1:
            raise ValueError("robot_share must lie between 0 and 1")


@dataclass(frozen=True)
class SeenMap:
    """One map in the order of a prior's regions and objects."""

    robot: str
    sizes: np.ndarray  # (piece,) places
    looks: np.ndarray  # (piece, region)
    contents: np.ndarray  # (piece, object)
    sought: np.ndarray  # (object,) 1 where a detector looked for it
    touching: np.ndarray  # (piece, piece) 0 or 1


@dataclass(frozen=True)
class Totals:
    """Counts over all maps, in the order of a prior's regions and objects."""

    maps: float
    shares: np.ndarray  # (region,) sum over maps of the region's share of the places
    instances: np.ndarray  # (region, object) regions of that name where the object was looked for
    holding: np.ndarray  # (region, object) of those, how many hold it
    pairs: np.ndarray  # (region, region)
    touching: np.ndarray  # (region, region)

    def __add__(self, other: "Totals") -> "Totals":
        pairs = zip(parts(self), parts(other), strict=True)
        return Totals(*(one + another for one, another in pairs))


@dataclass(frozen=True)
class Statements:
    """What a prior says, as probabilities."""

    existence: np.ndarray  # (region,)
    containment: np.ndarray  # (region, object)
    adjacency: np.ndarray  # (region, region)


def parts(totals: Totals) -> Iterator[Any]:
    """The counts in the order of their fields."""
    return (getattr(totals, each.name) for each in fields(totals))


@dataclass(frozen=True)
class Estimate:
    """What all maps show."""

    totals: Totals
    maps: list[SeenMap]
    beliefs: list[np.ndarray]  # of each map (piece, region): what its regions most likely are
    looks: float | None  # what looks are worth, of WORTHS; None where contents do not tell


def estimated(prior: Prior, evidence: Sequence[PriorEvidence], strength: float, cfg: EstimationConfig) -> Estimate:
    """Counts of all maps by what each of their regions most likely is; `strength` as in `revised_statements`.

    Maps from senders that tell of no single regions count by their labels, once.
    """
    weights = robot_weights(evidence, cfg.robot_share)
    whole = [one for one in evidence if not len(one.sizes)]
    fixed = counted_by_label(prior, whole, [weights[one.robot] for one in whole])
    maps = [seen for one in evidence if len(one.sizes) and (seen := seen_map(prior, one)) is not None]
    worth = [weights[seen.robot] for seen in maps]
    beliefs = [_shares(cfg.looks * seen.looks) for seen in maps]
    totals = fixed + counted(prior, maps, beliefs, worth)
    for _ in range(cfg.rounds if maps else 0):
        says = revised_statements(prior, totals, strength)
        beliefs = [named(seen, belief, says, cfg) for seen, belief in zip(maps, beliefs, strict=True)]
        totals = fixed + counted(prior, maps, beliefs, worth)
    scores = np.zeros(len(WORTHS) + 1)
    for fold in range(min(FOLDS, len(maps)) if len(maps) > 1 else 0):
        rest = [number for number in range(len(maps)) if number % FOLDS != fold]
        known = counted(prior, [maps[i] for i in rest], [beliefs[i] for i in rest], [worth[i] for i in rest])
        says = revised_statements(prior, fixed + known, strength)
        for number in range(fold, len(maps), FOLDS):
            scores += worth[number] * foretold(maps[number], says, cfg)
    return Estimate(totals, maps, beliefs, worth_of_looks(scores))


def foretold(seen: SeenMap, says: Statements, cfg: EstimationConfig) -> np.ndarray:
    """Log P (worth,) of what the regions of a map hold, where looks that are worth each of WORTHS, and last looks that
    are worth nothing, name them; `says` should know nothing of this map. Zeros where nobody looked for objects."""
    if not seen.sought.any():
        return np.zeros(len(WORTHS) + 1)
    scores = np.append(WORTHS, 0.0)[:, None, None] * cfg.looks * seen.looks + np.log(says.existence)
    scores -= scipy.special.logsumexp(scores, axis=2, keepdims=True)
    return np.asarray(scipy.special.logsumexp(scores + _held(seen, says), axis=2).sum(axis=1))


def worth_of_looks(scores: np.ndarray) -> float | None:
    """Of WORTHS the one of highest posterior, by `scores` as in `foretold`; None where naming regions by looks tells
    little of what they hold: then either may be at fault."""
    likely = scores[:-1] - 0.5 * (np.log(WORTHS) / LOOKS_DOUBT) ** 2
    return float(WORTHS[likely.argmax()]) if likely.max() - scores[-1] > TELLING else None


def robot_weights(evidence: Sequence[PriorEvidence], share: float) -> dict[str, float]:
    """Weight in (0, 1] of what each robot has seen, so that none brings more than `share` of all that counts; of few
    robots each may bring twice its equal share."""
    seen: dict[str, float] = defaultdict(float)
    for one in evidence:
        seen[one.robot] += float(len(one.sizes) or one.instances.sum())
    most = _most(sorted(seen.values()), min(1.0, max(share, 2 / max(len(seen), 1))))
    return {robot: min(1.0, most / amount) if amount > 0 else 1.0 for robot, amount in seen.items()}


def _most(amounts: list[float], share: float) -> float:
    """The largest amount of which one is `share` of the sum when all larger `amounts` (ascending) are cut to it."""
    for cut in range(len(amounts)):  # so many of the largest are larger
        kept = amounts[: len(amounts) - cut]
        most = share * sum(kept) / (1 - cut * share) if cut * share < 1 else 0.0
        if most >= kept[-1]:
            return most
    return amounts[0] if amounts else 0.0


def seen_map(prior: Prior, seen: PriorEvidence) -> SeenMap | None:
    """What a map told of its regions in the order of the prior's names; None where it knows none of its regions.

    A region of the prior that the map's prior did not name looks as unlike as the least like of those it did.
    """
    rows = {region.name: i for i, region in enumerate(prior.regions)}
    columns = {item.name: i for i, item in enumerate(prior.objects)}
    own = [i for i, name in enumerate(seen.regions) if name in rows]
    known = [i for i, name in enumerate(seen.objects) if name in columns]
    if not own:
        return None
    count = len(seen.sizes)
    looks = np.repeat(seen.looks[:, own].min(axis=1, keepdims=True).astype(float), len(rows), axis=1)
    looks[:, [rows[seen.regions[i]] for i in own]] = seen.looks[:, own]
    there = [columns[seen.objects[i]] for i in known]
    contents, sought = np.zeros((count, len(columns))), np.zeros(len(columns))
    contents[:, there], sought[there] = seen.contents[:, known], 1.0
    touching = np.zeros((count, count))
    touching[seen.links[:, 0], seen.links[:, 1]] = touching[seen.links[:, 1], seen.links[:, 0]] = 1.0
    np.fill_diagonal(touching, 0.0)
    return SeenMap(seen.robot, seen.sizes.astype(float), looks, contents, sought, touching)


def counted(prior: Prior, maps: Sequence[SeenMap], beliefs: Sequence[np.ndarray], weights: Sequence[float]) -> Totals:
    """Expected counts, where `beliefs` (piece, region) say what each region of each map is."""
    totals = nothing(prior)
    for seen, belief, weight in zip(maps, beliefs, weights, strict=True):
        together = belief.sum(axis=0)
        pairs = np.outer(together, together) - belief.T @ belief
        found = Totals(
            1.0,
            seen.sizes @ belief / seen.sizes.sum(),
            np.outer(together, seen.sought),
            belief.T @ seen.contents,
            pairs,
            belief.T @ seen.touching @ belief,
        )
        totals += Totals(*(weight * count for count in parts(found)))
    return totals


def counted_by_label(prior: Prior, evidence: Sequence[PriorEvidence], weights: Sequence[float]) -> Totals:
    """Counts by the labels that the maps were given; names that the prior does not know are left out."""
    rows = {region.name: i for i, region in enumerate(prior.regions)}
    columns = {item.name: i for i, item in enumerate(prior.objects)}
    totals = nothing(prior)
    for seen, weight in zip(evidence, weights, strict=True):
        own = [i for i, name in enumerate(seen.regions) if name in rows]
        places = seen.places[own].astype(float)
        if not places.sum():
            continue
        here = [rows[seen.regions[i]] for i in own]
        known = [i for i, name in enumerate(seen.objects) if name in columns]
        there = [columns[seen.objects[i]] for i in known]
        found = nothing(prior)
        found.shares[here] = places / places.sum()
        found.pairs[np.ix_(here, here)] = seen.pairs[np.ix_(own, own)]
        found.touching[np.ix_(here, here)] = seen.touching[np.ix_(own, own)]
        found.instances[np.ix_(here, there)] = seen.instances[own][:, None]
        found.holding[np.ix_(here, there)] = seen.holding[np.ix_(own, known)]
        totals += Totals(*(weight * count for count in parts(replace(found, maps=1.0))))
    return totals


def nothing(prior: Prior) -> Totals:
    """No counts."""
    regions, objects = len(prior.regions), len(prior.objects)
    held, touching = np.zeros((2, regions, objects)), np.zeros((2, regions, regions))
    return Totals(0.0, np.zeros(regions), *held, *touching)


def named(seen: SeenMap, belief: np.ndarray, says: Statements, cfg: EstimationConfig) -> np.ndarray:
    """Belief (piece, region) in what each region of a map is, the others being what `belief` says (mean field).

    Of neighbours those that touch count, against chance: that two regions do not is the rule in a map of many.
    """
    rates = says.adjacency.copy()
    np.fill_diagonal(rates, SAME)
    beside = seen.touching @ belief @ np.log(rates / (says.existence @ rates)[:, None])
    held = cfg.contents * _held(seen, says)
    return _shares(cfg.looks * seen.looks + np.log(says.existence) + held + cfg.neighbours * beside)


def _held(seen: SeenMap, says: Statements) -> np.ndarray:
    """Log P (piece, region) of what each region of a map holds, were it each of the prior's."""
    missing = seen.sought - seen.contents
    return np.asarray(seen.contents @ np.log(says.containment).T + missing @ np.log(1 - says.containment).T)


def revised_statements(prior: Prior, seen: Totals, strength: float) -> Statements:
    """Posterior means. Each row of containment is worth as many observed regions as make its counts likeliest, with
    `strength` as the first guess; so is each region's row of adjacency, and a pair as many as the weaker of its two."""
    existence = np.array([region.existence for region in prior.regions])
    existence = (strength * existence + seen.shares) / (strength + seen.maps)
    held, of_rows = likeliest_rows(prior.containment.astype(float), seen.instances, seen.holding, strength)
    touching, others = prior.adjacency.astype(float), 1 - np.eye(len(existence))
    of_ends = strengths(touching, seen.pairs * others, seen.touching * others, strength)[0]
    of_pairs = np.minimum.outer(of_ends, of_ends)
    held = (of_rows * held + seen.holding) / (of_rows + seen.instances)
    touching = (of_pairs * touching + seen.touching) / (of_pairs + seen.pairs)
    return Statements(np.maximum(existence, LEAST_SHARE), np.clip(held, LEAST, MOST), np.clip(touching, LEAST, MOST))


def likeliest_rows(
    stated: np.ndarray, trials: np.ndarray, hits: np.ndarray, guess: float
) -> tuple[np.ndarray, np.ndarray]:
    """What is stated of each region (region, object), and its strength (region, 1).

    Whoever wrote the prior may have mixed up regions: a row takes the place of another one where that foretold the
    other's counts so much better that MIXED, how often this happens, is outweighed.
    """
    strength, likely = strengths(stated, trials, hits, guess)
    source, regions = np.arange(len(stated)), len(stated)
    likely = likely + np.log(1 - MIXED)
    for shift in range(1, regions):
        other = np.roll(np.arange(regions), shift)
        its_strength, its_likely = strengths(stated[other], trials, hits, guess)
        better = its_likely + np.log(MIXED / (regions - 1)) > likely
        source[better], strength[better] = other[better], its_strength[better]
        likely = np.where(better, its_likely + np.log(MIXED / (regions - 1)), likely)
    return stated[source], strength[:, None]


def strengths(stated: np.ndarray, trials: np.ndarray, hits: np.ndarray, guess: float) -> tuple[np.ndarray, np.ndarray]:
    """Strength (row,) of each row of probabilities, among STRENGTHS times the guess, of highest posterior; and that
    (row,), as a logarithm without what is the same for all."""
    stated = np.clip(stated, LEAST, MOST)
    scores = []
    for factor in STRENGTHS:
        alpha, beta = factor * guess * stated, factor * guess * (1 - stated)
        likely = scipy.special.betaln(alpha + hits, beta + trials - hits) - scipy.special.betaln(alpha, beta)
        scores.append(likely.sum(axis=1) - 0.5 * (np.log(factor) / DOUBT) ** 2)
    return guess * np.array(STRENGTHS)[np.argmax(scores, axis=0)], np.max(scores, axis=0)


def _shares(scores: np.ndarray) -> np.ndarray:
    likely = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(likely / likely.sum(axis=1, keepdims=True))
