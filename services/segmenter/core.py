"""Segmentation: places in, regions out (paper, Global Inference via Graph Cuts; pure).

One input at a time: `update` takes a message, changes the state and yields what is to be sent: the delta of regions and
beliefs, and requests for what is missing (a place snapshot, text embeddings, a prior).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from schemas.codec import Message, copied
from schemas.features import Pyramid, TextEmbeddings, TextRequest
from schemas.frames import PoseUpdate
from schemas.places import PlaceDelta, SnapshotRequest
from schemas.priors import Prior, PriorList, PriorRequest, Task, TaskInForce, TaskRequest
from schemas.regions import (
    ExpertVote,
    NeighbourPull,
    PosteriorReply,
    PosteriorRequest,
    Region,
    RegionDelta,
    RegionEvent,
)
from schemas.status import Tick
from services.deltas import Follower
from services.segmenter import beliefs, descriptors, geometry, publication, regions, sharing, spaces, swap
from services.segmenter.balance import BalanceConfig, label_bias
from services.segmenter.experts import REGISTRY, Vote
from services.segmenter.experts.context import Context, ObjectSettings, ObjectView, standardised
from services.segmenter.geometry import GeometryConfig
from services.segmenter.graph import PlaceGraph, apply
from services.segmenter.incremental import Settings, Solver
from services.segmenter.places import UNLABELLED, Places
from services.segmenter.sharing import SharingConfig
from services.segmenter.spaces import Spaces, SpacesConfig

BIAS_SAMPLE = 4096  # places that stand for all when the map's bias is computed


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the segmenter. Those marked (paper) are published values; the others were chosen here."""

    space: str = "conse/efficientnet-lite2/minilm-l6-v2"  # embedding space at the start; another may take over
    spaces: SpacesConfig = msgspec.field(default_factory=SpacesConfig)
    kernel: descriptors.KernelConfig = msgspec.field(default_factory=descriptors.KernelConfig)
    default_query_radius_m: float = 0.75  # r_Q until a prior is in force (paper)
    experts: dict[str, float] = msgspec.field(  # names, with their reliabilities lambda (paper)
        default_factory=lambda: {"visual": 4.0, "geometric": 1.0, "object": 1.0, "environment": 0.1}
    )
    geometry: GeometryConfig = msgspec.field(default_factory=GeometryConfig)
    objects: ObjectSettings = msgspec.field(default_factory=ObjectSettings)
    beta: float = 2.0  # weight of the pairwise term (paper)
    edge_decay_m: float = 2.0  # w_dist = exp(-length / edge_decay_m)
    edge_sum: float = 3.0  # sum of w_dist at a place, whatever the graph's density and scale; 0 = w_dist as it is
    solver: Settings = msgspec.field(default_factory=Settings)
    budget_ms: float = 40.0  # of solving per keyframe; the rest is done when idle. 0 = as long as it takes
    look_ms: float = 2.0  # of solving between two looks at the budget, see Budget
    edge_clearance_m: float = 0.0  # > 0: w_dist times min(clearance / edge_clearance_m, 1); no gain seen, so off
    probability_floor: float = 1e-6  # least probability in a logarithm, so that every cost is finite
    object_phrases: int = 2  # objects whose phrases join a region's concept, the most discriminative first
    sharing: SharingConfig = msgspec.field(default_factory=SharingConfig)  # beyond the paper
    balance: BalanceConfig = msgspec.field(default_factory=BalanceConfig)  # beyond the paper
    temperature: float = 6.0  # of the posteriors, see services.segmenter.beliefs; least calibration error on dev
    trust_half: float = 0.5  # sum of trust at which half of the unknown mass is left
    predicted_trust: float = 1.0  # sum of trust below which a place counts as predicted; one close look gives about 2
    door_clearance_m: float = 0.7  # a way between regions with at most this clearance is a door
    posterior_change: float = 0.01  # smaller changes of a belief are not sent
    footprint_cell_m: float = 0.1  # grid of the regions' areas
    prior_wait_ticks: int = 4  # ticks to wait for a task's prior before asking for it
    remembered_priors: int = 4  # priors kept that no task has asked for yet

    def __post_init__(self) -> None:
        unknown = sorted(set(self.experts) - set(REGISTRY))
        if unknown:
            raise ValueError(f"no such expert: {', '.join(unknown)}; there are {', '.join(sorted(REGISTRY))}")
        if not (self.beta >= 0 and self.edge_decay_m > 0 and self.edge_sum >= 0):
            raise ValueError("beta, edge_decay_m or edge_sum is out of range")
        if not (0 < self.probability_floor < 1 and self.trust_half > 0 and self.temperature > 0):
            raise ValueError("probability_floor, trust_half or temperature is out of range")


