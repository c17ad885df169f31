"""From evidence to labels and beliefs: experts, energy, swaps, components (paper, Global Inference; pure).

Masks in `Places` say what changed; each function here does again only what its mask names, and marks what follows.
"""

from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
import scipy

from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.segmenter.core.appearance import adaptation, information, smoothing, unmixing
from prior_sg.services.segmenter.core.appearance.label_bias import label_bias
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy import posteriors
from prior_sg.services.segmenter.core.energy.mrf import Field
from prior_sg.services.segmenter.core.energy.region_cost import passes
from prior_sg.services.segmenter.core.evidence import surfaces
from prior_sg.services.segmenter.core.evidence.kernel import Frame
from prior_sg.services.segmenter.core.experts import REGISTRY, Vote
from prior_sg.services.segmenter.core.experts.contents import words_of_contents
from prior_sg.services.segmenter.core.experts.context import Context, ObjectView, standardised
from prior_sg.services.segmenter.core.labelling import LOOKS
from prior_sg.services.segmenter.core.map import inclination
from prior_sg.services.segmenter.core.map.received import realigned, with_neighbours
from prior_sg.services.segmenter.core.map.table import UNLABELLED
from prior_sg.services.segmenter.core.regions.contents import held_around
from prior_sg.services.segmenter.core.slices import Parts, at_once
from prior_sg.services.segmenter.core.state import State

BIAS_SAMPLE = 4096  # places that stand for all when the map's bias is computed
LEAST_SURE = 10.0  # times the configured temperature at most, however little crops tell
TOLD_TOLERANCE = 0.1  # smaller relative changes of what crops tell are not worth finding all beliefs again
PROVEN = 1.6  # times what contents weigh once they were found to tell what looks are worth
VISITS = 10  # what an expert, or what it looks at, takes for a place, as `slices` counts
CORRECTION_TOLERANCE = 0.01  # smaller changes, in spreads of similarity, are not worth asking the experts again


@dataclass
class Budget:
    """Ends solving after a number of looks. A clock would stop a replay elsewhere than the run it repeats, so each look
    stands for a fixed time: about what the solver's work between two looks takes on one core of a laptop."""

    looks: float

    def expired(self) -> bool:
        """Look."""
        self.looks -= 1
        return self.looks < 0


class Crops(NamedTuple):
    """Crops of some frames, by id, and how similar each looks to each label (crop, label), in spreads."""

    frames: dict[int, Frame]
    looks: np.ndarray


def votes(state: State, rows: np.ndarray, cfg: Config) -> dict[str, Vote]:
    """Each configured expert's vote on the places in `rows`; probabilities are floored."""
    context = context_of(state, rows, cfg)
    floor = np.log(cfg.probability_floor)
    answers = {name: REGISTRY[name](context) for name in cfg.experts}
    return {name: (np.maximum(log_probabilities, floor), sure) for name, (log_probabilities, sure) in answers.items()}


def weights(state: State, answers: dict[str, Vote], cfg: Config) -> dict[str, np.ndarray]:
    """Weight (place,) of each expert's vote: its confidence times its reliability. Where robots have found what looks
    are worth beside what regions hold, looks weigh no more than that there, and contents more."""
    found = {name: sure * cfg.experts[name] for name, (_, sure) in answers.items()}
    tested = state.aim.aligned.prior.tested
    if tested is not None and tested.looks is not None and "visual" in found and "contents" in found:
        found["visual"] = found["visual"] * np.where(answers["contents"][1] > 0, tested.looks, 1.0)
        found["contents"] = found["contents"] * PROVEN
    return found


def context_of(state: State, rows: np.ndarray, cfg: Config) -> Context:
    """What experts may look at to judge the places in `rows`."""
    aligned = state.aim.aligned
    return Context(
        prior=aligned.prior,
        text=aligned.text,
        similarity=state.map.places.looks(rows),
        frames=state.seen.evidence.frames[state.map.places.slots[rows]],
        bias=state.labelling.bias,
        positions_m=state.map.graph.positions_m[rows],
        radii_m=state.map.graph.radii_m[rows],
        inclination_rad=state.map.places.inclination_rad[rows],
        support=state.map.places.support[rows],
        anisotropy=state.map.places.anisotropy[rows],
        objects=state.objects.view,
        contents=state.map.places.contents[rows],
        object_settings=cfg.objects,
    )


