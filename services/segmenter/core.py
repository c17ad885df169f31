"""Segmentation: places in, regions out (paper, Global Inference via Graph Cuts; pure).

One input at a time: `update` takes a message, changes the state and yields what is to be sent: the delta of regions and
beliefs, and requests for what is missing (a place snapshot, text embeddings, a prior).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np

from schemas.codec import Message, copied
from schemas.features import Pyramid, TextEmbeddings, TextRequest
from schemas.places import PlaceDelta, SnapshotRequest
from schemas.priors import Prior, PriorList, PriorRequest, Task, TaskInForce, TaskRequest
from schemas.regions import ExpertVote, PosteriorReply, PosteriorRequest, Region, RegionDelta
from schemas.status import Tick
from services.deltas import Follower
from services.segmenter import descriptors, geometry, publication, regions, swap
from services.segmenter.balance import BalanceConfig, label_bias
from services.segmenter.experts import REGISTRY, Vote
from services.segmenter.experts.context import Context, ObjectSettings, ObjectView, standardised
from services.segmenter.geometry import GeometryConfig
from services.segmenter.graph import PlaceGraph, Step, apply

UNLABELLED = -1


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the segmenter. Those marked (paper) are published values; the others were chosen here."""

    space: str = "conse/efficientnet-lite2/minilm-l6-v2"  # embedding space of the evidence; other pyramids are ignored
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
    edge_clearance_m: float = 0.0  # > 0: w_dist times min(clearance / edge_clearance_m, 1); no gain seen, so off
    probability_floor: float = 1e-6  # least probability in a logarithm, so that every cost is finite
    object_phrases: int = 2  # objects whose phrases join a region's concept, the most discriminative first
    balance: BalanceConfig = msgspec.field(default_factory=BalanceConfig)  # beyond the paper
    trust_half: float = 0.5  # sum of trust at which half of the unknown mass is left
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
        if not (0 < self.probability_floor < 1 and self.trust_half > 0):
            raise ValueError("probability_floor or trust_half is out of range")


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
class Places:
    """What is known and believed of each place, in the order of the graph's rows."""

    labels: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # UNLABELLED = not yet
    regions: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    similarity: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (place, label) standardised
    unary: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (place, label)
    known: np.ndarray = field(default_factory=lambda: np.zeros(0))  # c_vis T / (T + T_half)
    inclination_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))  # of the local surface
    support: np.ndarray = field(default_factory=lambda: np.zeros(0))
    anisotropy: np.ndarray = field(default_factory=lambda: np.zeros(0))
    stale: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))  # similarity is to be computed again
    reshaped: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))  # and so is the local surface

    def realigned(self, step: Step) -> "Places":
        """The same beliefs on the rows of the next graph; new places have none."""
        old = step.previous >= 0
        after = Places(
            labels=np.full(len(old), UNLABELLED),
            regions=np.full(len(old), regions.NO_REGION),
            similarity=np.zeros((len(old), self.similarity.shape[1])),
            unary=np.zeros((len(old), self.unary.shape[1])),
            known=np.zeros(len(old)),
            inclination_rad=np.zeros(len(old)),
            support=np.zeros(len(old)),
            anisotropy=np.zeros(len(old)),
            stale=step.moved.copy(),
            reshaped=np.zeros(len(old), dtype=bool),
        )
        before = step.previous[old]
        for name in ("labels", "regions", "similarity", "unary", "known", "inclination_rad", "support", "anisotropy"):
            getattr(after, name)[old] = getattr(self, name)[before]
        after.stale[old] |= self.stale[before]
        after.reshaped[old] |= self.reshaped[before]
        return after