@dataclass
class Budget:
    """Ends solving after a number of looks. A clock would stop a replay elsewhere than the run it repeats, so each look
    stands for a fixed time: about what the solver's work between two looks takes on one core of a laptop."""

    looks: float

    def expired(self) -> bool:
        """Look."""
        self.looks -= 1
        return self.looks < 0


@dataclass(frozen=True)
class Alignment:
    """The prior in force, and its concepts in the embedding space."""

    prior: Prior
    digest: str
    text: TextEmbeddings
    pairwise: np.ndarray  # (label, label): -beta log P(ri <-> rj), zero diagonal

    @property
    def labels(self) -> list[str]:
        """Names of the prior's regions."""
        return [region.name for region in self.prior.regions]


@dataclass
class State:
    """Everything the segmenter remembers."""

    robot: str
    epoch: int
    stamp_ns: int = 0  # of the newest place delta or pyramid
    follower: Follower[PlaceDelta] = field(default_factory=Follower)
    graph_epoch: int = -1
    graph: PlaceGraph = field(default_factory=PlaceGraph)
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (edge,) w_dist
    archive: descriptors.Archive = field(default_factory=descriptors.Archive)
    evidence: descriptors.Evidence = field(default_factory=descriptors.Evidence)
    spaces: Spaces = field(default_factory=Spaces)
    query_radius_m: float = 0.0
    poses: dict[int, np.ndarray] = field(default_factory=dict)  # corrected world_from_camera by frame id
    pose_revisions: dict[int, int] = field(default_factory=dict)  # of the newest correction by the epoch of its writer
    places: Places = field(default_factory=Places.none)
    objects: ObjectView = field(default_factory=ObjectView)
    task: Task | None = None
    priors: dict[str, Prior] = field(default_factory=dict)  # by digest, latest arrival last
    texts: dict[tuple[str, ...], TextEmbeddings] = field(default_factory=dict)  # by space and concepts
    alignment: Alignment | None = None
    solver: Solver = field(default_factory=Solver)
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (label,) of the visual scores in this map
    compared: int = 0  # places whose similarity was computed, or that left, since the bias was
    next_region_id: int = 0
    regions: dict[int, Region] = field(default_factory=dict)
    disturbed: set[int] = field(default_factory=set)  # regions whose beliefs, ways or objects may have changed
    reformed: set[int] = field(default_factory=set)  # regions whose places came, went or moved
    ledger: publication.Ledger = field(default_factory=publication.Ledger)
    dirty: bool = False  # something changed since the last solution
    asked_snapshot: bool = False
    asked_text: dict[str, TextRequest] = field(default_factory=dict)  # by space
    asked_prior: bool = False
    asked_task: bool = False
    waited_ticks: int = 0
    ignored_pyramids: int = 0  # repeated, or not of this space


def empty(cfg: Config, robot: str, epoch: int) -> State:
    """The state before the first message."""
    return State(
        robot=robot,
        epoch=epoch,
        query_radius_m=cfg.default_query_radius_m,
        spaces=Spaces(cfg.space),
        solver=Solver(cfg.solver),
    )


def update(state: State, message: Message, cfg: Config) -> Iterator[Message]:
    """Take one input. Yields RegionDelta when something changed, and requests for what is missing."""
    match message:
        case PlaceDelta():
            follow_places(state, message, cfg)
        case Pyramid():
            observe(state, message, cfg)
        case PoseUpdate():
            correct_poses(state, message, cfg)
        case Task():
            take_task(state, message)
        case TaskInForce():
            if message.task is not None:
                take_task(state, message.task)
        case Prior():
            remember_prior(state, message, cfg)
        case PriorList():
            state.asked_prior, state.waited_ticks = False, 0
            for prior in reversed(message.priors):
                remember_prior(state, prior, cfg)
        case TextEmbeddings():
            take_text(state, message, cfg)
        case Tick():
            state.waited_ticks += 1
            spaces.tick(state.spaces)
            yield from spaces.questions(state.spaces, state.archive, state.robot, cfg.spaces)
            yield from follow_spaces(state, cfg)
    switched = align(state, cfg)
    yield from _requests(state, cfg)
    if switched or (state.dirty and isinstance(message, Pyramid | Tick)):
        yield from _segment(state, switched, isinstance(message, Tick), cfg)


