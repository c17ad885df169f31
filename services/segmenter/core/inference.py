"""From evidence to labels and beliefs: experts, energy, swaps, components (paper, Global Inference; pure).

Masks in `Places` say what changed; each function here does again only what its mask names, and marks what follows.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.regions import RegionEvent
from prior_sg.services.segmenter.core.appearance import adaptation, smoothing
from prior_sg.services.segmenter.core.appearance.label_bias import label_bias
from prior_sg.services.segmenter.core.energy import posteriors, swap
from prior_sg.services.segmenter.core.experts import REGISTRY, Vote
from prior_sg.services.segmenter.core.experts.context import Context, ObjectView, standardised
from prior_sg.services.segmenter.core.map import inclination
from prior_sg.services.segmenter.core.map.received import PlaceGraph
from prior_sg.services.segmenter.core.regions import components
from prior_sg.services.segmenter.core.state import Config, State

BIAS_SAMPLE = 4096  # places that stand for all when the map's bias is computed
RESTING_TICKS = 2  # without a pyramid, after which the map rests


@dataclass
class Budget:
    """Ends solving after a number of looks. A clock would stop a replay elsewhere than the run it repeats, so each look
    stands for a fixed time: about what the solver's work between two looks takes on one core of a laptop."""

    looks: float

    def expired(self) -> bool:
        """Look."""
        self.looks -= 1
        return self.looks < 0


def votes(state: State, rows: np.ndarray, cfg: Config) -> dict[str, Vote]:
    """Each configured expert's vote on the places in `rows`; probabilities are floored."""
    alignment = state.alignment
    assert alignment is not None
    context = Context(
        prior=alignment.prior,
        text=alignment.text,
        similarity=state.places.similarity[rows],
        frames=state.evidence.frames[state.places.slots[rows]],
        bias=state.bias,
        positions_m=state.graph.positions_m[rows],
        radii_m=state.graph.radii_m[rows],
        inclination_rad=state.places.inclination_rad[rows],
        support=state.places.support[rows],
        anisotropy=state.places.anisotropy[rows],
        objects=state.objects,
        object_settings=cfg.objects,
    )
    floor = np.log(cfg.probability_floor)
    answers = {name: REGISTRY[name](context) for name in cfg.experts}
    return {name: (np.maximum(log_probabilities, floor), sure) for name, (log_probabilities, sure) in answers.items()}


def adapt(state: State, idle: bool, cfg: Config) -> None:
    """What the labels look like in this map, on a tick after enough of it was seen anew, or when it rests."""
    alignment, places = state.alignment, state.places
    assert alignment is not None
    state.unadapted += int(places.stale.sum())
    if not idle:
        return
    seen = np.flatnonzero(state.evidence.trust[places.slots] > 0)
    rests = idle and state.spaces.still_ticks >= RESTING_TICKS
    if not (rests and state.unadapted) and state.unadapted <= cfg.adaptation.patience * len(seen):
        return
    state.unadapted = 0
    if not (cfg.adaptation.weight and len(seen)):
        return
    found = state.evidence.descriptors(places.slots[seen]).astype(np.float32)
    similarity = standardised(found, alignment.text)
    everywhere = np.zeros((len(places.slots), similarity.shape[1]))

    def labels_of(own: np.ndarray) -> np.ndarray:
        everywhere[seen] = own
        return _visual_labels(state, everywhere, seen, cfg)

    masses = np.minimum(state.evidence.trust[places.slots[seen]], cfg.sharing.trust_limit)
    now = adaptation.adapted(found, similarity, masses, labels_of, cfg.adaptation)
    if adaptation.differs(now, state.adaptation, found, similarity, cfg.adaptation.tolerance):
        state.adaptation = now
        places.stale[seen] = True


def _visual_labels(state: State, own: np.ndarray, rows: np.ndarray, cfg: Config) -> np.ndarray:
    """The label (row,) that each of some places looks most like, from the own similarities (place, label) of all."""
    assert state.alignment is not None
    trust, near = state.evidence.trust[state.places.slots], state.graph.adjacency
    around = smoothing.shared(own, trust, near, state.weights, rows=rows, cfg=cfg.sharing)
    scores = state.alignment.text.temperature * around
    return np.argmax(scores + _bias(state, scores, cfg), axis=1)


