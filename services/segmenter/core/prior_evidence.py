"""What a map shows of its prior: how its regions share the places, which of them touch, and what they hold (beyond the
paper; pure).

Objects count only as far as a detector looked for them by name, and once one did: that a region holds none of a kind
says something only where one has looked for that kind.
"""

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.priors import PriorEvidence
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.map.table import UNLABELLED
from prior_sg.services.segmenter.core.regions.components import OBJECT_REACH_M
from prior_sg.services.segmenter.core.state import State


def evidence(state: State, cfg: Config) -> PriorEvidence | None:
    """Totals of the map as it is; None without a prior in force, or without regions large enough to count."""
    if state.aim.in_force is None:
        return None
    places, prior, count = state.map.places, state.aim.in_force.prior, len(state.aim.in_force.labels)
    rows = np.flatnonzero(places.labels != UNLABELLED)
    ids, first, sizes = np.unique(places.regions[rows], return_index=True, return_counts=True)
    large = sizes >= cfg.evidence_places
    if not large.any():
        return None
    ids, labels = ids[large], places.labels[rows][first[large]]
    instances = np.bincount(labels, minlength=count).astype(np.float32)
    pairs = np.outer(instances, instances)
    np.fill_diagonal(pairs, instances * (instances - 1) / 2)
    looked = bool((state.objects.view.answers > 0).any())
    held = _held(state.objects.view, state.map.graph.positions_m, places.regions, ids)
    return PriorEvidence(
        robot=state.robot,
        epoch=state.map.epoch,
        stamp_ns=state.stamp_ns,
        prior_digest=state.aim.in_force.digest,
        environment=prior.environment,
        task=prior.task,
        vocabulary=prior.vocabulary,
        regions=state.aim.in_force.labels,
        places=places.posteriors[rows].sum(axis=0).astype(np.float32),
        instances=instances,
        objects=[item.name for item in prior.objects] if looked else [],
        holding=_by_label(held, labels, count) if looked else np.zeros((count, 0), np.float32),
        pairs=pairs.astype(np.float32),
        touching=_touching(places.regions[state.map.graph.edges], ids, labels, count),
    )


def _touching(ends: np.ndarray, ids: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Pairs of the regions `ids` with an edge between them, counted (label, label), symmetric. `ends` (edge, 2)."""
    ends = np.sort(ends[np.isin(ends, ids).all(axis=1) & (ends[:, 0] != ends[:, 1])], axis=1)
    one, other = labels[np.searchsorted(ids, np.unique(ends, axis=0))].reshape(-1, 2).T
    touching = np.zeros((count, count), np.float32)
    np.add.at(touching, (one, other), 1)
    np.add.at(touching, (other, one), one != other)
    return touching


def _held(view: ObjectView, positions_m: np.ndarray, regions: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """How surely (region, concept) each of the regions `ids` holds each kind of object: the word of its best candidate.

    An object stands in the region of its nearest place. The best, as in the object expert, because the doubts of many
    objects about what they are do not add up to one that is there.
    """
    held = np.zeros((len(ids), view.concepts.shape[1]))
    if len(view.ids):
        distances_m, nearest = cKDTree(positions_m).query(view.positions_m)
        region = regions[nearest]
        inside = np.flatnonzero((distances_m <= OBJECT_REACH_M) & np.isin(region, ids))
        words = view.answers[inside, None] * view.concepts[inside]
        np.maximum.at(held, np.searchsorted(ids, region[inside]), words)
    return held


def _by_label(held: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Sums (label, concept) over the regions of each label."""
    holding = np.zeros((count, held.shape[1]), np.float32)
    np.add.at(holding, labels, held)
    return holding