def follow_places(state: State, delta: PlaceDelta, cfg: Config) -> None:
    """Apply what the follower lets through; new and moved places are integrated over all stored frames."""
    if delta.snapshot:
        state.asked_snapshot = False
    for ready in state.follower.take(delta):
        replaces = ready.snapshot or ready.epoch != state.graph_epoch
        step = apply(state.graph, ready, replaces)
        before, state.graph, state.graph_epoch = state.graph, step.graph, ready.epoch
        state.disturbed.update(state.places.regions[step.removed].tolist())
        state.reformed.update(state.places.regions[step.removed].tolist())
        state.ledger.forget(state.places.slots[step.removed])
        state.compared += len(step.removed)
        state.evidence.remove(before.ids[step.removed].tolist())
        state.places = state.places.realigned(step)
        state.places.reshaped |= geometry.disturbed(before, step, cfg.geometry.neighbourhood_m)
        state.weights = edge_weights(state.graph, cfg)
        unsettled = with_neighbours(state.graph, step.touched)
        state.places.unsettled |= unsettled
        state.places.unshared |= unsettled
        state.places.unbelieved |= unsettled
        state.places.doubtful |= step.moved
        state.reformed.update(state.places.regions[step.upserted].tolist())
        _reintegrate(state, np.flatnonzero(step.moved), cfg)
        state.stamp_ns = max(state.stamp_ns, ready.stamp_ns)
        state.dirty = True


def observe(state: State, pyramid: Pyramid, cfg: Config) -> None:
    """Integrate one frame into the places it sees; a repeated frame is ignored, one of another space kept apart."""
    if pyramid.frame_id in state.poses:
        pyramid = msgspec.structs.replace(pyramid, world_from_camera=state.poses[pyramid.frame_id])
    if pyramid.space != state.spaces.force:
        state.ignored_pyramids += not spaces.hear(state.spaces, pyramid, state.archive, cfg.spaces)
        return
    spaces.heard_in_force(state.spaces)
    frame = descriptors.compact(pyramid)
    if not (state.evidence.fits(frame) and state.archive.add(pyramid.frame_id, frame)):
        state.ignored_pyramids += 1
        return
    targets = descriptors.Targets(state.places.slots, state.graph.positions_m)
    seen = descriptors.integrate(state.evidence, frame, targets, state.query_radius_m, cfg.kernel)
    state.places.stale[seen] = True
    state.stamp_ns = max(state.stamp_ns, pyramid.stamp_ns)
    state.dirty = True


def correct_poses(state: State, poses: PoseUpdate, cfg: Config) -> None:
    """Re-anchor frames, and integrate afresh the places that they saw from the old pose or see from the new one.

    A frame may be corrected before its pyramid arrives. A repeated update changes nothing.
    """
    if poses.revision <= state.pose_revisions.get(poses.epoch, -1):
        return
    state.pose_revisions[poses.epoch] = poses.revision
    affected = np.zeros(len(state.graph.ids), dtype=bool)
    for frame_id, world_from_camera in zip(poses.frame_ids.tolist(), poses.world_from_camera, strict=True):
        state.poses[frame_id] = world_from_camera.copy()
        spaces.move(state.spaces, frame_id, world_from_camera)
        for frame in state.archive.move(frame_id, world_from_camera) or ():
            affected[descriptors.visible(frame, state.graph.positions_m, cfg.kernel)] = True
    if affected.any():
        _reintegrate(state, np.flatnonzero(affected), cfg)
        state.dirty = True


