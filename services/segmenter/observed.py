"""What a map shows of its prior: how its regions share the places, and which of them touch (beyond the paper; pure).

Objects are not counted: that a region holds none of a kind says something only where one has looked for that kind.
"""

import numpy as np

from schemas.priors import PriorEvidence
from services.segmenter.places import UNLABELLED
from services.segmenter.state import Config, State


def evidence(state: State, cfg: Config) -> PriorEvidence | None:
    """Totals of the map as it is; None without a prior in force, or without regions large enough to count."""
    if state.alignment is None:
        return None
    places, prior, count = state.places, state.alignment.prior, len(state.alignment.labels)
    rows = np.flatnonzero(places.labels != UNLABELLED)
    ids, first, sizes = np.unique(places.regions[rows], return_index=True, return_counts=True)
    large = sizes >= cfg.evidence_places
    if not large.any():
        return None
    ids, labels = ids[large], places.labels[rows][first[large]]
    instances = np.bincount(labels, minlength=count).astype(np.float32)
    pairs = np.outer(instances, instances)
    np.fill_diagonal(pairs, instances * (instances - 1) / 2)
    return PriorEvidence(
        robot=state.robot,
        epoch=state.graph_epoch,
        stamp_ns=state.stamp_ns,
        prior_digest=state.alignment.digest,
        environment=prior.environment,
        task=prior.task,
        vocabulary=prior.vocabulary,
        regions=state.alignment.labels,
        places=places.posteriors[rows].sum(axis=0).astype(np.float32),
        instances=instances,
        holding=np.zeros((count, 0), np.float32),
        pairs=pairs.astype(np.float32),
        touching=_touching(places.regions[state.graph.edges], ids, labels, count),
    )


def _touching(ends: np.ndarray, ids: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Pairs of the regions `ids` with an edge between them, counted (label, label), symmetric. `ends` (edge, 2)."""
    ends = np.sort(ends[np.isin(ends, ids).all(axis=1) & (ends[:, 0] != ends[:, 1])], axis=1)
    one, other = labels[np.searchsorted(ids, np.unique(ends, axis=0))].reshape(-1, 2).T
    touching = np.zeros((count, count), np.float32)
    np.add.at(touching, (one, other), 1)
    np.add.at(touching, (other, one), one != other)
    return touching
