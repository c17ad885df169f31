"""Stands in for `place_graph` where Hydra makes the places: reads its scene graph and our keyframes, writes places and
objects, and sends the names of our regions back to its rooms.

It is a service like the six, but no part of them: `prior-sg hydra` runs it beside the others, instead of `place_graph`.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator

from prior_sg.deploy.hydra.core import update
from prior_sg.deploy.hydra.core.graph import GraphLost, HydraGraph
from prior_sg.deploy.hydra.core.update import Config, RoomNames, RoomNamesSent, State
from prior_sg.deploy.hydra.decoder import Decoder, GraphRefused
from prior_sg.deploy.hydra.wire import GraphReceiver, NameSender
from prior_sg.schemas.codec import Message
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.status import Loss
from prior_sg.schemas.topics import (
    KEYFRAME,
    OBJECT_DELTA,
    OBJECT_SNAPSHOT,
    PLACE_DELTA,
    PLACE_SNAPSHOT,
    POSE_UPDATE,
    REGION_DELTA,
    REGION_SNAPSHOT,
    topic_of,
)
from prior_sg.services.runtime.host.port import Port
from prior_sg.services.runtime.service import Ask, Errand, Identity, Output, Service

log = logging.getLogger(__name__)
Sends = Callable[[RoomNames], Awaitable[Message]]


def init(cfg: Config, identity: Identity) -> State:
    """Nothing has come from Hydra yet."""
    return State(identity.robot, identity.epoch, object_epoch=identity.epoch)


def step(state: State, message: Message, cfg: Config) -> Iterator[Output]:
    """One input; deltas go to their topics, names of rooms to Hydra."""
    for output in update.update(state, message, cfg):
        topic = topic_of(type(output))
        if isinstance(output, PlaceDelta) and output.event:
            log.warning(output.event)
        if topic is not None:
            yield topic, output
        else:
            yield Ask(SEND_NAMES if isinstance(output, RoomNames) else REGION_SNAPSHOT, output)


def _sender(cfg: Config, identity: Identity) -> Sends:
    """Opens the socket that names go out on; without an address, there is none. Raises ServiceError."""
    socket = NameSender(cfg.labels_to) if cfg.labels_to else None

    async def send(request: RoomNames) -> RoomNamesSent:
        if socket is not None:
            socket.send(request.names)
        return RoomNamesSent(robot=request.robot)

    return send


async def drive(port: Port, cfg: Config) -> None:
    """Feed the newest graph to the service, again and again; say it when none comes, or what comes is none."""
    receiver, decoder = GraphReceiver(cfg.graph_from), Decoder(port.robot)
    silence = (
        f"no graph has come from {cfg.graph_from} for {cfg.silent_after_s:g} s; does Hydra run with a ZmqSink that "
        "sends there?"
    )
    said = ""
    try:
        while not port.stopping.is_set():
            payload = await receiver.receive(cfg.silent_after_s)
            read = None if payload is None else await asyncio.to_thread(_read, decoder, payload, port.robot)
            wrong = silence if read is None else read.why if isinstance(read, GraphLost) else ""
            if wrong and wrong != said:
                log.warning(wrong)
            said = wrong
            if read is not None:
                await port.consume(read)
    finally:
        receiver.close()
        decoder.close()


def _read(decoder: Decoder, payload: bytes, robot: str) -> HydraGraph | GraphLost:
    try:
        return decoder.read(payload)
    except GraphRefused as refused:
        return GraphLost(robot=robot, why=str(refused))


def _places(state: State, request: SnapshotRequest, cfg: Config) -> PlaceDelta:
    return update.places_snapshot(state)


def _objects(state: State, request: SnapshotRequest, cfg: Config) -> ObjectDelta:
    return update.objects_snapshot(state)


def _losses(state: State) -> list[Loss]:
    return state.losses.told


SEND_NAMES: Errand[Config] = Errand("ROOM_NAMES", RoomNames, RoomNamesSent, _sender)

SERVICE = Service(
    "hydra",
    purpose=__doc__ or "",
    scope="robot",
    config=Config,
    init=init,
    step=step,
    reads=(KEYFRAME, REGION_DELTA),
    writes=(PLACE_DELTA, OBJECT_DELTA, POSE_UPDATE),
    asks=(REGION_SNAPSHOT,),
    errands=(SEND_NAMES,),
    answers={PLACE_SNAPSHOT: _places, OBJECT_SNAPSHOT: _objects},
    tick_s=1.0,
    drive=drive,
    losses=_losses,
)
