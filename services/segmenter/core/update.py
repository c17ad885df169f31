"""Segmentation: places in, regions out (paper, Global Inference via Graph Cuts; pure).

One input at a time: `update` takes a message, changes the state and yields what is to be sent: the delta of regions and
beliefs, that of objects, and requests for what is missing (a place snapshot, text embeddings, a prior).
"""

from collections.abc import Iterator

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.objects import Detections, ObjectDelta
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.priors import Prior, PriorEvidence, PriorList, Task, TaskInForce
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.status import Tick
from prior_sg.schemas.succession import Evidence, EvidenceRequest, Succession, TakesOver
from prior_sg.services.segmenter.core import inference, prior_evidence, report, resting
from prior_sg.services.segmenter.core.aim import object_concepts, region_concepts
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.evidence import handover
from prior_sg.services.segmenter.core.evidence.kernel import Targets
from prior_sg.services.segmenter.core.experts.contents import has_say
from prior_sg.services.segmenter.core.objects.names import named
from prior_sg.services.segmenter.core.slices import at_once
from prior_sg.services.segmenter.core.state import State
from prior_sg.services.segmenter.core.succession import SAME_MAP


def update(state: State, message: Message, cfg: Config) -> Iterator[Message]:
    """Take one input. Yields RegionDelta or ObjectDelta when something changed, and requests for what is missing."""
    idle = isinstance(message, Tick)
    yield from take(state, message, cfg)
    switched = align(state, cfg)
    yield from _requests(state, cfg)
    if state.catching_up.silent:
        yield from _catch_up(state, idle or switched, cfg)
        return
    if switched or idle:
        yield from follow_objects(state, cfg)
        yield from follow_markers(state, cfg)
    news = isinstance(message, Pyramid) and state.labelling.under_way is None
    if switched or (state.labelling.dirty and (news or idle)):
        yield from _segment(state, switched, idle, cfg)
    if idle and state.report.due(state.labelling.settled, cfg.evidence_ticks):
        yield from _observed(state, cfg)


def take(state: State, message: Message, cfg: Config) -> Iterator[Message]:
    """Let one input change what is known; a tick also asks for what embedding spaces need to take over."""
    match message:
        case PlaceDelta():
            follow_places(state, message, cfg)
        case Pyramid():
            observe(state, message, cfg)
        case Detections():
            detect(state, message, cfg)
        case PoseUpdate():
            correct_poses(state, message, cfg)
        case Task() | TaskInForce() | Prior() | PriorList():
            state.aim.hear(message)
        case TextEmbeddings():
            state.aim.take_text(message, cfg)
        case Tick():
            state.labelling.still_ticks += 1
            state.aim.tick()
            handover.tick(state.seen.spaces)
            if not state.catching_up.stands_by:
                seen = state.seen
                yield from handover.questions(seen.spaces, seen.archive, state.robot, state.epoch, cfg.spaces)
            yield from follow_spaces(state, cfg)
        case Evidence():
            yield from take_evidence(state, message, cfg)
        case Succession() | TakesOver() | RegionDelta() | ObjectDelta() | Scene():
            hear_former(state, message)


def follow_places(state: State, delta: PlaceDelta, cfg: Config) -> None:
    """Apply what the follower lets through; new and moved places are integrated over all stored frames."""
    for ready in state.map.take(delta):
        change = state.map.advance(ready, cfg)
        touched = bool(change.step.touched.any())
        state.seen.evidence.remove(change.gone_ids.tolist())
        state.regions.follow(change, state.map)
        state.labelling.map_changed(len(change.gone_ids), touched)
        if touched:
            state.objects.floor_changed()
        _integrate_afresh(state, np.flatnonzero(change.step.moved), cfg)
        state.heard(ready.stamp_ns)


def observe(state: State, pyramid: Pyramid, cfg: Config) -> None:
    """Integrate one frame into the places it sees; a repeated frame is ignored, one of another space kept apart."""
    if state.catching_up.silent and state.seen.holds(pyramid):
        return  # from a cache, and from the predecessor
    pose = state.corrections.pose(pyramid.frame_id, pyramid.world_from_camera)
    pyramid = msgspec.structs.replace(pyramid, world_from_camera=pose)
    rows = state.seen.observe(pyramid, _targets(state), cfg)
    if rows is not None:
        state.map.places.stale[rows] = True
        state.labelling.news()
        state.heard(pyramid.stamp_ns)


def detect(state: State, detections: Detections, cfg: Config) -> None:
    """Associate one frame's detections; those of a space that is not in force wait for it, if it may take over. Of
    markers all tell the same, whatever the space."""
    pose = state.corrections.pose(detections.frame_id, detections.world_from_camera)
    state.markers.observe(detections, pose, cfg.markers)
    if state.catching_up.silent and state.objects.holds(detections):
        return
    of = f"keyframe {detections.frame_id}, {detections.space}"
    if detections.space != state.seen.spaces.force and not cfg.spaces.follow:
        state.seen.losses.add("detections ignored", "their space is not in force", of=of)
        return
    if state.objects.observe(msgspec.structs.replace(detections, world_from_camera=pose), cfg.tracking):
        state.labelling.news()
        state.heard(detections.stamp_ns)
    else:
        state.seen.losses.add("detections ignored", "they repeat some, or do not fit those before", of=of)