def follow_spaces(state: State, cfg: Config) -> Iterator[TextRequest]:
    """Put another embedding space in force when it covers the map; labels stay until they are found anew.

    Its concepts are asked for first, if a prior is in force.
    """
    name = spaces.successor(state.spaces, state.archive, cfg.spaces)
    if name is None:
        return
    text = None
    if state.alignment is not None:
        concepts = region_concepts(state.alignment.prior, cfg.object_phrases)
        text = state.texts.get(_concept_key(name, concepts))
        if text is None:
            yield from _text_request(state, name, concepts)
            return
    evidence, archive = state.evidence.blank(), state.spaces.rivals[name].archive
    targets = descriptors.Targets(state.places.slots, state.graph.positions_m)
    descriptors.integrate_all(evidence, archive, targets, state.query_radius_m, cfg.kernel)
    if not spaces.covers(evidence, state.evidence, state.places.slots, cfg.spaces):
        spaces.refuse(state.spaces, name)
        return
    state.archive, state.evidence = spaces.succeed(state.spaces, name), evidence
    state.places.stale[:], state.dirty = True, True
    if state.alignment is not None and text is not None:
        state.alignment = replace(state.alignment, text=text)


def take_task(state: State, task: Task) -> None:
    """From now on only a prior for this task counts; labels stay until it is in force. An older task changes nothing:
    a late joiner may get tasks out of order."""
    if state.task is None or task.stamp_ns >= state.task.stamp_ns:
        state.task, state.waited_ticks = task, 0


def remember_prior(state: State, prior: Prior, cfg: Config) -> None:
    """Keep the latest priors, for one may arrive before its task; other robots' go before those of the own task."""
    digest = prior.digest()
    state.priors.pop(digest, None)
    state.priors[digest] = copied(prior)
    foreign = [d for d, kept in state.priors.items() if state.task is None or not kept.answers(state.task)]
    for old in [*foreign, *state.priors][: max(len(state.priors) - cfg.remembered_priors, 0)]:
        del state.priors[old]


def take_text(state: State, text: TextEmbeddings, cfg: Config) -> None:
    """The reply to the text request under way in its space; it does not say which, hence never two at once."""
    asked = state.asked_text.pop(text.space, None)
    if asked is not None and len(text.embeddings) == len(asked.concepts):
        state.texts[_concept_key(text.space, asked.concepts)] = copied(text)
        while len(state.texts) > cfg.remembered_priors:
            del state.texts[next(iter(state.texts))]


def wanted_prior(state: State) -> tuple[str, Prior] | None:
    """The latest prior that answers the task, with its digest."""
    if state.task is None:
        return None
    answers = [(digest, prior) for digest, prior in state.priors.items() if prior.answers(state.task)]
    return answers[-1] if answers else None


def align(state: State, cfg: Config) -> bool:
    """Put the wanted prior in force once its text embeddings are there; True when it has just happened."""
    wanted = wanted_prior(state)
    if wanted is None or (state.alignment is not None and state.alignment.digest == wanted[0]):
        return False
    digest, prior = wanted
    text = state.texts.get(_concept_key(state.spaces.force, region_concepts(prior, cfg.object_phrases)))
    if text is None:
        return False
    former = state.alignment
    pairwise = -cfg.beta * np.log(np.maximum(prior.adjacency.astype(np.float64), cfg.probability_floor))
    np.fill_diagonal(pairwise, 0.0)
    state.alignment = Alignment(prior=prior, digest=digest, text=text, pairwise=pairwise)
    query_radius_m = float(np.median([region.query_radius_m for region in prior.regions]))
    if query_radius_m != state.query_radius_m:
        state.query_radius_m = query_radius_m
        _reintegrate(state, np.arange(len(state.graph.ids)), cfg)
    state.places = state.places.relabelled(len(prior.regions))
    state.bias, state.compared = np.zeros(len(prior.regions)), len(state.graph.ids)
    if len(prior.objects) != state.objects.concepts.shape[1] or former is not None:
        state.objects = ObjectView()  # its columns are the former prior's objects
    return True


def region_concepts(prior: Prior, object_phrases: int) -> list[list[str]]:
    """The phrases that describe each region: its own, and the first phrase of its most discriminative objects.

    An object's merit for a region is P(o | r) log(P(o | r) / mean over regions of P(o | r)).
    """
    concepts = [list(region.phrases) for region in prior.regions]
    if object_phrases and prior.objects:
        containment = np.maximum(prior.containment.astype(np.float64), 1e-9)
        merit = containment * np.log(containment / containment.mean(axis=0))
        for concept, row in zip(concepts, merit, strict=True):
            best = np.argsort(-row, kind="stable")[:object_phrases]
            concept.extend(prior.objects[index].phrases[0] for index in best if row[index] > 0)
    return concepts


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


