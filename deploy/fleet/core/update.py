"""What each input of the bridge changes, and what follows from it (pure).

Deltas of robots only mark their map; once a second, at a tick, maps that are not related yet are matched, relations are
fitted again to what has been seen since, and what has changed of the merged scene is told.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from prior_sg.deploy.fleet.core.doubting import fault_of_delta
from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.frames import apart, level
from prior_sg.deploy.fleet.core.finding.matching import again, map_of, match
from prior_sg.deploy.fleet.core.foreseeing import foreseen
from prior_sg.deploy.fleet.core.ids import Name
from prior_sg.deploy.fleet.core.levels import names_levels
from prior_sg.deploy.fleet.core.members import Delta, Followed, Member, Relation
from prior_sg.deploy.fleet.core.merging import Memory, Merged, Source, levelled, merged
from prior_sg.deploy.fleet.core.sessions import Change, Present, remembered, said
from prior_sg.deploy.fleet.core.telling import Teller
from prior_sg.schemas.codec import Message, copied
from prior_sg.schemas.levels import LevelName
from prior_sg.schemas.markers import MarkerKey
from prior_sg.schemas.members import MOST_MERGED
from prior_sg.schemas.names import fault_of_robot
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior, PriorList, PriorRequest
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.status import Tick
from prior_sg.services.losses import Losses
from prior_sg.services.refusals import InputRefused
from prior_sg.services.scene_store.core import graph as scenes
from prior_sg.services.scene_store.core import telling

GROWN = 1.1  # times as many places as when it was looked at last: a map is looked at again
REST_TICKS = 5  # from one fitting of a relation to the next, of a map that changes and hardly grows
MOST_FORMER = 16  # maps of a robot's former sessions that are merged, besides those stored and what holds the frame
ASK_TICKS = 30  # from one question for a prior that nobody knew to the next


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Whose maps become one, and how."""

    robots: tuple[str, ...] = ()
    transforms: dict[str, tuple[float, float, float, float]] = {}  # of robots whose frame is given: x, y, z, yaw in rad
    stored: tuple[str, ...] = ()  # scenes of former sessions, each as ROBOT=PATH
    memory: str = ""  # file that keeps the fleet's numbers; empty = they begin anew with every start
    min_change_m: float = 0.01  # smaller changes of places, edges and objects are not told
    posterior_change: float = 0.02  # nor are smaller ones of a belief
    match: MatchConfig = MatchConfig()

    def __post_init__(self) -> None:
        if len(self.robots) > MOST_MERGED:
            raise ValueError(f"{len(self.robots)} robots are named: at most {MOST_MERGED} are merged")
        for robot in (*self.robots, *self.transforms):
            if fault := fault_of_robot(robot):
                raise ValueError(fault)
        if twice := sorted(robot for robot in {*self.robots} if self.robots.count(robot) > 1):
            raise ValueError(f"{twice[0]} is named twice: name each robot once")
        if unknown := sorted(self.transforms.keys() - {*self.robots}):
            raise ValueError(f"a transform is given for {unknown[0]}, whose map is not to be merged: name it, too")


@dataclass
class State:
    """What the bridge of one fleet knows."""

    robot: str  # the fleet's own name
    followed: dict[str, Followed]
    teller: Teller
    former: list[Member] = field(default_factory=list)
    memory: Memory = field(default_factory=Memory)
    merged: Merged | None = None
    events: list[str] = field(default_factory=list)  # to be told with the next delta
    noted: set[tuple[Name, int]] = field(default_factory=set)  # objects of former sessions whose change was told
    ticks: int = 0
    wanted: str = ""  # digest of the prior whose levels the merged map has, and by which it foresees; empty = none
    prior: tuple[str, Prior] | None = None  # the last that was wanted and came, with its digest
    asked_tick: int = 0  # when one was asked for
    kept_ids: int = 0  # numbers that are kept on disk
    losses: Losses = field(default_factory=Losses)

    @property
    def in_force(self) -> Prior | None:
        """The prior that the merged map follows, once it is there."""
        return self.prior[1] if self.prior is not None and self.prior[0] == self.wanted else None

    def members(self) -> list[Member]:
        """All, the present ones first; among them the order of the command."""
        return [*(one.member for one in self.followed.values()), *reversed(self.former)]