def correct_poses(state: State, update: PoseUpdate, cfg: Config) -> None:
    """Re-anchor frames, and integrate afresh the places that they saw from the old pose or see from the new one.

    A frame may be corrected before its pyramid arrives. A repeated update changes nothing.
    """
    poses = state.corrections.take(update)
    if poses is None:
        return
    state.objects.move(poses)
    state.markers.move(poses)
    affected = np.flatnonzero(state.seen.move(poses, state.map.graph.positions_m, cfg))
    if len(affected):
        _integrate_afresh(state, affected, cfg)
    state.labelling.news()


def follow_spaces(state: State, cfg: Config) -> Iterator[TextRequest]:
    """Put another embedding space in force when it covers the map; labels stay until they are found anew.

    Its concepts are asked for first, if a prior is in force.
    """
    name, text = handover.successor(state.seen.spaces, state.seen.archive, cfg.spaces), None
    if name is None:
        return
    if state.aim.in_force is not None:
        concepts = region_concepts(state.aim.in_force.prior, cfg.object_phrases)
        text = state.aim.text_of(name, concepts)
        if text is None:
            yield from state.aim.ask_text(name, concepts)
            return
    if state.seen.succeed(name, _targets(state), cfg):
        state.aim.translate(text)
        state.map.places.stale[:] = True
        state.map.places.correction[:] = 0.0
        state.labelling.forget_appearance()


def align(state: State, cfg: Config) -> bool:
    """Put the wanted prior in force once its text embeddings are there; True when it has just happened."""
    former = state.aim.in_force
    now = state.aim.switch(state.seen.spaces.force, cfg)
    if now is None:
        return False
    if now.query_radius_m != state.seen.query_radius_m:
        state.seen.query_radius_m = now.query_radius_m
        _integrate_afresh(state, np.arange(len(state.map.graph.ids)), cfg)
    state.map.relabel(len(now.labels))
    state.labelling.start_afresh(
        len(now.labels), len(state.map.graph.ids), "contents" in cfg.experts and has_say(now.prior)
    )
    state.objects.start_afresh(now.prior, switched=former is not None)
    return True


def follow_objects(state: State, cfg: Config) -> Iterator[ObjectDelta]:
    """Tell what became of the objects, and let the experts see it. Names wait for the text of the prior's objects."""
    objects, aim, space = state.objects, state.aim.in_force, state.seen.spaces.force
    if not objects.renew(space, state.seen.rests, cfg.tracking):
        return
    prior, digest = (None, "") if aim is None else (aim.prior, aim.digest)
    text = None if prior is None else state.aim.text_of(space, object_concepts(prior))
    unnameable = text is None and prior is not None and prior.objects and objects.tracks.items
    if not objects.tracks.changed or unnameable:
        return
    now = named(objects.tracks, prior, text, cfg.tracking, graph=state.map.graph, size_cfg=cfg.sizes)
    delta = objects.tell(state.robot, state.epoch, state.stamp_ns, now=now, digest=digest)
    if delta is not None:
        if prior is not None and objects.present is not None:
            inference.see_objects(state, objects.present, cfg)
        yield delta


def follow_markers(state: State, cfg: Config) -> Iterator[ObjectDelta]:
    """Tell which markers stand where; they wait for no prior."""
    ledger = state.objects.ledger
    delta = ledger.tell_markers(
        state.robot, state.epoch, state.stamp_ns, state.markers.news(ledger.markers, cfg.markers)
    )
    if delta is not None:
        yield delta


def take_evidence(state: State, evidence: Evidence, cfg: Config) -> Iterator[EvidenceRequest]:
    """What the predecessor has seen, page by page."""
    if evidence.space and not len(state.seen.archive):
        state.seen.spaces.force = evidence.space
    for pyramid in evidence.pyramids:
        observe(state, pyramid, cfg)
    for detections in evidence.detections:
        detect(state, detections, cfg)
    if evidence.pyramids or evidence.detections:
        yield EvidenceRequest(robot=state.robot, after_frame_id=evidence.last_frame_id)
    elif state.catching_up.silent:
        state.catching_up.waits.discard("evidence")
        state.objects.sort()


def hear_former(state: State, message: Succession | TakesOver | RegionDelta | ObjectDelta | Scene) -> None:
    """Others have gone before this process; what readers know of them, and when it is this one's turn."""
    match message:
        case Succession():
            state.catching_up.begin(message.predecessor)
            state.map.asked_snapshot = True
        case TakesOver():
            state.catching_up.take_over(message.bequest)
        case _:
            state.catching_up.hear(message)


