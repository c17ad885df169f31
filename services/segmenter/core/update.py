"""Segmentation: places in, regions out (paper, Global Inference via Graph Cuts; pure).

One input at a time: `update` takes a message, changes the state and yields what is to be sent: the delta of regions and
beliefs, that of objects, and requests for what is missing (a place snapshot, text embeddings, a prior).
"""

from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, copied, encode
from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.objects import Detections, ObjectDelta
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.priors import Prior, PriorEvidence, PriorList, PriorRequest, Task, TaskInForce, TaskRequest
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.status import Tick
from prior_sg.services.segmenter.core import prior_evidence
from prior_sg.services.segmenter.core.appearance.adaptation import Adaptation
from prior_sg.services.segmenter.core.evidence import handover, kernel
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.inference import (
    RESTING_TICKS,
    Budget,
    believe,
    edge_weights,
    evaluate_experts,
    partition,
    see_objects,
    settle,
    with_neighbours,
)
from prior_sg.services.segmenter.core.map import inclination
from prior_sg.services.segmenter.core.map.received import apply
from prior_sg.services.segmenter.core.objects import names
from prior_sg.services.segmenter.core.objects import tracks as objects
from prior_sg.services.segmenter.core.report import publish
from prior_sg.services.segmenter.core.state import Alignment, Config, State


def update(state: State, message: Message, cfg: Config) -> Iterator[Message]:
    """Take one input. Yields RegionDelta or ObjectDelta when something changed, and requests for what is missing."""
    match message:
        case PlaceDelta():
            follow_places(state, message, cfg)
        case Pyramid():
            observe(state, message, cfg)
        case Detections():
            detect(state, message, cfg)
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
            handover.tick(state.spaces)
            yield from handover.questions(state.spaces, state.archive, state.robot, cfg.spaces)
            yield from follow_spaces(state, cfg)
    switched = align(state, cfg)
    yield from _requests(state, cfg)
    if switched or isinstance(message, Tick):
        yield from follow_objects(state, cfg)
    if switched or (state.dirty and isinstance(message, Pyramid | Tick)):
        yield from _segment(state, switched, isinstance(message, Tick), cfg)
    if isinstance(message, Tick):
        yield from _observed(state, cfg)


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
        state.tracks.changed |= bool(step.touched.any())  # the floor, from which heights of objects count
        state.unadapted += len(step.removed) + bool(step.touched.any())  # at least one: the map is another
        state.evidence.remove(before.ids[step.removed].tolist())
        state.places = state.places.realigned(step)
        state.places.reshaped |= inclination.disturbed(before, step, cfg.geometry.neighbourhood_m)
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
        state.ignored_pyramids += not handover.hear(state.spaces, pyramid, state.archive, cfg.spaces)
        return
    handover.heard_in_force(state.spaces)
    frame = kernel.compact(pyramid)
    if not (state.evidence.fits(frame) and state.archive.add(pyramid.frame_id, frame)):
        state.ignored_pyramids += 1
        return
    targets = kernel.Targets(state.places.slots, state.graph.positions_m)
    seen = kernel.integrate(state.evidence, frame, targets, state.query_radius_m, cfg.kernel)
    state.places.stale[seen] = True
    state.stamp_ns = max(state.stamp_ns, pyramid.stamp_ns)
    state.dirty = True


def detect(state: State, detections: Detections, cfg: Config) -> None:
    """Associate one frame's detections; those of a space that is not in force wait for it, if it may take over."""
    if detections.space != state.spaces.force and not cfg.spaces.follow:
        return
    if detections.frame_id in state.poses:
        pose = state.poses[detections.frame_id]
        detections = msgspec.structs.replace(detections, world_from_camera=pose)
    if objects.observe(state.tracks, detections, cfg.tracking):
        state.stamp_ns = max(state.stamp_ns, detections.stamp_ns)