def survey_due(state: State, idle: bool, anew: bool, cfg: Config) -> bool:
    """Whether to look over the whole map now: on a tick after enough of it was seen anew, or when it rests; and
    whenever all is found `anew`."""
    places, evidence, labelling = state.map.places, state.seen.evidence, state.labelling
    labelling.unsurveyed += int(places.stale.sum())
    if not (idle or anew):
        return False
    seen = int((evidence.trust[places.slots] > 0).sum())
    due = idle and labelling.survey_due(seen, state.seen.rests, cfg.adaptation.patience)
    return (due or anew) and seen > 0


def adapt(state: State, anew: bool, cfg: Config) -> Parts[None]:
    """What the labels look like in this map; unless it is `anew`, left as it is while it would change little."""
    places, evidence, labelling = state.map.places, state.seen.evidence, state.labelling
    if not cfg.adaptation.weight:
        return
    doubted = msgspec.structs.replace(cfg.adaptation, weight=cfg.adaptation.weight * (1 - worth(state, cfg)))
    seen = np.flatnonzero(evidence.trust[places.slots] > 0)
    found = evidence.descriptors(places.slots[seen]).astype(np.float32)
    similarity = standardised(found, state.aim.aligned.text)
    everywhere = np.zeros((len(places.slots), similarity.shape[1]))

    def labels_of(own: np.ndarray) -> np.ndarray:
        everywhere[seen] = own
        return _visual_labels(state, everywhere, seen, cfg)

    masses = np.minimum(evidence.trust[places.slots[seen]], cfg.sharing.trust_limit)
    yield VISITS * len(seen)
    visits = VISITS * len(places.slots)
    now = yield from adaptation.adapted(found, similarity, masses, labels_of, doubted, visits=visits)
    tolerance = 0.0 if anew else cfg.adaptation.tolerance
    if adaptation.differs(now, labelling.adaptation, found, similarity, tolerance):
        labelling.adaptation = now
        places.stale[seen] = True


def _visual_labels(state: State, own: np.ndarray, rows: np.ndarray, cfg: Config) -> np.ndarray:
    """The label (row,) that each of some places looks most like, from the own similarities (place, label) of all."""
    trust = state.seen.evidence.trust[state.map.places.slots]
    around = smoothing.shared(own, trust, state.map.ties, rows=rows, cfg=cfg.sharing)
    scores = state.aim.aligned.text.temperature * around
    return np.argmax(scores + _bias(state, scores, cfg), axis=1)


def crops_of(state: State) -> Crops:
    """The crops that stand for all of the map."""
    frames = surfaces.sampled(state.seen.archive.by_number)
    if not frames:
        return Crops({}, np.zeros((0, len(state.aim.aligned.labels))))
    found = np.concatenate([frame.embeddings for frame in frames.values()]).astype(np.float64)
    return Crops(frames, standardised(found, state.aim.aligned.text))


def weigh(state: State, crops: Crops, anew: bool) -> None:
    """How much the crops of this map tell of the labels."""
    told = information.told(state.aim.aligned.text.temperature * crops.looks)
    if abs(told - state.labelling.told) > (0.0 if anew else TOLD_TOLERANCE * told):
        state.labelling.told = told
        state.map.places.unbelieved[:] = True


def worth(state: State, cfg: Config) -> float:
    """What the looks of this map are worth, in [0, 1]."""
    return information.worth(state.labelling.told, cfg.information)


def tell_apart(state: State, crops: Crops, anew: bool, cfg: Config) -> Parts[None]:
    """What all crops together say of each place beyond its neighbours."""
    graph, places = state.map.graph, state.map.places
    counts = worth(state, cfg)
    now = np.zeros_like(places.similarity)
    if crops.frames and cfg.unmixing.rounds and counts > 0:
        spheres = surfaces.Spheres(graph.ids, graph.positions_m, graph.radii_m)
        shares = yield from state.seen.shown.shares(crops.frames, spheres)
        apart = yield from unmixing.unmixed(places.similarity, crops.looks, shares, state.map.ties, cfg.unmixing)
        now = counts * (apart - places.similarity)
    moved = (np.abs(now - places.correction) > (0.0 if anew else CORRECTION_TOLERANCE)).any(axis=1)
    places.correction[moved] = now[moved]
    places.doubtful |= moved
    state.labelling.compared += int(moved.sum())