def update(state: State, message: Message, cfg: Config) -> Iterator[Message]:
    """Take one input; yields deltas, and what is missing as the robot and the kind of delta."""
    match_for = {PlaceDelta, RegionDelta, ObjectDelta}
    if type(message) in match_for and message.robot in state.followed:  # type: ignore[attr-defined]
        yield from _follow(state, message, cfg)  # type: ignore[arg-type]
    elif isinstance(message, PriorList):
        for prior in message.priors:
            if prior.digest() == state.wanted:
                state.prior = state.wanted, copied(prior)
    elif isinstance(message, Scene):
        if message.robot == state.robot and not len(message.place_ids) and state.teller.place_revision < 0:
            yield state.teller.greeting()
    elif isinstance(message, Tick):
        yield from _tick(state, cfg)


class Lacking(Message, frozen=True, kw_only=True):
    """A stream has a gap: its writer is to be asked for all of it."""

    robot: str
    kind: str  # name of the delta's type


class Numbers(msgspec.Struct, frozen=True, kw_only=True):
    """The fleet's numbers as they are kept."""

    given: list[tuple[str, str, int, int, int]]  # kind, robot, session, the robot's number, the fleet's
    region_of: list[tuple[int, int]]  # place, region
    next_region: int
    frames: list[tuple[str, int, int, list[float]]] = []  # robot, session, epoch of its places, fleet_from_own by rows
    sessions: list[tuple[str, int, list[int], list[tuple[int, float, float, float]]]] = []  # robot, session, epochs of
    # its writers, and by what it is known again: places and where they are
    node_of: list[tuple[LevelName, int, int]] = []  # level, region, node
    next_nodes: list[tuple[LevelName, int]] = []


class KeepNumbers(Message, frozen=True, kw_only=True):
    """New numbers have been given out: keep all of them."""

    robot: str
    content: bytes  # Numbers as MessagePack


class NumbersKept(Message, frozen=True, kw_only=True):
    """They are."""

    robot: str


def _follow(state: State, delta: Delta, cfg: Config) -> Iterator[Message]:
    if fault := fault_of_delta(delta):
        raise InputRefused(fault)
    followed = state.followed[delta.robot]
    ended = followed.take(delta)
    if ended is not None:
        state.former.append(ended)
        state.events.append(f"{delta.robot} has begun a new session")
        _forget(state, delta.robot, len(cfg.stored))
    if followed.lacking(delta):
        yield Lacking(robot=delta.robot, kind=type(delta).__name__)


def _forget(state: State, robot: str, stored: int) -> None:
    """Leave out the smallest of a robot's former maps where there are too many: each is merged again at every change.
    The first `stored` of all were given by whoever started the bridge."""
    left = [one for one in state.former[stored:] if one.name.robot == robot]
    left = [one for one in left if one.relation is None or not one.relation.given]
    if len(left) > MOST_FORMER:
        least = min(left, key=lambda one: len(one.graph.places))
        state.former = [one for one in state.former if one is not least]
        places = f"{len(least.graph.places)} places"
        state.events.append(f"session {least.name.session} of {robot} is forgotten, the smallest of many: {places}")


def _tick(state: State, cfg: Config) -> Iterator[Message]:
    members = state.members()
    state.ticks += 1
    if state.ticks == 1:  # what the store has of a former start stays until there is something to put in its place
        yield SceneRequest(robot=state.robot)
    yield from _aim(state, members)
    aimed = state.in_force is not state.memory.levels.prior
    if not (aimed or any(one.changed or one.to_fit for one in members)):
        return
    relate(state, cfg)
    related = [one for one in members if one.relation is not None and one.graph.places]
    if not related:
        return
    found, changes = merged_of(state.robot, related, state.memory)
    state.merged = _seen_beyond(state, levelled(found, state.memory, state.in_force), related)
    for name, change in changes:
        if (name, change.number) not in state.noted:
            state.noted.add((name, change.number))
            state.events.append(said(change, state.merged.scene))
    for one in members:
        one.changed = False
    events, state.events = state.events, []
    moved, count = _note_frames(state.memory, related), _given_out(state.memory)
    if cfg.memory and (moved or count != state.kept_ids):
        state.kept_ids = count
        _remember(state.memory, members)
        yield KeepNumbers(robot=state.robot, content=_numbers(state.memory))
    tolerances = cfg.min_change_m, cfg.posterior_change
    yield from state.teller.tell(state.merged, "; ".join(events), *tolerances)


