"""A prior corrected by what robots have seen (beyond the paper; pure).

Every probability of the prior is the mean of a Beta or Dirichlet distribution worth `strength` observations; counts add
to them. With n trials and k hits, P becomes (strength P + k) / (strength + n): a prior that nobody has tested stays as
it is, one that many homes contradict gives way. Counting starts from the prior before any revision, always with the
totals of all maps, so that nothing counts twice.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.schemas.priors import Prior, PriorEvidence, Provenance
from prior_sg.services.prior_gateway.core.turns import LEAST, MOST


class LearningConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How observations revise priors."""

    strength: float = 4.0  # observed regions that a statement of the prior is worth; see `prior-sg bench learning`
    automatic: bool = False  # publish a revised prior without being asked; regions change while the robot works
    least_maps: int = 3  # maps that must have been observed before a prior is revised automatically
    least_change: float = 0.2  # and by how much an entry must change
    told: int = 24  # disagreements shown to the model
    kept_maps: int = 256  # of each task; the oldest are forgotten

    def __post_init__(self) -> None:
        if not (self.strength > 0 and self.least_maps >= 1 and 0 < self.least_change < 1 and self.told >= 1):
            raise ValueError("strength, least_maps, least_change or told is out of range")


@dataclass(frozen=True)
class Totals:
    """Counts over all maps, in the order of a prior's regions and objects."""

    maps: int
    shares: np.ndarray  # (region,) sum over maps of the region's share of the places
    instances: np.ndarray  # (region,) regions of that name in maps where objects were looked for
    holding: np.ndarray  # (region, object)
    pairs: np.ndarray  # (region, region)
    touching: np.ndarray  # (region, region)


def totals(prior: Prior, evidence: Iterable[PriorEvidence]) -> Totals:
    """Counts that belong to the prior's names; names that it does not know are left out."""
    rows = {region.name: i for i, region in enumerate(prior.regions)}
    columns = {item.name: i for i, item in enumerate(prior.objects)}
    regions, objects = len(rows), len(columns)
    shares, instances = np.zeros(regions), np.zeros((regions, objects))
    holding, pairs, touching = np.zeros((regions, objects)), np.zeros((regions, regions)), np.zeros((regions, regions))
    maps = 0
    for seen in evidence:
        own = [i for i, name in enumerate(seen.regions) if name in rows]
        places = seen.places[own].astype(float)
        if not places.sum():
            continue
        maps += 1
        here = [rows[seen.regions[i]] for i in own]
        np.add.at(shares, here, places / places.sum())
        pairs[np.ix_(here, here)] += seen.pairs[np.ix_(own, own)]
        touching[np.ix_(here, here)] += seen.touching[np.ix_(own, own)]
        known = [i for i, name in enumerate(seen.objects) if name in columns]
        there = [columns[seen.objects[i]] for i in known]
        instances[np.ix_(here, there)] += seen.instances[own][:, None]
        holding[np.ix_(here, there)] += seen.holding[np.ix_(own, known)]
    return Totals(maps, shares, instances, holding, pairs, touching)


def revised(prior: Prior, seen: Totals, strength: float, made: Provenance) -> Prior:
    """The posterior mean. A region that no map has shown keeps its rows; its share falls as in any Dirichlet."""
    existence = np.array([region.existence for region in prior.regions])
    existence = (strength * existence + seen.shares) / (strength + seen.maps)
    held = (strength * prior.containment + seen.holding) / (strength + seen.instances)
    touching = (strength * prior.adjacency + seen.touching) / (strength + seen.pairs)
    return _with(prior, existence, held, touching, made)