def _bias(state: State, scores: np.ndarray, cfg: Config) -> np.ndarray:
    """The bias of each label, from the scores (place, label) of the observed places."""
    doubted = msgspec.structs.replace(cfg.balance, limit=cfg.balance.limit * (1 - worth(state, cfg)))
    return label_bias(scores[:: max(len(scores) // BIAS_SAMPLE, 1)], state.aim.aligned.existence, doubted)


def compare(state: State) -> None:
    """Similarity of the places whose evidence changed, each for itself, with each label."""
    places, rows = state.map.places, np.flatnonzero(state.map.places.stale)
    found = state.seen.evidence.descriptors(places.slots[rows])
    if found.shape[1]:  # after the first pyramid
        own, added = standardised(found, state.aim.aligned.text), state.labelling.adaptation.similarity(found)
        places.own_similarity[rows] = own + added
    places.stale[rows], places.unshared[rows] = False, True


def share(state: State, cfg: Config) -> None:
    """Average similarity around the places whose own, or whose edges, changed."""
    places, ties = state.map.places, state.map.ties
    rows = smoothing.reached(ties, places.unshared, cfg.sharing.steps)
    trust = state.seen.evidence.trust[places.slots]
    places.similarity[rows] = smoothing.shared(places.own_similarity, trust, ties, rows=rows, cfg=cfg.sharing)
    places.unshared[:], places.doubtful[rows] = False, True
    state.labelling.compared += len(rows)


def reshape(state: State, cfg: Config) -> None:
    """Local surface of the places around which the graph changed."""
    places, rows = state.map.places, np.flatnonzero(state.map.places.reshaped)
    shape = inclination.shape_of(state.map.graph, rows, cfg.geometry)
    places.inclination_rad[rows], places.support[rows], places.anisotropy[rows] = shape
    places.reshaped[rows], places.doubtful[rows] = False, True


def see_objects(state: State, view: ObjectView, cfg: Config) -> None:
    """From now on these are the objects of the map; the places near those that are new, changed or gone ask again."""
    changed_m = state.objects.see(view)
    if len(changed_m):
        state.labelling.give_up()
    if len(changed_m) and len(state.map.graph.ids):
        tree = scipy.spatial.cKDTree(changed_m)
        distances_m, _ = tree.query(state.map.graph.positions_m, distance_upper_bound=cfg.objects.reach_m)
        near = np.isfinite(distances_m)
        state.map.places.doubtful |= near
        state.regions.disturb(state.map.places.regions[near])
        state.labelling.dirty = True
        state.labelling.look_into_regions()


def rebalance(state: State, idle: bool, anew: bool, cfg: Config) -> None:
    """The map's bias, after enough of the map was seen anew, when idle, or with all else `anew`; everybody asks again
    when it has moved."""
    places, labelling = state.map.places, state.labelling
    seen = np.flatnonzero(state.seen.evidence.frames[places.slots] > 0)
    if not (labelling.bias_due(len(seen), idle, cfg.balance.patience) or anew):
        return
    bias = _bias(state, state.aim.aligned.text.temperature * places.looks(seen), cfg)
    if np.abs(bias - labelling.bias).max(initial=0.0) > (0.0 if anew else cfg.balance.tolerance):
        labelling.bias = bias
        places.doubtful[seen] = True


def weigh_contents(state: State, regions: np.ndarray) -> bool:
    """What the objects of each of `regions` (place,) say of its places' label; whether that is something else now."""
    places = state.map.places
    found = held_around(state.objects.view, state.map.graph.positions_m, regions)
    now = words_of_contents(state.aim.aligned.prior, found) if found.shape[1] else np.zeros_like(places.contents)
    moved = (np.abs(now - places.contents) > CORRECTION_TOLERANCE).any(axis=1)
    places.contents[moved] = now[moved]
    places.doubtful |= moved
    return bool(moved.any())


def label_anew(state: State, cfg: Config) -> Parts[None]:
    """Labels from all that is known, whatever they were and in whatever order it came to be known, part by part.

    What regions hold has no say at first; then, a few times, that of the regions that follow.
    """
    labelling, places = state.labelling, state.map.places
    if state.objects.present is not None:
        see_objects(state, state.objects.present, cfg)
    places.doubtful |= places.contents.any(axis=1)
    places.contents[:] = 0.0
    labelling.looks_left = LOOKS if labelling.contents_count else 0
    yield from _evaluating(state, True, cfg, anew=True)
    yield from settling(state, cfg, hurried=False, anew=True)
    while labelling.looks_left:
        labelling.looked_into_regions(weigh_contents(state, state.regions.parts(state.map, cfg.layers.storeys)))
        yield VISITS * len(places.labels)
        ask_experts(state, cfg)
        yield from settling(state, cfg, hurried=False, anew=True)


def evaluate_experts(state: State, idle: bool, cfg: Config) -> None:
    """What experts look at, and their votes, brought up to date where it changed. Regions are looked into on ticks,
    once there are any."""
    at_once(_evaluating(state, idle, cfg))


def _evaluating(state: State, idle: bool, cfg: Config, *, anew: bool = False) -> Parts[None]:
    """`evaluate_experts` part by part; with `anew`, also where so little changed that it is left else."""
    places = state.map.places
    yield VISITS * int(np.count_nonzero(places.reshaped))
    reshape(state, cfg)
    surveyed = survey_due(state, idle, anew, cfg)
    if surveyed:
        crops = crops_of(state)
        weigh(state, crops, anew)
        yield from adapt(state, anew, cfg)
    yield 3 * VISITS * int(np.count_nonzero(places.stale))
    compare(state)
    yield VISITS * int(np.count_nonzero(places.unshared))
    share(state, cfg)
    if surveyed:
        yield from tell_apart(state, crops, anew, cfg)
    rebalance(state, idle, anew, cfg)
    if idle and state.labelling.looks_left and not anew and (places.regions != NO_REGION).any():
        state.labelling.looked_into_regions(weigh_contents(state, places.regions))
    yield VISITS * int(np.count_nonzero(places.doubtful))
    ask_experts(state, cfg)


def ask_experts(state: State, cfg: Config) -> None:
    """Unary potentials wherever an expert may have changed its mind (eqs. product_of_experts, unary_potential)."""
    places, rows = state.map.places, np.flatnonzero(state.map.places.doubtful)
    answers = votes(state, rows, cfg)
    unary = np.zeros((len(rows), places.unary.shape[1]))
    for name, weight in weights(state, answers, cfg).items():
        unary -= weight[:, None] * answers[name][0]
    changed = rows[(unary != places.unary[rows]).any(axis=1)]
    places.unary[rows] = unary
    places.sight[rows] = answers["visual"][1] if "visual" in answers else 0.0
    places.doubtful[rows], places.unbelieved[rows], places.unsettled[changed] = False, True, True


def field_of(state: State) -> Field:
    """The Markov random field over the place graph (eqs. mrf_energy, pairwise_potential)."""
    return Field(state.map.places.unary, state.map.graph.edges, state.map.weights, state.aim.aligned.pairwise)


def settle(state: State, cfg: Config, *, hurried: bool) -> None:
    """Better labels around the places whose costs changed, within the budget where `hurried`; otherwise until no swap
    on the whole field gains. Regions that do not pay for themselves then become part of a neighbour."""
    at_once(settling(state, cfg, hurried=hurried))


def settling(state: State, cfg: Config, *, hurried: bool, anew: bool = False) -> Parts[None]:
    """`settle` part by part. With `anew`, labels do not go on from those before: which of several labellings none of
    which a swap betters is found, then depends on the field alone."""
    places, labelling = state.map.places, state.labelling
    if anew:
        labelling.forget_labels()
        places.cut_labels[:] = UNLABELLED
    solver = labelling.solver
    limited = hurried and cfg.budget_ms > 0
    budget = Budget(cfg.budget_ms / cfg.look_ms if limited else np.inf)
    rows = np.arange(len(places.labels))
    same_rows = len(rows) == len(solver.labels) and np.array_equal(places.solved, rows)
    solver.take(
        field_of(state),
        places.cut_labels,
        dirty=np.flatnonzero(places.unsettled),
        previous=None if same_rows else places.solved,
        ties=state.map.ties,
    )
    yield from solver.updating(budget.expired)
    if not limited:
        yield from solver.draining(budget.expired)
    labels = solver.labels.copy()
    former = labelling.passes if same_rows else [realigned(one, places.solved, UNLABELLED) for one in labelling.passes]
    places.cut_labels, places.solved = labels, rows
    changed = np.flatnonzero(places.unsettled)
    labelling.passes = passes(field_of(state), labels, cfg.region_cost, former, changed=changed, ties=state.map.ties)
    labels = labelling.passes[-1].copy()
    relabelled = labels != places.labels
    places.unbelieved |= with_neighbours(state.map.graph, relabelled)
    places.unparted |= relabelled
    places.labels = labels
    places.unsettled[:] = False


def temperature(state: State, cfg: Config) -> float:
    """Of the posteriors: the higher, the less the crops of this map tell of the labels."""
    if not cfg.informed:
        return cfg.temperature
    return cfg.temperature * min(max(cfg.informed / max(state.labelling.told, 1e-9), 1.0), LEAST_SURE)


def believe(state: State, cfg: Config) -> None:
    """Posteriors of the places whose costs, or whose neighbours' labels, changed."""
    places, rows = state.map.places, np.flatnonzero(state.map.places.unbelieved)
    costs = posteriors.conditional_costs(field_of(state), state.map.ties, places.labels, rows)
    places.posteriors[rows] = posteriors.posteriors(costs, temperature(state, cfg))
    state.regions.disturb(places.regions[rows])