@dataclass
class State:
    """Everything the segmenter remembers."""

    robot: str
    epoch: int
    stamp_ns: int = 0  # of the newest place delta or pyramid
    follower: Follower[PlaceDelta] = field(default_factory=Follower)
    graph_epoch: int = -1
    graph: PlaceGraph = field(default_factory=PlaceGraph)
    archive: descriptors.Archive = field(default_factory=descriptors.Archive)
    evidence: descriptors.Evidence = field(default_factory=descriptors.Evidence)
    query_radius_m: float = 0.0
    places: Places = field(default_factory=Places)
    objects: ObjectView = field(default_factory=ObjectView)
    task: Task | None = None
    priors: dict[str, Prior] = field(default_factory=dict)  # by digest, latest arrival last
    texts: dict[tuple[str, ...], TextEmbeddings] = field(default_factory=dict)  # by concepts
    alignment: Alignment | None = None
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (label,) of the visual scores in this map
    next_region_id: int = 0
    published: publication.View | None = None
    dirty: bool = False  # something changed since the last solution
    asked_snapshot: bool = False
    asked_text: TextRequest | None = None
    asked_prior: bool = False
    asked_task: bool = False
    waited_ticks: int = 0
    ignored_pyramids: int = 0  # repeated, or not of this space


def empty(cfg: Config, robot: str, epoch: int) -> State:
    """The state before the first message."""
    return State(robot=robot, epoch=epoch, query_radius_m=cfg.default_query_radius_m)


def update(state: State, message: Message, cfg: Config) -> Iterator[Message]:
    """Take one input. Yields RegionDelta when something changed, and requests for what is missing."""
    match message:
        case PlaceDelta():
            follow_places(state, message, cfg)
        case Pyramid():
            observe(state, message, cfg)
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
    switched = align(state, cfg)
    yield from _requests(state, cfg)
    if switched or (state.dirty and isinstance(message, Pyramid | Tick)):
        yield from _segment(state, switched, cfg)


def follow_places(state: State, delta: PlaceDelta, cfg: Config) -> None:
    """Apply what the follower lets through; new and moved places are integrated over all stored frames."""
    if delta.snapshot:
        state.asked_snapshot = False
    for ready in state.follower.take(delta):
        replaces = ready.snapshot or ready.epoch != state.graph_epoch
        step = apply(state.graph, ready, replaces)
        state.places = state.places.realigned(step)
        state.places.reshaped |= geometry.disturbed(state.graph, step, cfg.geometry.neighbourhood_m)
        state.evidence.remove(state.graph.ids[step.removed].tolist())
        state.graph, state.graph_epoch = step.graph, ready.epoch
        _reintegrate(state, np.flatnonzero(step.moved), cfg)
        state.stamp_ns = max(state.stamp_ns, ready.stamp_ns)
        state.dirty = True


def observe(state: State, pyramid: Pyramid, cfg: Config) -> None:
    """Integrate one frame into the places it sees; a repeated frame or another space is ignored."""
    if pyramid.space != cfg.space:
        state.ignored_pyramids += 1
        return
    frame = descriptors.compact(pyramid)
    if not (state.evidence.fits(frame) and state.archive.add(pyramid.frame_id, frame)):
        state.ignored_pyramids += 1
        return
    seen = descriptors.integrate(
        state.evidence, frame, _targets(state, np.arange(len(state.graph.ids))), state.query_radius_m, cfg.kernel
    )
    state.places.stale[seen] = True
    state.stamp_ns = max(state.stamp_ns, pyramid.stamp_ns)
    state.dirty = True


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
    """The reply to the one text request under way; it does not say which, hence never two at once."""
    asked, state.asked_text = state.asked_text, None
    if asked is not None and text.space == asked.space and len(text.embeddings) == len(asked.concepts):
        state.texts[_concept_key(asked.concepts)] = copied(text)
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
    text = state.texts.get(_concept_key(region_concepts(prior, cfg.object_phrases)))
    if text is None:
        return False
    pairwise = -cfg.beta * np.log(np.maximum(prior.adjacency.astype(np.float64), cfg.probability_floor))
    np.fill_diagonal(pairwise, 0.0)
    state.alignment = Alignment(prior=prior, digest=digest, text=text, pairwise=pairwise)
    query_radius_m = float(np.median([region.query_radius_m for region in prior.regions]))
    if query_radius_m != state.query_radius_m:
        state.query_radius_m = query_radius_m
        _reintegrate(state, np.arange(len(state.graph.ids)), cfg)
    state.places.labels[:] = UNLABELLED
    state.places.similarity = np.zeros((len(state.graph.ids), len(prior.regions)))
    state.places.unary = np.zeros((len(state.graph.ids), len(prior.regions)))
    state.bias = np.zeros(len(prior.regions))
    state.places.stale[:] = True
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
        frames=state.evidence.frames[state.evidence.of(state.graph.ids[rows].tolist())],
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
    """Similarity of the places whose evidence changed with each label."""
    alignment, evidence, rows = state.alignment, state.evidence, np.flatnonzero(state.places.stale)
    assert alignment is not None
    found = evidence.descriptors(evidence.of(state.graph.ids[rows].tolist()))
    if found.shape[1]:  # after the first pyramid
        state.places.similarity[rows] = standardised(found, alignment.text)
    state.places.stale[rows] = False