def corrected(prior: Prior, answer: dict[str, dict[str, dict[str, float]]], made: Provenance) -> Prior:
    """The prior with the entries that a model has revised, {matrix: {row: {column: percent}}}."""
    names = [region.name for region in prior.regions]
    columns = [item.name for item in prior.objects]
    held, touching = prior.containment.astype(float), prior.adjacency.astype(float)
    for row, given in answer.get("containment", {}).items():
        for name, percent in given.items():
            held[names.index(row), columns.index(name)] = percent / 100
    for row, given in answer.get("adjacency", {}).items():
        for name, percent in given.items():
            i, j = names.index(row), names.index(name)
            touching[i, j] = touching[j, i] = percent / 100
    return _with(prior, np.array([region.existence for region in prior.regions]), held, touching, made)


def _with(prior: Prior, existence: np.ndarray, held: np.ndarray, touching: np.ndarray, made: Provenance) -> Prior:
    touching = np.clip(touching, LEAST, MOST)
    np.fill_diagonal(touching, np.diag(prior.adjacency))
    existence = np.maximum(existence, 1e-4)
    regions = [
        msgspec.structs.replace(region, existence=share)
        for region, share in zip(prior.regions, (existence / existence.sum()).tolist(), strict=True)
    ]
    return msgspec.structs.replace(
        prior,
        regions=regions,
        containment=np.clip(held, LEAST, MOST).astype(np.float32),
        adjacency=touching.astype(np.float32),
        provenance=made,
    )


@dataclass(frozen=True)
class Disagreement:
    """One entry in which observation and expectation differ."""

    matrix: str  # containment or adjacency
    row: str
    column: str
    expected: float  # probabilities
    observed: float
    trials: float
    surprise: float  # squared distance in standard errors of the expectation


def disagreements(prior: Prior, seen: Totals, most: int) -> list[Disagreement]:
    """The most surprising entries first; only those that at least one trial has tested."""
    names, things = [region.name for region in prior.regions], [item.name for item in prior.objects]
    upper = np.triu(seen.pairs, 1)  # a pair is one entry
    found = [
        _disagreement(
            "containment",
            (names[i], things[j]),
            float(prior.containment[i, j]),
            float(seen.holding[i, j]),
            float(trials),
        )
        for (i, j), trials in np.ndenumerate(seen.instances)
        if trials > 0
    ]
    found += [
        _disagreement(
            "adjacency", (names[i], names[j]), float(prior.adjacency[i, j]), float(seen.touching[i, j]), float(trials)
        )
        for (i, j), trials in np.ndenumerate(upper)
        if trials > 0
    ]
    found.sort(key=lambda entry: -entry.surprise)
    return [entry for entry in found if entry.surprise > 1][:most]


def _disagreement(matrix: str, entry: tuple[str, str], expected: float, hits: float, trials: float) -> Disagreement:
    observed = hits / trials
    surprise = (observed - expected) ** 2 / (expected * (1 - expected) / trials + 1e-4)
    return Disagreement(matrix, *entry, expected, observed, trials, surprise)


def told(entries: Iterable[Disagreement]) -> tuple[str, dict[str, dict[str, dict[str, tuple[float, float]]]]]:
    """Disagreements as lines for people and models, and as the form of an answer: (expected, observed) in percent."""
    lines, form = [], {}  # type: ignore[var-annotated]
    for entry in entries:
        verb = "holds" if entry.matrix == "containment" else "touches"
        lines.append(
            f"- {entry.row} {verb} {entry.column}: expected {100 * entry.expected:.0f} %, "
            f"observed {100 * entry.observed:.0f} % of {entry.trials:.0f}"
        )
        form.setdefault(entry.matrix, {}).setdefault(entry.row, {})[entry.column] = (
            100 * entry.expected,
            100 * entry.observed,
        )
    return "\n".join(lines), form


def largest_change(before: Prior, after: Prior) -> float:
    """The largest difference of any entry of the matrices or of existence."""
    pairs = [
        (before.containment, after.containment),
        (before.adjacency, after.adjacency),
        *(
            [(np.array([r.existence for r in before.regions]), np.array([r.existence for r in after.regions]))]
            if len(before.regions) == len(after.regions)
            else []
        ),
    ]
    return max(
        (float(np.abs(one - other).max(initial=0)) for one, other in pairs if one.shape == other.shape), default=1.0
    )