def _catch_up(state: State, thoroughly: bool, cfg: Config) -> Iterator[RegionDelta | ObjectDelta]:
    """Follow everything and tell nothing, until what readers know can be told again, under the same names."""
    if thoroughly:
        for _ in follow_objects(state, cfg):
            pass  # so that the experts see them
        state.catching_up.tick(_seen_again(state)[1])
    if state.aim.in_force is not None and (thoroughly or state.catching_up.stands_by):
        inference.evaluate_experts(state, thoroughly, cfg)
        inference.settle(state, cfg, hurried=not thoroughly)
    waits = state.catching_up
    if waits.stands_by or (state.map.follower.epoch < 0 and waits.legacy is not None and len(waits.legacy.place_ids)):
        return
    if not lacking(state, cfg) or waits.still_ticks >= cfg.catch_up_ticks:
        yield from _tell_all(state, cfg)


def lacking(state: State, cfg: Config) -> str:
    """What is still missing of what was known before this process, as part of a sentence; empty = nothing."""
    waits, legacy, aim = state.catching_up, state.catching_up.legacy, state.aim
    if legacy is None:
        return ""
    if waits.waits:
        return f"what is known of {' and '.join(sorted(waits.waits))} beside {len(state.seen.archive)} keyframes"
    if len(legacy.place_ids) and state.map.follower.epoch < 0:
        return "the places of the map"
    if legacy.digest and aim.in_force is None:
        return "the prior in force"
    there, again = _seen_again(state)
    if again < cfg.spaces.coverage * there or (waits.gathers and waits.still_ticks < 1):
        return f"evidence of {there - again} places"
    return "the objects" if state.objects.outdated(state.seen.spaces.force) else ""


def _seen_again(state: State) -> tuple[int, int]:
    """How many of the places that were looked at before are in the map, and how many of these have been seen again;
    none where the map is another.
    """
    legacy = state.catching_up.legacy
    if legacy is None:
        return 0, 0
    rows = state.map.graph.rows(legacy.seen_ids)
    rows = rows[rows >= 0]
    if len(rows) < SAME_MAP * len(legacy.seen_ids):
        return 0, 0
    return len(rows), int((state.seen.evidence.frames[state.map.places.slots[rows]] > 0).sum())


def _tell_all(state: State, cfg: Config) -> Iterator[RegionDelta | ObjectDelta]:
    """Take over the former ids, and tell everything."""
    legacy, state.catching_up.legacy = state.catching_up.legacy, None
    assert legacy is not None
    state.map.places.regions = legacy.regions_of(state.map.graph.ids)
    state.map.places.unparted[:] = True
    state.regions.inherit(legacy.regions, legacy.next_region_id)
    state.layers.inherit(legacy.nodes, legacy.next_node_ids)
    state.objects.inherit(legacy.objects, legacy.next_object_id, cfg.tracking)
    yield from follow_objects(state, cfg)
    yield from _segment(state, switched=False, idle=False, cfg=cfg)


def _segment(state: State, switched: bool, idle: bool, cfg: Config) -> Iterator[RegionDelta]:
    """Experts, graph cuts, beliefs, connected components; then the difference to what was published."""
    if state.aim.in_force is None:
        return
    thoroughly = idle or switched
    anew = thoroughly and state.labelling.still(len(state.map.graph.ids))
    if anew and switched:
        at_once(inference.label_anew(state, cfg))
    elif anew:
        if not resting.go_on(state, cfg):
            return
    else:
        inference.evaluate_experts(state, thoroughly, cfg)
        inference.settle(state, cfg, hurried=not thoroughly)
    changes = state.regions.partition(state.map, state.aim.in_force.labels, cfg.layers.storeys)
    inference.believe(state, cfg)
    delta = report.publish(state, changes, switched or state.regions.ledger.head is None, cfg, idle)
    state.labelling.labelled(anew)
    if delta is not None:
        yield delta


def _observed(state: State, cfg: Config) -> Iterator[PriorEvidence]:
    """What the map shows of its prior, when it is news."""
    news = state.report.news(prior_evidence.evidence(state, cfg))
    if news is not None:
        yield news


def _requests(state: State, cfg: Config) -> Iterator[Message]:
    """Ask for what is missing and not asked for yet; first, for the task that was given before this process began."""
    yield from state.aim.ask_for_task()
    if state.map.ask_for_snapshot():
        yield SnapshotRequest(robot=state.robot)
    yield from state.aim.requests(state.seen.spaces.force, bool(state.objects.tracks.items), cfg)


def _integrate_afresh(state: State, rows: np.ndarray, cfg: Config) -> None:
    """Compute the evidence of some places afresh from all stored frames."""
    if len(rows):
        graph, places = state.map.graph, state.map.places
        places.slots[rows] = state.seen.integrate_afresh(graph.ids[rows], graph.positions_m[rows], cfg)
        places.stale[rows] = True


def _targets(state: State) -> Targets:
    return Targets(state.map.places.slots, state.map.graph.positions_m)