def compare(state: State) -> None:
    """Similarity of the places whose evidence changed, each for itself, with each label."""
    alignment, places, rows = state.alignment, state.places, np.flatnonzero(state.places.stale)
    assert alignment is not None
    found = state.evidence.descriptors(places.slots[rows])
    if found.shape[1]:  # after the first pyramid
        places.own_similarity[rows] = standardised(found, alignment.text)
    places.stale[rows], places.unshared[rows] = False, True


def share(state: State, cfg: Config) -> None:
    """Average similarity around the places whose own, or whose edges, changed."""
    places, near = state.places, state.graph.adjacency
    rows = sharing.reached(near, places.unshared, cfg.sharing.steps)
    trust = state.evidence.trust[places.slots]
    places.similarity[rows] = sharing.shared(
        places.own_similarity, trust, near, state.weights, rows=rows, cfg=cfg.sharing
    )
    places.unshared[:], places.doubtful[rows] = False, True
    state.compared += len(rows)


def reshape(state: State, cfg: Config) -> None:
    """Local surface of the places around which the graph changed."""
    places, rows = state.places, np.flatnonzero(state.places.reshaped)
    shape = geometry.shape_of(state.graph, rows, cfg.geometry)
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
    places, prior = state.places, state.alignment.prior
    seen = np.flatnonzero(state.evidence.frames[places.slots] > 0)
    if not state.compared or not (idle or state.compared > cfg.balance.patience * len(seen)):
        return
    sample = seen[:: max(len(seen) // BIAS_SAMPLE, 1)]
    scores = state.alignment.text.temperature * places.similarity[sample]
    bias = label_bias(scores, np.array([region.existence for region in prior.regions]), cfg.balance)
    state.compared = 0
    if np.abs(bias - state.bias).max(initial=0.0) > cfg.balance.tolerance:
        state.bias = bias
        places.doubtful[seen] = True


def evaluate_experts(state: State, idle: bool, cfg: Config) -> None:
    """Unary potentials wherever an expert may have changed its mind (eqs. product_of_experts, unary_potential)."""
    reshape(state, cfg)
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


def _segment(state: State, switched: bool, idle: bool, cfg: Config) -> Iterator[RegionDelta]:
    """Experts, graph cuts, beliefs, connected components; then the difference to what was published."""
    if state.alignment is None:
        return
    evaluate_experts(state, idle or switched, cfg)
    hurried = cfg.budget_ms > 0 and not (idle or switched)
    settle(state, Budget(cfg.budget_ms / cfg.look_ms if hurried else np.inf), whole=not hurried)
    changes = partition(state)
    believe(state, cfg)
    delta = publish(state, changes, switched or state.ledger.source is None, cfg)
    state.dirty = state.solver.pending > 0 or state.compared > 0
    if delta is not None:
        yield delta


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
    component = regions.components(places.labels, state.graph.edges)
    places.regions, state.next_region_id = regions.track(component, previous, state.next_region_id)
    moved = places.regions != previous
    beside = with_neighbours(state.graph, moved)  # lists of neighbours name a region that came, went or grew
    state.disturbed.update(previous[moved].tolist(), places.regions[beside].tolist())
    state.reformed.update(previous[moved].tolist(), places.regions[moved].tolist())
    _, first = np.unique(places.regions, return_index=True)
    labels = {int(places.regions[row]): names[places.labels[row]] for row in first.tolist()}
    before = {region.id: region.label for region in state.regions.values()}
    if not moved.any() and labels == before:
        return []
    return regions.events(previous, places.regions, before, labels)


def believe(state: State, cfg: Config) -> None:
    """Posteriors of the places whose costs, or whose neighbours' labels, changed."""
    assert state.alignment is not None
    places, rows = state.places, np.flatnonzero(state.places.unbelieved)
    costs = beliefs.conditional_costs(field_of(state), state.graph.adjacency, places.labels, rows)
    places.posteriors[rows] = beliefs.posteriors(costs, cfg.temperature)
    state.disturbed.update(places.regions[rows].tolist())


def publish(state: State, events: list[RegionEvent], everything: bool, cfg: Config) -> RegionDelta | None:
    """What followers do not know yet; with `everything`, all."""
    assert state.alignment is not None
    places, prior = state.places, state.alignment.prior
    state.regions = _described(state, everything, cfg)
    fresh = np.arange(len(places.labels)) if everything else np.flatnonzero(places.unbelieved)
    places.unbelieved[:] = False
    state.disturbed.clear()
    state.reformed.clear()
    source = publication.Source(
        robot=state.robot,
        epoch=state.epoch,
        stamp_ns=state.stamp_ns,
        prior_digest=state.alignment.digest,
        environment=prior.environment,
        task=prior.task,
        space=state.spaces.force if len(state.archive) else "",
        labels=tuple(state.alignment.labels),
        energy=swap.energy(field_of(state), places.labels),
    )
    return state.ledger.tell(
        source,
        places.slots[fresh],
        _beliefs(state, fresh, cfg),
        state.regions,
        events,
        everything=everything,
        tolerance=cfg.posterior_change,
    )


def _beliefs(state: State, rows: np.ndarray, cfg: Config) -> publication.Beliefs:
    """What is believed of some places, as it travels."""
    places = state.places
    return publication.Beliefs(
        place_ids=state.graph.ids[rows],
        regions=places.regions[rows],
        posteriors=places.posteriors[rows].astype(np.float16),
        unknown=(1.0 - known_mass(state, rows, cfg)).astype(np.float16),
        predicted=state.evidence.trust[places.slots[rows]] < cfg.predicted_trust,
    )


def known_mass(state: State, rows: np.ndarray, cfg: Config) -> np.ndarray:
    """Share (row,) of a place's belief that rests on something seen and known: c_vis T / (T + T_half)."""
    trust = state.evidence.trust[state.places.slots[rows]]
    return state.places.sight[rows] * trust / (trust + cfg.trust_half)


def _described(state: State, everything: bool, cfg: Config) -> dict[int, Region]:
    """All regions; figures of those that were disturbed are computed again, and rounded, so that a region is sent again
    only when they visibly change.
    """
    graph, places = state.graph, state.places
    wanted = np.zeros(state.next_region_id + 1, dtype=bool)  # the last is NO_REGION's
    wanted[list(state.disturbed)] = True
    wanted |= everything
    rows = np.flatnonzero(wanted[places.regions])
    order = rows[np.argsort(places.regions[rows], kind="stable")]
    ids, starts = np.unique(places.regions[order], return_index=True)
    border = regions.border(graph, places.regions, set(ids.tolist()), cfg.door_clearance_m)
    objects = regions.members(state.objects, graph.positions_m, places.regions, rows)
    found = {} if everything else {number: region for number, region in state.regions.items() if not wanted[number]}
    for number, members in zip(ids.tolist(), np.split(order, starts[1:]), strict=False):
        formed = everything or number in state.reformed or number not in state.regions
        found[number] = msgspec.structs.replace(
            _formed(state, members, cfg) if formed else state.regions[number],
            **_believed(state, members, cfg),
            neighbour_ids=border.neighbours.get(number, []),
            transitions=border.transitions.get(number, []),
            object_ids=objects.get(number, []),
        )
    return found


def _formed(state: State, rows: np.ndarray, cfg: Config) -> Region:
    """What the places `rows` of one region say of its shape."""
    positions_m, radii_m = state.graph.positions_m[rows], state.graph.radii_m[rows]
    x, y, z = positions_m.mean(axis=0).tolist()
    return Region(
        id=int(state.places.regions[rows[0]]),
        label="",
        place_count=len(rows),
        probability=0.0,
        position_m=(round(x, 2), round(y, 2), round(z, 2)),
        area_m2=round(regions.footprint_m2(positions_m, radii_m, cfg.footprint_cell_m), 2),
        hull_m=regions.hull_m(positions_m, radii_m),
    )


def _believed(state: State, rows: np.ndarray, cfg: Config) -> dict[str, Any]:
    """What the places `rows` of one region say of its label, by the fields of Region."""
    assert state.alignment is not None
    places, label = state.places, int(state.places.labels[rows[0]])
    predicted = state.evidence.trust[places.slots[rows]] < cfg.predicted_trust
    return {
        "label": state.alignment.labels[label],
        "parent": state.alignment.prior.regions[label].parent,
        "probability": round(float(places.posteriors[rows, label].mean()), 2),
        "unknown": round(1.0 - float(known_mass(state, rows, cfg).mean()), 2),
        "predicted": bool(predicted.mean() > 0.5),
    }


def snapshot(state: State) -> RegionDelta:
    """Everything published so far, as one delta."""
    return state.ledger.snapshot(state.robot, state.epoch)


def explain(state: State, request: PosteriorRequest, cfg: Config) -> PosteriorReply:
    """Each expert's vote on one place, its neighbours' pull, and what follows, as of the last update."""
    row = int(state.graph.rows(np.array([request.place_id]))[0])
    if row < 0 or state.alignment is None or state.places.labels[row] == UNLABELLED:
        return PosteriorReply(robot=state.robot, place_id=request.place_id, found=False)
    places, names, near = state.places, state.alignment.labels, state.graph.adjacency
    rows, slot = np.array([row]), int(places.slots[row])
    answers = votes(state, rows, cfg)
    unary = sum(-cfg.experts[name] * sure[0] * log[0] for name, (log, sure) in answers.items())
    costs = beliefs.conditional_costs(field_of(state), near, places.labels, rows)
    arcs = range(near.starts[row], near.starts[row + 1])
    return PosteriorReply(
        robot=state.robot,
        place_id=request.place_id,
        found=True,
        label=names[places.labels[row]],
        labels=names,
        posterior=beliefs.posteriors(costs, cfg.temperature)[0].tolist(),
        unary=unary.tolist(),
        votes=[
            ExpertVote(
                expert=name,
                confidence=float(sure[0]),
                weight=float(sure[0] * cfg.experts[name]),
                log_probabilities=log[0].tolist(),
            )
            for name, (log, sure) in answers.items()
        ],
        frames=int(state.evidence.frames[slot]),
        trust=float(state.evidence.trust[slot]),
        position_m=tuple(state.graph.positions_m[row].tolist()),
        region=int(places.regions[row]),
        pull=(costs[0] - places.unary[row]).tolist(),
        neighbours=[
            NeighbourPull(
                place_id=int(state.graph.ids[near.neighbours[at]]),
                label=names[places.labels[near.neighbours[at]]],
                weight=float(state.weights[near.edges[at]]),
            )
            for at in arcs
        ],
        unknown=1.0 - float(known_mass(state, rows, cfg)[0]),
        predicted=bool(state.evidence.trust[slot] < cfg.predicted_trust),
        temperature=cfg.temperature,
        inclination_rad=float(places.inclination_rad[row]),
    )


def _requests(state: State, cfg: Config) -> Iterator[Message]:
    """Ask for what is missing and not asked for yet; first, for the task that was given before this process began."""
    if not state.asked_task:
        state.asked_task = True
        yield TaskRequest(robot=state.robot)
    if state.follower.needs_snapshot and not state.asked_snapshot:
        state.asked_snapshot = True
        yield SnapshotRequest(robot=state.robot)
    wanted = wanted_prior(state)
    if wanted is None:
        if state.task is not None and state.waited_ticks >= cfg.prior_wait_ticks and not state.asked_prior:
            state.asked_prior = True
            task = state.task
            yield PriorRequest(environment=task.environment, task=task.task, regions=task.regions)
        return
    if state.alignment is not None and state.alignment.digest == wanted[0]:
        return
    concepts = region_concepts(wanted[1], cfg.object_phrases)
    yield from _text_request(state, state.spaces.force, concepts)


def _text_request(state: State, space: str, concepts: list[list[str]]) -> Iterator[TextRequest]:
    if space not in state.asked_text:
        state.asked_text[space] = TextRequest(space=space, concepts=concepts)
        yield state.asked_text[space]


def _reintegrate(state: State, rows: np.ndarray, cfg: Config) -> None:
    """Compute the evidence of some places afresh from all stored frames."""
    if not len(rows):
        return
    place_ids = state.graph.ids[rows].tolist()
    state.evidence.add(place_ids)
    state.places.slots[rows] = state.evidence.of(place_ids)
    targets = descriptors.Targets(state.places.slots[rows], state.graph.positions_m[rows])
    descriptors.integrate_all(state.evidence, state.archive, targets, state.query_radius_m, cfg.kernel)
    state.places.stale[rows] = True


def with_neighbours(graph: PlaceGraph, mask: np.ndarray) -> np.ndarray:
    """Mask (place,) grown by one edge."""
    grown = mask.copy()
    if mask.any():
        grown[graph.edges[mask[graph.edges[:, 0]], 1]] = True
        grown[graph.edges[mask[graph.edges[:, 1]], 0]] = True
    return grown


def _concept_key(space: str, concepts: list[list[str]]) -> tuple[str, ...]:
    return (space, *("\n".join(phrases) for phrases in concepts))
