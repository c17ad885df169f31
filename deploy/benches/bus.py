"""What the typed bus costs on top of bare Zenoh: two processes, as every writer and reader are, joined by a router.

Both ways carry the same bytes: typed messages are encoded, published, validated and handed to a handler; bare ones are
put and handed to a callback. They take turns, and the median of their ratios counts. So does a third, typed and by TLS
with keys from both processes to the router: twice what a robot and an edge have between them. The processor time of
writer, router and reader for each message says what it costs beside other work, when rates say little.

Bare puts send one object again and again; a program that made new bytes for each would pay for that as the typed do.
"""

import multiprocessing
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from prior_sg.deploy.keys.authority import Authority
from prior_sg.deploy.keys.routing import beyond_this_host
from prior_sg.deploy.settings import use_keys
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.topics import KEYFRAME
from prior_sg.services.runtime.bus import Sample, pack_header
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router
from prior_sg.services.runtime.zenoh_session import client_config

SIZES = {"150kB": (150_000, 1500), "1.5MB": (1_500_000, 200)}  # bytes, messages of one turn
TURNS = 5
BARE_KEY = "bench/bare"
TIMEOUT_S = 60.0


def bus_bench(keyframe: Keyframe) -> tuple[dict, dict]:
    """Typed publish → handler through a router, as share of bare Zenoh put → callback of the same size."""
    metrics: dict[str, float] = {}
    with _routers() as (endpoint, tls):
        for name, (size, number) in SIZES.items():
            half = os.urandom(size // 2)
            message = msgspec.structs.replace(keyframe, color=half, depth=half)
            ways = ((endpoint, True), (endpoint, False), (tls, True))
            rates = [[_rate(where, message, number, typed) for where, typed in ways] for _ in range(TURNS)]
            for number_of_way, way in enumerate(("", "bare_", "tls_")):
                rate, cpu_us = zip(*(turn[number_of_way] for turn in rates), strict=True)
                metrics[f"{way}messages_per_s_{name}"] = statistics.median(rate)
                metrics[f"{way}cpu_us_{name}"] = statistics.median(cpu_us)
            metrics[f"throughput_ratio_{name}"] = statistics.median(typed[0] / bare[0] for typed, bare, _ in rates)
            metrics[f"cpu_ratio_{name}"] = statistics.median(bare[1] / typed[1] for typed, bare, _ in rates)
            metrics[f"tls_ratio_{name}"] = statistics.median(secured[0] / typed[0] for typed, _, secured in rates)
    metrics["throughput_ratio"] = min(value for name, value in metrics.items() if name.startswith("throughput"))
    return metrics, {"path": "process, router, process on loopback", "turns": TURNS}


@contextmanager
def _routers() -> Iterator[tuple[str, str]]:
    """A plain router, and the TLS endpoint of another; this process and its children get keys for that."""
    plain, local = free_endpoint("tcp/127.0.0.1:0"), free_endpoint("tcp/127.0.0.1:0")
    tls = free_endpoint("tls/127.0.0.1:0")
    with tempfile.TemporaryDirectory() as folder:
        authority = Authority.create(Path(folder))
        authority.add("edge", "edge")
        authority.add("robot", "bench")
        use_keys(str(authority.bundle("edge")))
        stops = [open_router(plain), open_router(local, beyond_this_host([tls], []))]
        use_keys(str(authority.bundle("bench")))
        try:
            yield plain, tls
        finally:
            for stop in stops:
                stop()


def _rate(endpoint: str, message: Keyframe, number: int, typed: bool) -> tuple[float, float]:
    """Messages per second that arrive in another process, and microseconds of processor time for each."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    reader = context.Process(target=_read, args=(endpoint, number, typed, there), daemon=True)
    reader.start()
    try:
        _received(here)  # it is subscribed
        written_s = (_write_typed if typed else _write_bare)(endpoint, message, number, here)
        rate, read_s = _received(here)
        return rate, (written_s + read_s) / number * 1e6
    finally:
        reader.terminate()
        reader.join()


def _received(pipe: Connection) -> Any:
    if not pipe.poll(TIMEOUT_S):
        raise TimeoutError("the reader of the bus bench says nothing")
    return pipe.recv()


def _write_typed(endpoint: str, message: Keyframe, number: int, pipe: Connection) -> float:
    bus, key = ZenohBus(endpoint), KEYFRAME.key_of(message)
    try:
        return _write(lambda sequence: bus.put(KEYFRAME, key, encode(message), _header(sequence)), number, pipe)
    finally:
        bus.close()


def _write_bare(endpoint: str, message: Keyframe, number: int, pipe: Connection) -> float:
    payload = encode(message)
    with zenoh.open(client_config(endpoint)) as session:
        publisher = session.declare_publisher(BARE_KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        return _write(lambda sequence: publisher.put(payload), number, pipe)


def _write(put: Callable[[int], None], number: int, pipe: Connection) -> float:
    """One message ahead, so that reader and writer have found each other; the reader then waits for the others. Returns
    the seconds of processor time of this process, in which the router is, from then on."""
    put(0)
    _received(pipe)
    began_s = time.process_time()
    for sequence in range(1, number + 1):
        put(sequence)
    _received(pipe)
    pipe.send(None)
    return time.process_time() - began_s


def _read(endpoint: str, number: int, typed: bool, pipe: Connection) -> None:
    """In the reader's process."""
    reader: ZenohBus | zenoh.Session
    arrivals_s: list[float] = []
    first, last = threading.Event(), threading.Event()

    def handle(message: Any) -> None:
        arrivals_s.append(time.perf_counter())
        first.set()
        if len(arrivals_s) > number:
            last.set()

    if typed:
        reader = ZenohBus(endpoint)
        reader.subscribe(KEYFRAME, KEYFRAME.pattern("bench"), lambda sample: handle(_decoded(sample)), lambda *_: None)
    else:
        reader = zenoh.open(client_config(endpoint))
        reader.declare_subscriber(BARE_KEY, lambda sample: handle(sample.payload.to_bytes()))
    time.sleep(0.5)  # until the router has told the writers
    pipe.send(None)
    first.wait(TIMEOUT_S)
    began_s = time.process_time()
    pipe.send(None)
    last.wait(TIMEOUT_S)
    read_s = time.process_time() - began_s
    pipe.send(None)
    pipe.recv()
    reader.close()
    pipe.send(((len(arrivals_s) - 1) / (arrivals_s[-1] - arrivals_s[0]), read_s))


def _decoded(sample: Sample) -> Keyframe:
    return decode(Keyframe, sample.payload)


def _header(sequence: int) -> bytes:
    return pack_header("bench", sequence, time.time_ns())