def _bias(state: State, scores: np.ndarray, cfg: Config) -> np.ndarray:
    """The bias of each label, from the scores (place, label) of the observed places."""
    assert state.alignment is not None
    existence = np.array([region.existence for region in state.alignment.prior.regions])
    return label_bias(scores[:: max(len(scores) // BIAS_SAMPLE, 1)], existence, cfg.balance)


def compare(state: State) -> None:
    """Similarity of the places whose evidence changed, each for itself, with each label."""
    alignment, places, rows = state.alignment, state.places, np.flatnonzero(state.places.stale)
    assert alignment is not None
    found = state.evidence.descriptors(places.slots[rows])
    if found.shape[1]:  # after the first pyramid
        places.own_similarity[rows] = standardised(found, alignment.text) + state.adaptation.similarity(found)
    places.stale[rows], places.unshared[rows] = False, True


def share(state: State, cfg: Config) -> None:
    """Average similarity around the places whose own, or whose edges, changed."""
    places, near = state.places, state.graph.adjacency
    rows = smoothing.reached(near, places.unshared, cfg.sharing.steps)
    trust = state.evidence.trust[places.slots]
    places.similarity[rows] = smoothing.shared(
        places.own_similarity, trust, near, state.weights, rows=rows, cfg=cfg.sharing
    )
    places.unshared[:], places.doubtful[rows] = False, True
    state.compared += len(rows)


def reshape(state: State, cfg: Config) -> None:
    """Local surface of the places around which the graph changed."""
    places, rows = state.places, np.flatnonzero(state.places.reshaped)
    shape = inclination.shape_of(state.graph, rows, cfg.geometry)
    places.inclination_rad[rows], places.support[rows], places.anisotropy[rows] = shape
    places.reshaped[rows], places.doubtful[rows] = False, True


def see_objects(state: State, view: ObjectView, cfg: Config) -> None:
    """From now on these are the objects of the map; the places near those that are new, changed or gone ask again."""
    changed_m = view.changed_m(state.objects)
    state.objects = view
    if len(changed_m) and len(state.graph.ids):
        distances_m, _ = cKDTree(changed_m).query(state.graph.positions_m, distance_upper_bound=cfg.objects.reach_m)
        near = np.isfinite(distances_m)
        state.places.doubtful |= near
        state.disturbed.update(state.places.regions[near].tolist())
        state.dirty = True


def rebalance(state: State, idle: bool, cfg: Config) -> None:
    """The map's bias, after enough of the map was seen anew or when idle; everybody asks again when it has moved."""
    assert state.alignment is not None
    places = state.places
    seen = np.flatnonzero(state.evidence.frames[places.slots] > 0)
    if not state.compared or not (idle or state.compared > cfg.balance.patience * len(seen)):
        return
    bias = _bias(state, state.alignment.text.temperature * places.similarity[seen], cfg)
    state.compared = 0
    if np.abs(bias - state.bias).max(initial=0.0) > cfg.balance.tolerance:
        state.bias = bias
        places.doubtful[seen] = True


def evaluate_experts(state: State, idle: bool, cfg: Config) -> None:
    """Unary potentials wherever an expert may have changed its mind (eqs. product_of_experts, unary_potential)."""
    reshape(state, cfg)
    adapt(state, idle, cfg)
    compare(state)
    share(state, cfg)
    rebalance(state, idle, cfg)
    places, rows = state.places, np.flatnonzero(state.places.doubtful)
    answers = votes(state, rows, cfg)
    unary = np.zeros((len(rows), places.unary.shape[1]))
    for name, (log_probabilities, confidence) in answers.items():
        unary -= (confidence * cfg.experts[name])[:, None] * log_probabilities
    changed = rows[(unary != places.unary[rows]).any(axis=1)]
    places.unary[rows] = unary
    places.sight[rows] = answers["visual"][1] if "visual" in answers else 0.0
    places.doubtful[rows], places.unbelieved[rows], places.unsettled[changed] = False, True, True


def edge_weights(graph: PlaceGraph, cfg: Config) -> np.ndarray:
    """w_dist (edge,) of eq. pairwise_potential: falls with length, then scaled symmetrically.

    With w and the sums of w at both ends, d_u and d_v, the weight is edge_sum w / sqrt(d_u d_v): a place is held by its
    neighbours about as firmly in a dense graph of small rooms as in a sparse one of large halls.
    """
    first, second = graph.edges.T
    weights = np.exp(-graph.lengths_m / cfg.edge_decay_m)
    if cfg.edge_sum > 0:
        weights = np.maximum(weights, np.finfo(float).tiny)
        sums = np.bincount(graph.edges.reshape(-1), np.repeat(weights, 2), minlength=len(graph.ids))
        weights = cfg.edge_sum * weights / (np.sqrt(sums[first]) * np.sqrt(sums[second]))
    if cfg.edge_clearance_m > 0:
        weights = weights * np.minimum(graph.clearances_m / cfg.edge_clearance_m, 1.0)
    return weights


def field_of(state: State) -> swap.Field:
    """The Markov random field over the place graph (eqs. mrf_energy, pairwise_potential)."""
    assert state.alignment is not None
    return swap.Field(state.places.unary, state.graph.edges, state.weights, state.alignment.pairwise)


def settle(state: State, budget: Budget, whole: bool) -> None:
    """Better labels around the places whose costs changed; with `whole`, until no swap on the whole field gains."""
    places, rows = state.places, np.arange(len(state.places.labels))
    same_rows = len(rows) == len(state.solver.labels) and np.array_equal(places.solved, rows)
    labels = state.solver.update(
        field_of(state),
        places.labels,
        budget.expired,
        dirty=np.flatnonzero(places.unsettled),
        previous=None if same_rows else places.solved,
    )
    if whole:
        labels = state.solver.drain(budget.expired)
    places.unbelieved |= with_neighbours(state.graph, labels != places.labels)
    places.labels, places.solved = labels, rows
    places.unsettled[:] = False


def partition(state: State) -> list[RegionEvent]:
    """Regions of the labels as they are, with ids that last; returns what became of whom."""
    assert state.alignment is not None
    places, names = state.places, state.alignment.labels
    previous = places.regions
    component = components.components(places.labels, state.graph.edges)
    places.regions, state.next_region_id = components.track(component, previous, state.next_region_id)
    moved = places.regions != previous
    places.unbelieved |= moved  # so that followers learn the region of places far from the change
    beside = with_neighbours(state.graph, moved)  # lists of neighbours name a region that came, went or grew
    state.disturbed.update(previous[moved].tolist(), places.regions[beside].tolist())
    state.reformed.update(previous[moved].tolist(), places.regions[moved].tolist())
    _, first = np.unique(places.regions, return_index=True)
    labels = {int(places.regions[row]): names[places.labels[row]] for row in first.tolist()}
    before = {region.id: region.label for region in state.regions.values()}
    if not moved.any() and labels == before:
        return []
    return components.events(previous, places.regions, before, labels)


def believe(state: State, cfg: Config) -> None:
    """Posteriors of the places whose costs, or whose neighbours' labels, changed."""
    assert state.alignment is not None
    places, rows = state.places, np.flatnonzero(state.places.unbelieved)
    costs = posteriors.conditional_costs(field_of(state), state.graph.adjacency, places.labels, rows)
    places.posteriors[rows] = posteriors.posteriors(costs, cfg.temperature)
    state.disturbed.update(places.regions[rows].tolist())


def with_neighbours(graph: PlaceGraph, mask: np.ndarray) -> np.ndarray:
    """Mask (place,) grown by one edge."""
    grown = mask.copy()
    if mask.any():
        grown[graph.edges[mask[graph.edges[:, 0]], 1]] = True
        grown[graph.edges[mask[graph.edges[:, 1]], 0]] = True
    return grown