def reshape(state: State, cfg: Config) -> None:
    """Local surface of the places around which the graph changed."""
    places, rows = state.places, np.flatnonzero(state.places.reshaped)
    shape = geometry.shape_of(state.graph, rows, cfg.geometry)
    places.inclination_rad[rows], places.support[rows], places.anisotropy[rows] = shape
    places.reshaped[rows] = False


def see_objects(state: State, objects: ObjectView) -> None:
    """From now on these are the objects of the map."""
    state.objects, state.dirty = objects, True


def evaluate_experts(state: State, cfg: Config) -> None:
    """Unary potentials of all places (eqs. product_of_experts, unary_potential), after the map's bias is known."""
    assert state.alignment is not None
    reshape(state, cfg)
    compare(state)
    places, prior, slots = state.places, state.alignment.prior, state.evidence.of(state.graph.ids.tolist())
    scores = state.alignment.text.temperature * places.similarity[state.evidence.frames[slots] > 0]
    existence = np.array([region.existence for region in prior.regions])
    state.bias = label_bias(scores, existence, cfg.balance)
    answers = votes(state, np.arange(len(slots)), cfg)
    places.unary = np.zeros((len(slots), len(existence)))
    for name, (log_probabilities, confidence) in answers.items():
        places.unary -= (confidence * cfg.experts[name])[:, None] * log_probabilities
    trust = state.evidence.trust[slots]
    sight = answers["visual"][1] if "visual" in answers else np.zeros(len(slots))
    places.known = sight * trust / (trust + cfg.trust_half)


def edge_weights(graph: PlaceGraph, cfg: Config) -> np.ndarray:
    """w_dist (edge,) of eq. pairwise_potential: falls with length, then scaled symmetrically.

    With w and the sums of w at both ends, d_u and d_v, the weight is edge_sum w / sqrt(d_u d_v): a place is held by its
    neighbours about as firmly in a dense graph of small rooms as in a sparse one of large halls.
    """
    first, second = graph.edges.T
    lengths_m = np.linalg.norm(graph.positions_m[first] - graph.positions_m[second], axis=1)
    weights = np.exp(-lengths_m / cfg.edge_decay_m)
    if cfg.edge_sum > 0:
        weights = np.maximum(weights, np.finfo(float).tiny)
        sums = np.bincount(graph.edges.reshape(-1), np.repeat(weights, 2), minlength=len(graph.ids))
        weights = cfg.edge_sum * weights / (np.sqrt(sums[first]) * np.sqrt(sums[second]))
    if cfg.edge_clearance_m > 0:
        weights = weights * np.minimum(graph.clearances_m / cfg.edge_clearance_m, 1.0)
    return weights


def field_of(state: State, cfg: Config) -> swap.Field:
    """The Markov random field over the place graph (eqs. mrf_energy, pairwise_potential)."""
    assert state.alignment is not None
    return swap.Field(state.places.unary, state.graph.edges, edge_weights(state.graph, cfg), state.alignment.pairwise)


def _segment(state: State, switched: bool, cfg: Config) -> Iterator[RegionDelta]:
    """Experts, graph cuts, connected components; then the difference to what was published."""
    if state.alignment is None:
        return
    places = state.places
    evaluate_experts(state, cfg)
    mrf = field_of(state, cfg)
    start = np.where(places.labels == UNLABELLED, places.unary.argmin(axis=1), places.labels)
    places.labels = swap.minimise(mrf, start)
    component = regions.components(places.labels, mrf.edges)
    places.regions, state.next_region_id = regions.track(component, places.regions, state.next_region_id)
    state.dirty = False
    view = _view(state, mrf, cfg)
    complete = switched or state.published is None
    state.published, delta = publication.difference(state.published, view, complete, cfg.posterior_change)
    if delta is not None:
        yield delta


