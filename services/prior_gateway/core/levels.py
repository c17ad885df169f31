"""Levels above the regions of a prior, from knowledge already written down (pure).

An environment's levels say of each base region r in which entry it lies, P(e | r). With the weights w_r of a chosen
region's members, and entries z of the level below:

    P(e | m) = sum_r w_r P(e | r) / sum_r w_r           P(e | z) = sum_m P(m) P(z | m) P(e | m) / P(z)

A region known by name alone may be in any entry, as often as these are. Two entries touch as firmly as is written, else
where any of their regions touch, in the measure that these are theirs: max_mn P(e | m) P(f | n) P(m <-> n).
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from prior_sg.schemas.levels import LEVELS, SURE, Entry, LevelPrior
from prior_sg.services.prior_gateway.core.knowledge import Chosen, Environment, LevelEntry, RegionEntry
from prior_sg.services.prior_gateway.core.matching import contains, stems

LEAST = 1e-3  # probability of touching, and share of an entry


def levels_of(
    task: str, chosen: Sequence[Chosen], existence: Sequence[float], adjacency: np.ndarray
) -> list[LevelPrior]:
    """The levels that the environment of most regions has for a task; none where it has none written down."""
    known = {one.environment.name: one.environment for one in chosen if one.environment}
    if not known:
        return []
    environment = known[Counter(one.environment.name for one in chosen if one.environment).most_common(1)[0][0]]
    picked = _picked(task, environment)
    if picked == [_usual_zones(environment)]:  # which the regions' parents say
        return []
    shares, below, found = np.array(existence), np.eye(len(chosen)), list[LevelPrior]()
    for entry in picked:
        above = _parents(entry, environment, chosen, shares)
        prior = _level(entry, below, above, shares, adjacency)
        if prior is not None:
            found.append(prior[0])
            below = above[:, prior[1]] / above[:, prior[1]].sum(axis=1, keepdims=True)
    return found


def _picked(task: str, environment: Environment) -> list[LevelEntry]:
    """One entry of each level, from below: the one with most of its keywords in the task, else the one without any; of
    zones, else those that the regions name as their parents."""
    asked, picked = stems(task), []
    for name in LEVELS:
        scores = [
            (sum(contains(asked, stems(word)) for word in entry.keywords), entry)
            for entry in environment.levels
            if entry.name == name
        ]
        fitting = [(score, entry) for score, entry in scores if score or not entry.keywords]
        if fitting:
            picked.append(max(fitting, key=lambda pair: pair[0])[1])
        elif name == "zone" and _usual_zones(environment).entries:
            picked.append(_usual_zones(environment))
    return picked


def _usual_zones(environment: Environment) -> LevelEntry:
    """The zones that the regions name as their parents."""
    parents: dict[str, str | dict[str, float]] = {one.name: one.parent for one in environment.regions if one.parent}
    return LevelEntry(name="zone", entries=list(dict.fromkeys(map(str, parents.values()))), parents=parents)


def _parents(entry: LevelEntry, environment: Environment, chosen: Sequence[Chosen], shares: np.ndarray) -> np.ndarray:
    """P(e | m), (region, entry)."""
    matrix = np.full((len(chosen), len(entry.entries)), np.nan)
    for row, one in enumerate(chosen):
        known = [member for member in one.members if one.environment is environment]
        if known:
            weights = [environment.share(member) for member in known]
            rows = [_distribution(entry, member) for member in known]
            matrix[row] = np.average(rows, axis=0, weights=weights)
    alone = np.isnan(matrix[:, 0])
    matrix[alone] = np.average(matrix[~alone], axis=0, weights=shares[~alone])
    return matrix


def _distribution(entry: LevelEntry, member: RegionEntry) -> list[float]:
    """P(e | r) of one base region."""
    names, said = entry.entries, entry.parents.get(member.name, entry.otherwise)
    if isinstance(said, str):
        said = {said: SURE if len(names) > 1 else 1.0}
    rest = max(1 - sum(said.values()), LEAST) / max(len(names) - len(said), 1)
    values = [said.get(name, rest) for name in names]
    return [value / sum(values) for value in values]


def _level(
    entry: LevelEntry, below: np.ndarray, above: np.ndarray, shares: np.ndarray, adjacency: np.ndarray
) -> tuple[LevelPrior, np.ndarray] | None:
    """One level over the entries `below` (region, child), `above` (region, entry), and which entries it keeps; None
    where no region is in any."""
    kept = np.flatnonzero(shares @ above > LEAST)
    if not len(kept):
        return None
    above = above[:, kept] / above[:, kept].sum(axis=1, keepdims=True)
    names = [entry.entries[column] for column in kept.tolist()]
    joint = (shares[:, None] * below).T @ above
    existence = shares @ above
    touch = np.maximum(np.einsum("me,nf,mn->mnef", above, above, adjacency).max(axis=(0, 1)), LEAST)
    for row, one in enumerate(names):
        for column, other in enumerate(names):
            said = entry.adjacent.get(one, {}).get(other, entry.adjacent.get(other, {}).get(one))
            touch[row, column] = 1.0 if row == column else said if said is not None else touch[row, column]
    prior = LevelPrior(
        name=entry.name,
        task=entry.task,
        entries=[Entry(name=name, existence=float(value)) for name, value in zip(names, existence, strict=True)],
        parents=(joint / joint.sum(axis=1, keepdims=True)).astype(np.float32),
        adjacency=np.minimum((touch + touch.T) / 2, 1.0).astype(np.float32),
    )
    return prior, kept
