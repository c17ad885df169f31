"""What a map shows of its prior: how its regions share the places, which of them touch, and what they hold (beyond the
paper; pure).

Objects count only as far as a detector looked for them by name, and once one did: that a region holds none of a kind
says something only where one has looked for that kind.

The labels were found under the prior that they are to judge. So each region is told of once more without its label:
what its places look like, what it holds and which others it touches; whoever learns may name it anew.
"""

import numpy as np

from prior_sg.schemas.priors import MOST_PIECES, PriorEvidence
from prior_sg.services.segmenter.core import inference
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts.visual import visual
from prior_sg.services.segmenter.core.map.table import UNLABELLED
from prior_sg.services.segmenter.core.regions.contents import held
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
    ids, labels, sizes = ids[large], places.labels[rows][first[large]], sizes[large]
    instances = np.bincount(labels, minlength=count).astype(np.float32)
    pairs = np.outer(instances, instances)
    np.fill_diagonal(pairs, instances * (instances - 1) / 2)
    looked = bool((state.objects.view.answers > 0).any())
    found = held(state.objects.view, state.map.graph.positions_m, places.regions, ids)
    ends = _ends(places.regions[state.map.graph.edges], ids)
    told = np.sort(np.argsort(-sizes, kind="stable")[:MOST_PIECES])
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
        holding=_by_label(found, labels, count) if looked else np.zeros((count, 0), np.float32),
        pairs=pairs.astype(np.float32),
        touching=_touching(labels[ends], count),
        sizes=sizes[told].astype(np.float32),
        looks=_looks(state, ids[told], cfg),
        contents=np.minimum(found[told] if looked else np.zeros((len(told), 0)), 1.0).astype(np.float32),
        links=np.searchsorted(told, ends[np.isin(ends, told).all(axis=1)]).astype(np.int32),
    )


def _looks(state: State, ids: np.ndarray, cfg: Config) -> np.ndarray:
    """Mean (region, label) over the places of the regions `ids` of the visual expert's word, as far as it is sure."""
    regions = state.map.places.regions
    rows = np.flatnonzero(np.isin(regions, ids))
    log_probabilities, sure = visual(inference.context_of(state, rows, cfg))
    piece = np.searchsorted(ids, regions[rows])
    looks = np.zeros((len(ids), log_probabilities.shape[1]))
    np.add.at(looks, piece, sure[:, None] * np.maximum(log_probabilities, np.log(cfg.probability_floor)))
    return (looks / np.bincount(piece, minlength=len(ids))[:, None]).astype(np.float32)


def _ends(regions: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Pairs (pair, 2) of the regions `ids`, as indices into them, with an edge between them; `regions` (edge, 2)."""
    ends = np.sort(regions[np.isin(regions, ids).all(axis=1) & (regions[:, 0] != regions[:, 1])], axis=1)
    return np.searchsorted(ids, np.unique(ends, axis=0)).reshape(-1, 2)


def _touching(labels: np.ndarray, count: int) -> np.ndarray:
    """Pairs of labels (pair, 2), counted (label, label), symmetric."""
    one, other = labels.T
    touching = np.zeros((count, count), np.float32)
    np.add.at(touching, (one, other), 1)
    np.add.at(touching, (other, one), one != other)
    return touching


def _by_label(held: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Sums (label, concept) over the regions of each label."""
    holding = np.zeros((count, held.shape[1]), np.float32)
    np.add.at(holding, labels, held)
    return holding
