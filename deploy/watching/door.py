"""Figures of a running system for Prometheus, and traces for a collector, until somebody ends it."""

import contextlib
from collections.abc import Callable

from prometheus_client import CollectorRegistry, make_asgi_app

from prior_sg.deploy.serving.gate import Entrance, Gate
from prior_sg.deploy.serving.server import address_of, listening, serve
from prior_sg.deploy.watching.follower import Follower, OnPassages
from prior_sg.deploy.watching.latency import Latencies
from prior_sg.deploy.watching.metrics import Collector
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.hearing import end_deaf
from prior_sg.services.runtime.zenoh_bus import ZenohBus

Say = Callable[[str], None]


def serve_metrics(  # noqa: PLR0917
    connect: str, robot: str, entrance: Entrance, port: int, collector: str | None, say: Say, parent: int = 0
) -> None:
    """HTTP until a signal. `collector` takes traces: an address, "" for the one of the environment, None for none.
    Raises BusError, UserError, KeyboardInterrupt."""
    latencies = Latencies()
    taps: list[OnPassages] = [lambda passages: latencies.follow(passage for _, passage in passages)]
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(listening(entrance.host, port))
        client = stack.enter_context(BusClient(ZenohBus(connect, on_deaf=end_deaf)))
        if collector is not None:
            from prior_sg.deploy.watching.otlp import Export, endpoint_in_force

            export = Export(endpoint_in_force(collector))
            stack.callback(export.close)
            taps.append(export)
        follower = Follower(client, robot, taps)
        stack.callback(follower.close)
        registry = CollectorRegistry()
        registry.register(Collector(follower, latencies))
        say(f"metrics on {address_of(listener)}/metrics")
        serve(Gate(make_asgi_app(registry), entrance), listener, parent=parent)
