"""One prior from several generations: names aligned, numbers averaged, their spread kept (pure).

Names of different generations mean the same when a given relation says so; regions that fewer than half of the
generations name are left out, for they are whims. Numbers are averaged over the generations that speak of the names.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.schemas.priors import MOST_SPREAD, ObjectPrior, Prior, Provenance, RegionPrior, Spread, Task
from prior_sg.services.prior_gateway.core.turns import Draft

Same = Callable[[str, str], bool]
MOST_KEPT_PHRASES = 8
LEAST_SUPPORT = 0.5  # share of the generations that must name a region or object


@dataclass(frozen=True)
class Cluster:
    """One name in all generations: index in each that has it."""

    name: str
    index: dict[int, int]  # draft -> row or column


def clusters(lists: Sequence[Sequence[str]], same: Same) -> list[Cluster]:
    """Names of several lists that mean the same, in order of first mention. Equal names first, then synonyms; two names
    of one list are never the same. What too few lists have is left out, except when nothing would be left."""
    found: list[dict[int, int]] = []
    words: list[list[str]] = []
    for exact in (True, False):
        for number, names in enumerate(lists):
            for row, name in enumerate(names):
                if any(group.get(number) == row for group in found):
                    continue
                target = _joinable(name, number, found, words, (lambda a, b: a == b) if exact else same)
                if target is not None:
                    found[target][number] = row
                    words[target].append(name)
                elif not exact or number == 0:
                    found.append({number: row})
                    words.append([name])
    least = min(LEAST_SUPPORT * len(lists), max((len(group) for group in found), default=0))
    return [
        Cluster(Counter(names).most_common(1)[0][0], group)
        for group, names in zip(found, words, strict=True)
        if len(group) >= least
    ]


def _joinable(name: str, number: int, found: list[dict[int, int]], words: list[list[str]], same: Same) -> int | None:
    for index, (group, known) in enumerate(zip(found, words, strict=True)):
        if number not in group and any(same(name, other) for other in known):
            return index
    return None


def combine(
    task: Task, drafts: Sequence[Draft], same: Same, with_name: Callable[[str], list[str]], made: Provenance
) -> Prior:
    """The mean of the drafts as a complete prior. `with_name` gives the phrases that a name itself makes."""
    regions = clusters([draft.regions for draft in drafts], same)
    objects = clusters([draft.objects for draft in drafts], same)
    existence, existence_std = _mean([draft.existence[:, None] for draft in drafts], regions, None)
    held, held_std = _mean([draft.containment for draft in drafts], regions, objects)
    touching, touching_std = _mean([draft.adjacency for draft in drafts], regions, regions)
    touching = (touching + touching.T) / 2
    np.fill_diagonal(touching, 1.0)
    shares = existence[:, 0] / existence[:, 0].sum()
    entries = [
        _region(cluster, share, drafts, with_name) for cluster, share in zip(regions, shares.tolist(), strict=True)
    ]
    spread = Spread(
        existence=existence_std[:, 0].astype(np.float32),
        containment=held_std.astype(np.float32),
        adjacency=touching_std.astype(np.float32),
        support=np.array([len(cluster.index) / len(drafts) for cluster in regions], dtype=np.float32),
    )
    return Prior(
        environment=task.environment,
        task=task.task,
        vocabulary=task.regions,
        regions=entries,
        objects=[_object(cluster, drafts, with_name) for cluster in objects],
        containment=held.astype(np.float32),
        adjacency=touching.astype(np.float32),
        provenance=made,
        spread=spread,
    )


def _region(
    cluster: Cluster, share: float, drafts: Sequence[Draft], with_name: Callable[[str], list[str]]
) -> RegionPrior:
    """Phrases of all generations in turn, the most common zone, the mixture of the inclinations, the mean scale."""
    mine = [(drafts[number], row) for number, row in sorted(cluster.index.items())]
    longest = max(len(draft.phrases[row]) for draft, row in mine)
    said = [
        draft.phrases[row][turn] for turn in range(longest) for draft, row in mine if turn < len(draft.phrases[row])
    ]
    zones = Counter(draft.parents[row] for draft, row in mine if draft.parents[row])
    angles = np.radians([draft.inclination_deg[row] for draft, row in mine])
    mean = angles[:, 0].mean()
    variance = (angles[:, 1] ** 2 + (angles[:, 0] - mean) ** 2).mean()
    return RegionPrior(
        name=cluster.name,
        phrases=list(dict.fromkeys([*with_name(cluster.name), *said]))[:MOST_KEPT_PHRASES],
        existence=share,
        inclination_mean_rad=float(mean),
        inclination_std_rad=float(np.sqrt(variance)),
        query_radius_m=float(np.mean([draft.query_radius_m[row] for draft, row in mine])),
        parent=zones.most_common(1)[0][0] if zones else "",
    )


def _object(cluster: Cluster, drafts: Sequence[Draft], with_name: Callable[[str], list[str]]) -> ObjectPrior:
    """Geometric mean of the sides, mean of the lower edge; what the generations differ by widens the spread."""
    said_m = np.array([drafts[number].sizes_m[row] for number, row in sorted(cluster.index.items())])
    logs = np.log(said_m[:, :3])
    longest, shortest, height = np.exp(logs.mean(axis=0)).tolist()
    usual = ObjectPrior(name=cluster.name, phrases=with_name(cluster.name))
    return msgspec.structs.replace(
        usual,
        size_m=(longest, shortest, height),
        size_spread=min(float(np.hypot(usual.size_spread, np.sqrt(logs.var(axis=0).mean()))), MOST_SPREAD),
        bottom_m=float(said_m[:, 3].mean()),
    )


def _mean(
    matrices: Sequence[np.ndarray], rows: list[Cluster], columns: list[Cluster] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each entry over the drafts that have it; an entry that none has (its row and its
    column never met) gets the mean of all, and the spread of not knowing: one half."""
    width = len(columns) if columns is not None else matrices[0].shape[1]
    stack = np.full((len(matrices), len(rows), width), np.nan)
    for number, matrix in enumerate(matrices):
        have = [i for i, cluster in enumerate(rows) if number in cluster.index]
        picked = range(width) if columns is None else [j for j, c in enumerate(columns) if number in c.index]
        source = list(picked) if columns is None else [columns[j].index[number] for j in picked]
        where = np.ix_(have, list(picked))
        stack[number][where] = matrix[np.ix_([rows[i].index[number] for i in have], source)]
    known = ~np.isnan(stack)
    count = known.sum(axis=0)
    total = np.where(known, stack, 0.0)
    mean = np.where(count > 0, total.sum(axis=0) / np.maximum(count, 1), total.sum() / max(known.sum(), 1))
    variance = np.where(known, (stack - mean) ** 2, 0.0).sum(axis=0) / np.maximum(count, 1)
    return mean, np.where(count > 0, np.sqrt(variance), 0.5)