def follow_objects(state: State, cfg: Config) -> Iterator[ObjectDelta]:
    """Tell what became of the objects, and let the experts see it. Names wait for the text of the prior's objects."""
    tracks, alignment = state.tracks, state.alignment
    if objects.outdated(tracks, state.spaces.force):
        rests = state.spaces.still_ticks >= RESTING_TICKS
        frames = cfg.tracking.renew_frames_at_rest if rests else cfg.tracking.renew_frames
        objects.renew(tracks, state.spaces.force, frames, cfg.tracking)
    if tracks.space != state.spaces.force:
        return
    prior = None if alignment is None else alignment.prior
    text = None if prior is None else state.texts.get(_concept_key(state.spaces.force, object_concepts(prior)))
    if not tracks.changed or (text is None and prior is not None and prior.objects and tracks.items):
        return
    now = names.named(tracks, prior, text, cfg.tracking, graph=state.graph, size_cfg=cfg.sizes)
    digest = "" if alignment is None else alignment.digest
    ledger = state.object_ledger
    delta = ledger.tell(state.robot, state.epoch, state.stamp_ns, now=now, merged=tracks.merged, digest=digest)
    tracks.merged, tracks.changed = [], False
    if delta is not None:
        if alignment is not None:
            see_objects(state, ledger.view(), cfg)
        yield delta


def object_concepts(prior: Prior) -> list[list[str]]:
    """The phrases that describe each of the prior's objects."""
    return [list(item.phrases) for item in prior.objects]


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
        handover.move(state.spaces, frame_id, world_from_camera)
        for frame in state.archive.move(frame_id, world_from_camera) or ():
            affected[kernel.visible(frame, state.graph.positions_m, cfg.kernel)] = True
    objects.move(state.tracks, {frame_id: state.poses[frame_id] for frame_id in poses.frame_ids.tolist()})
    if affected.any():
        _reintegrate(state, np.flatnonzero(affected), cfg)
        state.dirty = True


def follow_spaces(state: State, cfg: Config) -> Iterator[TextRequest]:
    """Put another embedding space in force when it covers the map; labels stay until they are found anew.

    Its concepts are asked for first, if a prior is in force.
    """
    name = handover.successor(state.spaces, state.archive, cfg.spaces)
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
    targets = kernel.Targets(state.places.slots, state.graph.positions_m)
    kernel.integrate_all(evidence, archive, targets, state.query_radius_m, cfg.kernel)
    if not handover.covers(evidence, state.evidence, state.places.slots, cfg.spaces):
        handover.refuse(state.spaces, name)
        return
    state.archive, state.evidence = handover.succeed(state.spaces, name), evidence
    state.adaptation, state.places.stale[:], state.dirty = Adaptation(), True, True
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
        while len(state.texts) > 2 * cfg.remembered_priors:  # regions and objects of each
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
    state.adaptation = Adaptation()
    if len(prior.objects) != state.objects.concepts.shape[1] or former is not None:
        state.objects = ObjectView()  # its columns are the former prior's objects
    state.tracks.changed = True
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
    state.dirty = state.solver.pending > 0 or state.compared > 0 or state.unadapted > 0
    if delta is not None:
        yield delta


def _observed(state: State, cfg: Config) -> Iterator[PriorEvidence]:
    """From time to time, what the map shows of its prior; only what has settled, and only when it is news."""
    state.evidence_waits += 1
    if state.dirty or not cfg.evidence_ticks or state.evidence_waits < cfg.evidence_ticks:
        return
    state.evidence_waits = 0
    seen = prior_evidence.evidence(state, cfg)
    if seen is not None and (state.observed is None or encode(seen) != encode(state.observed)):
        state.observed = seen
        yield seen


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
        concepts = object_concepts(state.alignment.prior)
        missing = _concept_key(state.spaces.force, concepts) not in state.texts
        if concepts and state.tracks.items and missing:
            yield from _text_request(state, state.spaces.force, concepts)
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
    targets = kernel.Targets(state.places.slots[rows], state.graph.positions_m[rows])
    kernel.integrate_all(state.evidence, state.archive, targets, state.query_radius_m, cfg.kernel)
    state.places.stale[rows] = True


def _concept_key(space: str, concepts: list[list[str]]) -> tuple[str, ...]:
    return (space, *("\n".join(phrases) for phrases in concepts))
