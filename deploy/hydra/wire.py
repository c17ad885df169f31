"""The two ZMQ sockets: Hydra's ZmqSink publishes whole graphs, its ZmqRoomLabelUpdater subscribes to names of rooms.

Both ends speak as `spark_dsg.zmq` does: each message is one graph in Spark-DSG's binary form and nothing else.
"""

import errno
from collections.abc import Mapping

import spark_dsg
import zmq
import zmq.asyncio

from prior_sg.deploy.hydra.core.graph import NO_ROOM
from prior_sg.services.runtime.service import ServiceError

FORM = "write it as tcp://HOST:PORT or ipc:///PATH"
WORDS = {
    zmq.EADDRINUSE: "another program listens there; choose another port with --labels-to",
    zmq.EADDRNOTAVAIL: "this machine has no such address; name one of its own",
    errno.ENODEV: "this machine has no such address; name one of its own",
    zmq.EINVAL: FORM,
    zmq.EPROTONOSUPPORT: FORM,
    zmq.ENOCOMPATPROTO: FORM,
}


class GraphReceiver:
    """Where Hydra's graphs arrive. Only the newest is kept: each is the whole. Raises ServiceError."""

    def __init__(self, url: str) -> None:
        self._socket = zmq.asyncio.Context.instance().socket(zmq.SUB)
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SUBSCRIBE, b"")
        try:
            self._socket.connect(url)
        except zmq.ZMQError as error:
            self._socket.close()
            raise ServiceError(f"no graphs can come from {url}: {_why(error)}") from error

    async def receive(self, timeout_s: float) -> bytes | None:
        """The next message, or None."""
        if not await self._socket.poll(timeout_s * 1000):
            return None
        message: bytes = await self._socket.recv()
        return message

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


class NameSender:
    """Where names of rooms go out; whoever subscribes hears the next. Raises ServiceError."""

    def __init__(self, url: str) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            self._socket.bind(url)
        except zmq.ZMQError as error:
            self._socket.close()
            raise ServiceError(f"names of rooms cannot be sent on {url}: {_why(error)}") from error

    def send(self, names: Mapping[int, str]) -> None:
        """One message with all names; it never waits."""
        self._socket.send(names_graph(names).to_binary(include_mesh=False))

    def close(self) -> None:
        """Free the address."""
        self._socket.close()


def names_graph(names: Mapping[int, str]) -> spark_dsg.DynamicSceneGraph:
    """What ZmqRoomLabelUpdater reads: a graph whose layer ROOMS has nodes with the rooms' ids and their new names."""
    graph = spark_dsg.DynamicSceneGraph()
    for room, name in names.items():
        if room == NO_ROOM:
            continue
        node = spark_dsg.RoomNodeAttributes()
        node.name = name
        value = room % 2**64
        graph.add_node(spark_dsg.DsgLayers.ROOMS, spark_dsg.NodeSymbol(value), node)
    return graph


def _why(error: zmq.ZMQError) -> str:
    return WORDS.get(error.errno or 0, str(error))