def _view(state: State, mrf: swap.Field, cfg: Config) -> publication.View:
    """Everything a follower is to know, as it stands now."""
    assert state.alignment is not None
    assert state.task is not None
    places, labels = state.places, state.alignment.labels
    costs = swap.conditional_costs(mrf, places.labels)
    posteriors = np.exp(costs.min(axis=1, keepdims=True) - costs)
    posteriors /= posteriors.sum(axis=1, keepdims=True)
    return publication.View(
        robot=state.robot,
        epoch=state.epoch,
        revision=-1 if state.published is None else state.published.revision,
        stamp_ns=state.stamp_ns,
        prior_digest=state.alignment.digest,
        environment=state.alignment.prior.environment,
        task=state.alignment.prior.task,
        space=cfg.space if len(state.archive) else "",
        labels=labels,
        regions=_regions(state, posteriors, cfg),
        place_ids=state.graph.ids,
        place_regions=places.regions,
        posteriors=posteriors.astype(np.float16),
        unknown=(1.0 - places.known).astype(np.float16),
        energy=swap.energy(mrf, places.labels),
    )


def _regions(state: State, posteriors: np.ndarray, cfg: Config) -> dict[int, Region]:
    """One Region per id; figures are rounded, so that a region is sent again only when they visibly change."""
    assert state.alignment is not None
    graph, places, names = state.graph, state.places, state.alignment.labels
    order = np.argsort(places.regions, kind="stable")
    ids, starts = np.unique(places.regions[order], return_index=True)
    found = {}
    for region_id, rows in zip(ids.tolist(), np.split(order, starts[1:]), strict=False):
        label = int(places.labels[rows[0]])
        x, y, z = graph.positions_m[rows].mean(axis=0).tolist()
        found[region_id] = Region(
            id=region_id,
            label=names[label],
            place_count=len(rows),
            probability=round(float(posteriors[rows, label].mean()), 2),
            position_m=(round(x, 2), round(y, 2), round(z, 2)),
            area_m2=round(regions.footprint_m2(graph.positions_m[rows], graph.radii_m[rows], cfg.footprint_cell_m), 2),
        )
    return found


def snapshot(state: State) -> RegionDelta:
    """Everything published so far, as one delta."""
    if state.published is None:
        return publication.nothing(state.robot, state.epoch)
    return publication.complete(state.published)


def explain(state: State, request: PosteriorRequest, cfg: Config) -> PosteriorReply:
    """Each expert's vote on one place, as it was when the labels were last found."""
    row = int(state.graph.rows(np.array([request.place_id]))[0])
    if row < 0 or state.alignment is None or state.places.labels[row] == UNLABELLED:
        return PosteriorReply(robot=state.robot, place_id=request.place_id, found=False)
    answers = votes(state, np.array([row]), cfg)
    costs = swap.conditional_costs(field_of(state, cfg), state.places.labels)[row]
    posterior = np.exp(costs.min() - costs)
    slot = state.evidence.slots[request.place_id]
    return PosteriorReply(
        robot=state.robot,
        place_id=request.place_id,
        found=True,
        label=state.alignment.labels[state.places.labels[row]],
        labels=state.alignment.labels,
        posterior=(posterior / posterior.sum()).tolist(),
        unary=sum(-cfg.experts[name] * sure[0] * log[0] for name, (log, sure) in answers.items()).tolist(),
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
    if state.asked_text is None:
        state.asked_text = TextRequest(space=cfg.space, concepts=concepts)
        yield state.asked_text


def _reintegrate(state: State, rows: np.ndarray, cfg: Config) -> None:
    """Compute the evidence of some places afresh from all stored frames."""
    if not len(rows):
        return
    state.evidence.add(state.graph.ids[rows].tolist())
    targets = _targets(state, rows)
    descriptors.integrate_all(state.evidence, state.archive, targets, state.query_radius_m, cfg.kernel)
    state.places.stale[rows] = True


def _targets(state: State, rows: np.ndarray) -> descriptors.Targets:
    graph = state.graph
    slots = state.evidence.of(graph.ids[rows].tolist())
    return descriptors.Targets(slots, graph.positions_m[rows])


def _concept_key(concepts: list[list[str]]) -> tuple[str, ...]:
    return tuple("\n".join(phrases) for phrases in concepts)
