"""`prior-sg bench hydra`: how long a graph of Hydra takes to become places, and its rooms to get their names.

Graphs of places on a grid come from Spark-DSG's own sender, with a feature of 512 numbers on each place, over a
socket; the bridge runs in a host on the bus of this process. In each round one place in twenty has moved. What answers
its places is a stand-in for the segmenter, which renames a region at once, so that its own time is left out; the names
are taken by Spark-DSG's own receiver.
"""

import asyncio
import socket
import statistics
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import spark_dsg
from spark_dsg.zmq import DsgReceiver, DsgSender

from prior_sg.deploy.hydra.bridge import SERVICE, Config
from prior_sg.deploy.hydra.reading import read_graph
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import Region, RegionDelta
from prior_sg.schemas.topics import KEYFRAME, PLACE_DELTA, REGION_DELTA
from prior_sg.services.runtime.bus import Hub, LocalBus, Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.service import Identity

SIZES = (316, 2000)  # of the sample, and of a floor
ROUNDS, FEATURE, ROOM_PLACES = 60, 512, 100
ROBOT, PATIENCE_S = "bench", 10.0
Symbol = spark_dsg.NodeSymbol


def hydra_bench() -> tuple[dict[str, Any], dict[str, Any]]:
    """Milliseconds by number of places: graph sent → places on the bus, and → names at the receiver."""
    metrics: dict[str, Any] = {}
    for size in SIZES:
        metrics |= asyncio.run(_measured(size))
    settings = {"rounds": ROUNDS, "feature": FEATURE, "moved": "1 of 20 places", "segmenter": "a stand-in"}
    return metrics, settings