def _seen_beyond(state: State, found: Merged, related: list[Member]) -> Merged:
    """The same with what lies beyond its openings, of the priors that present robots follow."""
    digests = [one.graph.alignment.prior_digest for one in related if not one.former]
    scene = found.scene
    beyond = foreseen(scene, state.in_force, filter(None, digests))
    return replace(found, scene=msgspec.structs.replace(scene, foresight=beyond))


def _aim(state: State, members: list[Member]) -> Iterator[PriorRequest]:
    """Follow the prior of the first map that has levels by name, else of the first that has one, maps of present robots
    before former ones: by theirs is foreseen. Ask for it once, and later where nobody knew it."""
    related = [one for one in members if one.relation is not None and one.graph.alignment.prior_digest]
    related.sort(key=lambda one: (one.former, not names_levels([*one.graph.nodes.values()])))
    wanted = next((one.graph.alignment.prior_digest for one in related), "")
    fresh, state.wanted = wanted != state.wanted, wanted
    if wanted and state.in_force is None and (fresh or state.ticks >= state.asked_tick + ASK_TICKS):
        state.asked_tick = state.ticks
        yield PriorRequest(digest=wanted)


def _remember(memory: Memory, members: list[Member]) -> None:
    """By what each session is known again."""
    for one in members:
        spots_m = {number: place.position_m for number, place in one.graph.places.items()}
        if spots_m:
            memory.sessions.remember(one.name, spots_m)


def _given_out(memory: Memory) -> int:
    """How many numbers there are."""
    return sum(memory.ids.following.values()) + memory.next_region + sum(memory.levels.map.next_ids.values())


def _numbers(memory: Memory) -> bytes:
    given: list[tuple[str, str, int, int, int]] = [
        (kind, name.robot, name.session, number, fleet)
        for kind, known in memory.ids.given.items()
        for (name, number), fleet in known.items()
    ]
    frames = [(*name, epoch, pose.ravel().tolist()) for (name, epoch), pose in memory.frames.items()]
    sessions = [
        (*name, sorted(one.epochs), [(place, *spot_m) for place, spot_m in one.spots_m.items()])
        for name, one in memory.sessions.known.items()
    ]
    levels = memory.levels
    return msgspec.msgpack.encode(
        Numbers(
            given=given,
            region_of=sorted(memory.region_of.items()),
            next_region=memory.next_region,
            frames=frames,
            sessions=sessions,
            node_of=[(level, *pair) for level, held in levels.node_of.items() for pair in sorted(held.items())],
            next_nodes=list(levels.map.next_ids.items()),
        )
    )


def _note_frames(memory: Memory, related: list[Member]) -> bool:
    """Remember how the maps lie; whether any lies otherwise than remembered."""
    now = {one.written: one.relation.fleet_from_own for one in related if one.relation is not None}
    moved = any(key not in memory.frames or not np.array_equal(pose, memory.frames[key]) for key, pose in now.items())
    memory.frames |= now
    return moved


def merged_of(robot: str, members: list[Member], memory: Memory) -> tuple[Merged, list[tuple[Name, Change]]]:
    """The merged scene of related members; those of former sessions tell only what no present one sees otherwise."""
    present, sources, changes = [], [], []
    for one in members:
        assert one.relation is not None
        scene, pose = one.map().scene, one.relation.fleet_from_own
        if not one.former:
            present.append(Present(scene, pose))
        else:
            scene, found = remembered(scene, pose, present)
            changes += [(one.name, change) for change in found]
        frame_ids = None if one.former and not one.graph.sightings else one.frame_ids()
        sources.append(Source(one.name, scene, pose, frame_ids))
    return merged(robot, sources, memory), changes


def relate(state: State, cfg: Config) -> None:
    """Find out how maps lie in the fleet's frame, and fit what is known to what has been seen since."""
    members = [one for one in state.members() if len(one.graph.places) >= cfg.match.least_places]
    _given(members, cfg.transforms)
    _as_before(state, members)
    if members and not any(one.relation for one in state.members()):
        first = next((one for one in members if one.former), members[0])
        first.relation, first.why = Relation(np.eye(4), given=True, places=len(first.graph.places)), ""
        state.events.append(f"the frame of {first.name.robot} is that of {state.robot}")
    for one in members:
        grown = len(one.graph.places) >= GROWN * one.tried_places
        if one.relation is None and (grown or _shared(one, members) != one.tried_markers):
            _seek(state, one, members, cfg)
        elif one.to_fit and _due(state, one):
            _correct(state, one, members, cfg)


