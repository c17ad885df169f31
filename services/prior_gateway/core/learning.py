"""A prior corrected by what robots have seen (beyond the paper; pure).

Every probability of the prior is the mean of a Beta or Dirichlet distribution worth `strength` observations; counts add
to them. With n trials and k hits, P becomes (strength P + k) / (strength + n): a prior that nobody has tested stays as
it is, one that many homes contradict gives way. Counting starts from the prior before any revision, always with the
totals of all maps, so that nothing counts twice.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.schemas.priors import Counts, Prior, PriorEvidence, Provenance
from prior_sg.services.prior_gateway.core.estimation import (
    Estimate,
    EstimationConfig,
    Totals,
    estimated,
    revised_statements,
)
from prior_sg.services.prior_gateway.core.turns import LEAST, MOST

HELD, ALIEN = 0.5, 0.15  # P of an object that is there, and P(o | r) of one that does not belong to a region
MOST_ALIEN = 2  # such objects, more than half of all, make a place strange
LEAST_STRANGE = 3  # strange places of one name before a model hears of them
MOST_STRANGE = 8  # things told of them
LEAST_TRIALS = 0.5  # below which an entry was not tested


class LearningConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How observations revise priors."""

    strength: float = 4.0  # observed regions that a statement of the prior is worth; see `prior-sg bench learning`
    automatic: bool = False  # publish a revised prior without being asked; regions change while the robot works
    least_maps: int = 3  # maps that must have been observed before a prior is revised automatically
    least_change: float = 0.2  # and by how much an entry must change
    told: int = 24  # disagreements shown to the model
    by_model: bool = False  # let automatic revisions ask the model, within the limits that follow
    calls_per_day: int = 40  # of the model, for revisions of one environment; 0 = no limit
    tokens_per_day: int = 60_000  # in and out, the same; 0 = no limit
    kept_maps: int = 256  # of each task; the oldest are forgotten
    estimation: EstimationConfig = msgspec.field(default_factory=EstimationConfig)

    def __post_init__(self) -> None:
        if not (self.strength > 0 and self.least_maps >= 1 and 0 < self.least_change < 1 and self.told >= 1):
            raise ValueError("strength, least_maps, least_change or told is out of range")
        if min(self.calls_per_day, self.tokens_per_day) < 0:
            raise ValueError("calls_per_day and tokens_per_day must not be negative")


def estimate(prior: Prior, evidence: Iterable[PriorEvidence], cfg: LearningConfig) -> Estimate:
    """What all maps show of a prior, as it was before any revision."""
    return estimated(prior, list(evidence), cfg.strength, cfg.estimation)


def revised(prior: Prior, seen: Totals, strength: float, made: Provenance, looks: float | None = None) -> Prior:
    """The posterior mean, and what `looks` are worth. A region that no map has shown keeps its rows; its share falls as
    in any Dirichlet."""
    says = revised_statements(prior, seen, strength)
    tested = Counts(regions=seen.instances.max(axis=1, initial=0).astype(np.float32), looks=looks)
    return msgspec.structs.replace(_with(prior, says.existence, says.containment, says.adjacency, made), tested=tested)


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
    """The most surprising entries first; only those that have been tested."""
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
        if trials >= LEAST_TRIALS
    ]
    found += [
        _disagreement(
            "adjacency", (names[i], names[j]), float(prior.adjacency[i, j]), float(seen.touching[i, j]), float(trials)
        )
        for (i, j), trials in np.ndenumerate(upper)
        if trials >= LEAST_TRIALS
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


def unexplained(prior: Prior, seen: Estimate) -> tuple[str, list[str]]:
    """Regions of maps that hold little of what any region of the prior does, as lines by what they were taken for; and
    what they hold instead."""
    names, things = [region.name for region in prior.regions], [item.name for item in prior.objects]
    strange: dict[int, Counter[str]] = {}
    taken, met = Counter[int](), Counter[int]()
    for one, belief in zip(seen.maps, seen.beliefs, strict=True):
        for label, contents in zip(belief.argmax(axis=1).tolist(), one.contents, strict=True):
            there = np.flatnonzero(contents >= HELD)
            aliens = (prior.containment[:, there] < ALIEN).sum(axis=1).min()
            taken[label] += 1
            if aliens >= MOST_ALIEN and 2 * aliens > len(there):
                met[label] += 1
                strange.setdefault(label, Counter()).update(things[i] for i in there.tolist())
    lines, objects = [], Counter[str]()
    for label, number in met.most_common():
        if number < LEAST_STRANGE:
            break
        told = ", ".join(f"{name} ({times})" for name, times in strange[label].most_common(MOST_STRANGE))
        lines.append(f"- {number} of {taken[label]} places taken for {names[label]} hold other things: {told}")
        objects.update(strange[label])
    return "\n".join(lines), [name for name, _ in objects.most_common(MOST_STRANGE)]


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