def grid_graph(size: int) -> spark_dsg.DynamicSceneGraph:
    """Places a metre apart, joined to their neighbours, a room for each hundred."""
    graph, columns = spark_dsg.DynamicSceneGraph(), round(size**0.5)
    for index in range(size):
        place = spark_dsg.PlaceNodeAttributes()
        place.position, place.distance, place.num_basis_points = np.array((*divmod(index, columns), 1.0)), 0.5, 3
        place.semantic_feature = np.full((FEATURE, 1), 0.5, np.float32)
        graph.add_node("PLACES", Symbol("p", index), place)
    way = spark_dsg.EdgeAttributes()
    way.weighted, way.weight = True, 0.4
    for index in range(size):
        for other in (index + 1, index + columns):
            if other < size and (other != index + 1 or other % columns):
                graph.insert_edge(Symbol("p", index), Symbol("p", other), way)
    for room in range(-(-size // ROOM_PLACES)):
        graph.add_node("ROOMS", Symbol("R", room), spark_dsg.RoomNodeAttributes())
    for index in range(size):
        graph.insert_edge(Symbol("R", index // ROOM_PLACES), Symbol("p", index))
    return graph


class _StandIn:
    """Renames all regions, one for each room, with each delta of places, and notes when that came."""

    def __init__(self, client: BusClient, size: int) -> None:
        self._client, self._size, self._revision = client, size, -1
        self.came = threading.Event()
        self.came_s = 0.0
        client.listen(PLACE_DELTA, ROBOT, self._answer)

    @property
    def label(self) -> str:
        """What regions are called now."""
        return f"label {self._revision}"

    def _answer(self, sample: Sample) -> None:
        self.came_s = time.perf_counter()
        delta: PlaceDelta = message_in(sample)
        self._revision += 1
        rooms = range(-(-self._size // ROOM_PLACES))
        regions = [
            Region(id=n, label=self.label, place_count=1, probability=1.0, position_m=(0.0, 0.0, 0.0), area_m2=1.0)
            for n in rooms
        ]
        ids, none = delta.place_ids, np.zeros(0, np.int64)
        told = RegionDelta(
            robot=ROBOT,
            epoch=1,
            revision=self._revision,
            stamp_ns=1,
            prior_digest="",
            environment="",
            task="",
            space="",
            labels=["x"],
            regions=regions,
            removed_ids=none,
            place_ids=ids,
            place_regions=ids // ROOM_PLACES,
            posteriors=np.ones((len(ids), 1), np.float16),
            unknown=np.zeros(len(ids), np.float16),
            removed_place_ids=none,
            energy=0.0,
        )
        self._client.publish(REGION_DELTA, told)
        self.came.set()


async def _measured(size: int) -> dict[str, Any]:
    graph_from, labels_to = _free_url(), _free_url()
    hub, graph = Hub(), grid_graph(size)
    cfg = Config(graph_from=graph_from, labels_to=labels_to)
    host = Host(SERVICE, LocalBus(hub), cfg, Identity(ROBOT, "hydra", 5))
    running = asyncio.create_task(host.run())
    sender, receiver = DsgSender(graph_from), DsgReceiver(labels_to)
    with BusClient(LocalBus(hub)) as client:
        client.publish(KEYFRAME, _keyframe())
        stand_in = _StandIn(client, size)
        await asyncio.to_thread(_warm_up, sender, receiver, graph, stand_in)
        rounds = await asyncio.to_thread(_rounds, sender, receiver, graph, stand_in)
    host.stop()
    await running
    payload = graph.to_binary()
    read_ms = _timed(lambda: read_graph(payload, ROBOT))
    for end in (sender, receiver):
        end._socket.close()
    places_ms, names_ms = (np.array(column) * 1e3 for column in zip(*rounds, strict=True))
    return {
        f"{size}_places": {
            "bytes": len(payload),
            "read_processor_ms_p50": read_ms,
            "graph_to_places_ms_p50": float(np.median(places_ms)),
            "graph_to_places_ms_p99": float(np.quantile(places_ms, 0.99)),
            "graph_to_names_ms_p50": float(np.median(names_ms)),
            "graph_to_names_ms_p99": float(np.quantile(names_ms, 0.99)),
        }
    }


def _warm_up(sender: DsgSender, receiver: DsgReceiver, graph: Any, stand_in: _StandIn) -> None:
    """Until both ends have found each other."""
    end_s = time.monotonic() + 3 * PATIENCE_S
    while not (stand_in.came.is_set() and receiver.recv(200)):
        if time.monotonic() > end_s:
            raise TimeoutError("the bridge does not answer")
        sender.send(graph)
        time.sleep(0.3)


def _rounds(sender: DsgSender, receiver: DsgReceiver, graph: Any, stand_in: _StandIn) -> list[tuple[float, float]]:
    """Seconds to the places and to the names, of each round."""
    rng, found = np.random.default_rng(7), []
    places = list(graph.get_layer("PLACES").nodes)
    for _ in range(ROUNDS):
        for row in rng.choice(len(places), len(places) // 20, replace=False).tolist():
            attributes = places[row].attributes
            attributes.position = attributes.position + rng.uniform(0.02, 0.1, 3)
        payload, before = graph.to_binary(), stand_in.label
        stand_in.came.clear()
        started_s = time.perf_counter()
        sender._socket.send(payload)
        while before == stand_in.label or _name(receiver) != stand_in.label:
            if not receiver.recv(20) and time.perf_counter() - started_s > PATIENCE_S:
                raise TimeoutError("no names came back")
        found.append((stand_in.came_s - started_s, time.perf_counter() - started_s))
    return found


def _name(receiver: DsgReceiver) -> str:
    return str(receiver.graph.get_node(Symbol("R", 0)).attributes.name)


def _timed(work: Callable[[], object], turns: int = 15) -> float:
    """Median milliseconds of processor time."""
    spent = []
    for _ in range(turns):
        started_s = time.process_time()
        work()
        spent.append(1e3 * (time.process_time() - started_s))
    return statistics.median(spent)


def _free_url() -> str:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{held.getsockname()[1]}"


def _keyframe() -> Keyframe:
    return Keyframe(
        robot=ROBOT,
        frame_id=0,
        stamp_ns=1,
        intrinsics=Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5),
        world_from_camera=np.eye(4),
        color=b"",
        depth=b"",
        depth_scale_m=0.001,
    )