def _given(members: list[Member], transforms: Mapping[str, tuple[float, float, float, float]]) -> None:
    for one in members:
        if one.relation is None and not one.former and one.name.robot in transforms:
            x, y, z, yaw = transforms[one.name.robot]
            one.relation, one.why = Relation(level(yaw, np.array((x, y, z))), given=True), ""


def _as_before(state: State, members: list[Member]) -> None:
    """Maps whose writer goes on lie as they did when the fleet was followed last; the first of them holds the frame."""
    found = []
    for one in members:
        pose = state.memory.frames.get(one.written)
        if one.relation is None and not one.tried_places and pose is not None:
            one.relation, one.why = Relation(pose, given=False, places=len(one.graph.places), tick=state.ticks), ""
            found.append(one)
    if found and not any(one.relation is not None and one.relation.given for one in members):
        holder = next((one for one in found if one.former), found[0])
        holder.relation = Relation(state.memory.frames[holder.written], given=True, places=len(holder.graph.places))


def _due(state: State, one: Member) -> bool:
    """Fitting looks at whole maps: it is done when one has grown by a share, else every few ticks."""
    assert one.relation is not None
    grown = len(one.graph.places) >= GROWN * one.relation.places
    return grown or state.ticks >= one.relation.tick + REST_TICKS


def _others(state: State, one: Member, members: list[Member]) -> Scene | None:
    """What all related members but one know together, in numbers that nobody keeps."""
    others = [other for other in members if other is not one and other.relation is not None]
    return merged_of(state.robot, others, Memory())[0].scene if others else None


def _shared(one: Member, members: list[Member]) -> frozenset[MarkerKey]:
    """The markers of a map that related ones are sure of, too."""
    related = [other for other in members if other is not one and other.relation is not None]
    return frozenset(one.sure_markers() & {key for other in related for key in other.sure_markers()})


def _seek(state: State, one: Member, members: list[Member], cfg: Config) -> None:
    """Match an unrelated map with all that are related."""
    others = _others(state, one, members)
    one.tried_places, one.tried_markers = len(one.graph.places), _shared(one, members)
    if others is None:
        return
    found = match(one.map(), map_of(others), cfg.match)
    if found.by_markers and found.why and found.why != one.why:
        state.events.append(f"{one.name.robot} is not merged: {found.why}")
    one.why = found.why
    if found.b_from_a is not None:
        one.relation = Relation(found.b_from_a, given=False, places=len(one.graph.places), tick=state.ticks)
        one.touch()
        one.unfitted = False
        way = " by markers" if found.by_markers else ""
        state.events.append(f"{one.name.robot} has been found in the map of {state.robot}{way}")


def _correct(state: State, one: Member, members: list[Member], cfg: Config) -> None:
    """Fit a relation again. Where the maps have come to contradict each other, seek it anew, else give it up."""
    assert one.relation is not None
    others = _others(state, one, members)
    if others is None:
        return
    found = again(one.relation.fleet_from_own, one.map(), map_of(others), cfg.match)
    pose = found.b_from_a
    if pose is not None:
        gap_m, gap_rad = apart(pose, one.relation.fleet_from_own, one.map().shape.centers_m.mean(axis=0))
        moves = gap_m > cfg.min_change_m or gap_rad > cfg.min_change_m
        kept = pose if moves else one.relation.fleet_from_own
        one.relation = Relation(kept, given=False, places=len(one.graph.places), tick=state.ticks)
        one.unfitted = False
        one.changed |= moves
        return
    one.relation, one.why = None, found.why
    state.memory.frames.pop(one.written, None)
    _seek(state, one, members, cfg)
    if one.relation is None:
        state.events.append(f"{one.name.robot} fits no longer: {found.why}")
        one.touch()


def scene_of(state: State) -> Scene:
    """The merged scene as last made; empty before."""
    return telling.scene(scenes.Graph(state.robot)) if state.merged is None else state.merged.scene
