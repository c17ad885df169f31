"""Follows the maps of several robots, finds out how they lie to each other, and writes one map of all under a name of
its own: places, regions and objects, so that store, page and questions know it as they know any robot's.

It is a service like the six, but no part of them: `prior-sg fleet` runs it beside the others.
"""

import logging
from collections.abc import Awaitable, Callable, Iterator

from prior_sg.deploy.fleet.core import update
from prior_sg.deploy.fleet.core.members import Followed, Member
from prior_sg.deploy.fleet.core.telling import Teller
from prior_sg.deploy.fleet.core.update import Config, KeepNumbers, Lacking, NumbersKept, State
from prior_sg.deploy.fleet.keeping import keep, kept_memory, stored_members
from prior_sg.schemas.codec import Message
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.priors import PriorRequest
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.status import Loss
from prior_sg.schemas.topics import (
    OBJECT_DELTA,
    OBJECT_SNAPSHOT,
    PLACE_DELTA,
    PLACE_SNAPSHOT,
    PRIORS,
    REGION_DELTA,
    REGION_SNAPSHOT,
    SCENE,
    topic_of,
)
from prior_sg.services.errors import reason_of
from prior_sg.services.runtime.service import Ask, Errand, Identity, Output, Service, ServiceError
from prior_sg.services.scene_store.core import graph as scenes

log = logging.getLogger(__name__)
NAME_OF_A_ROBOT = "{} is one of the robots: give the merged map another name"
SNAPSHOTS = {"PlaceDelta": PLACE_SNAPSHOT, "RegionDelta": REGION_SNAPSHOT, "ObjectDelta": OBJECT_SNAPSHOT}


def init(cfg: Config, identity: Identity) -> State:
    """Nothing has come yet but what is stored. Raises ServiceError."""
    if identity.robot in cfg.robots:
        raise ServiceError(NAME_OF_A_ROBOT.format(identity.robot))
    memory = kept_memory(cfg.memory)
    former = stored_members(cfg.stored, memory.sessions)
    followed = {
        robot: Followed(Member(memory.sessions.following(robot), scenes.Graph(robot)), sessions=memory.sessions)
        for robot in cfg.robots
    }
    return State(
        identity.robot, followed, Teller(identity.robot, identity.epoch, cfg.robots), former=former, memory=memory
    )


def step(state: State, message: Message, cfg: Config) -> Iterator[Output]:
    """One input; deltas go to their topics, gaps are asked for, numbers are kept."""
    for output in update.update(state, message, cfg):
        match output:
            case Lacking():
                yield Ask(SNAPSHOTS[output.kind], SnapshotRequest(robot=output.robot))
            case SceneRequest():
                yield Ask(SCENE, output)
            case PriorRequest():
                yield Ask(PRIORS, output)
            case KeepNumbers():
                yield Ask(KEEP_NUMBERS, output)
            case _:
                topic = topic_of(type(output))
                assert topic is not None
                if isinstance(output, PlaceDelta) and output.event:
                    log.warning(output.event)
                yield topic, output


def _keeper(cfg: Config, identity: Identity) -> Callable[[KeepNumbers], Awaitable[Message]]:
    told = ""  # why the numbers are not on disk; said once, not with each of them

    async def keeps(request: KeepNumbers) -> NumbersKept:
        nonlocal told
        try:
            keep(cfg.memory, request.content)
            told = ""
        except OSError as error:
            if told != (told := reason_of(error)):
                log.warning(
                    f"{cfg.memory} cannot be written ({told}): the map goes on, and after a restart its numbers since "
                    "then are given anew; the next new one that can be written keeps them all"
                )
        return NumbersKept(robot=request.robot)

    return keeps


def _places(state: State, request: SnapshotRequest, cfg: Config) -> PlaceDelta:
    return state.teller.places_snapshot()


def _regions(state: State, request: SnapshotRequest, cfg: Config) -> RegionDelta:
    return state.teller.regions_snapshot()


def _objects(state: State, request: SnapshotRequest, cfg: Config) -> ObjectDelta:
    return state.teller.objects_snapshot()


def _losses(state: State) -> list[Loss]:
    return state.losses.told


def _figures(state: State) -> dict[str, float]:
    members = state.members()
    return {"maps": len(members), "maps_related": sum(one.relation is not None for one in members)}


KEEP_NUMBERS: Errand[Config] = Errand("KEEP_NUMBERS", KeepNumbers, NumbersKept, _keeper)

SERVICE = Service(
    "fleet",
    purpose=__doc__ or "",
    scope="robot",
    config=Config,
    init=init,
    step=step,
    reads=(PLACE_DELTA, REGION_DELTA, OBJECT_DELTA),
    reads_of=lambda cfg: cfg.robots,
    writes=(PLACE_DELTA, REGION_DELTA, OBJECT_DELTA),
    asks=(PLACE_SNAPSHOT, REGION_SNAPSHOT, OBJECT_SNAPSHOT, PRIORS, SCENE),
    errands=(KEEP_NUMBERS,),
    answers={PLACE_SNAPSHOT: _places, REGION_SNAPSHOT: _regions, OBJECT_SNAPSHOT: _objects},
    tick_s=1.0,
    losses=_losses,
    figures=_figures,
)
