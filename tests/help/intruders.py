"""A stage for intruders: a fleet with keys, its services, and what tells whether anybody has heard them."""

import asyncio
import contextlib
import logging
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

import msgspec
import zenoh

from prior_sg.deploy.keys.authority import Authority
from prior_sg.deploy.running.serve import _in_charge
from prior_sg.schemas.topics import ENCODE, JOURNAL, TOPICS, job_key
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.endpoints import free_endpoint, listened_to
from prior_sg.services.runtime.keys import VARIABLE, read_bundle
from prior_sg.services.runtime.service import Identity
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_session import client_config
from tests.help.paths import ROOT

TRACED = "warn,zenoh::net::routing::interceptor=trace"
PEOPLE = (("edge", "edge1"), ("robot", "A"), ("robot", "B"), ("robot", "stolen"), ("viewer", "anna"))
NOT_CONNECTED, BY_ROUTER, BY_SERVICE = "not connected", "refused by the edge's router", "dropped by the service"
ROUTER_LOG, TRACE_LOG, SERVICE_LOG = "router", "router, with RUST_LOG", "service"
BLOCK = zenoh.CongestionControl.BLOCK
START_S, PATIENCE_S = 300.0, 60.0  # on a busy machine
ROUTER = """
import sys, time
from prior_sg.deploy.keys.routing import beyond_this_host
from prior_sg.services.runtime.zenoh_router import open_router
stop = open_router(sys.argv[1], beyond_this_host(sys.argv[2:], []))
time.sleep(3600)
"""


@dataclass
class Row:
    """One line of the table."""

    who: str
    tried: str
    happened: str
    logged: str
    said: str  # the line of the log


class Records(logging.Handler):
    """What services have logged."""

    def __init__(self):
        super().__init__()
        self.told = []

    def emit(self, record):
        about = " ".join(f"{name}={getattr(record, name)}" for name in ("topic", "key", "why") if hasattr(record, name))
        self.told.append(f"{record.getMessage()} {about}".strip())


class Stage:
    """An edge's router in a process of its own; a store, a gateway and A's place graph; and somebody who listens."""

    def __init__(self, folder):
        self.own, self.foreign = Authority.create(folder / "own"), Authority.create(folder / "foreign")
        for role, name in PEOPLE:
            self.own.add(role, name)
        self.own.add("viewer", "late", days=0)
        self.own.revoke("stolen")
        self.foreign.add("robot", "A")
        self.tls, self.local = free_endpoint("tls/127.0.0.1:0"), free_endpoint("tcp/127.0.0.1:0")
        self.log, self.records, self.heard = folder / "router.log", Records(), []
        self._ending, self.hosts = [], {}
        logging.getLogger("prior_sg").addHandler(self.records)
        self._ending.append(lambda: logging.getLogger("prior_sg").removeHandler(self.records))
        self._start_router()
        self._start_services(folder)
        self.inside = zenoh.open(client_config(self.local))
        self._ending.append(self.inside.close)
        spy = ZenohBus(self.local)
        self._ending.append(spy.close)
        for topic in TOPICS:
            if topic.delivery != "job" and topic is not JOURNAL:
                spy.subscribe(topic, topic.pattern("*"), lambda one: self.heard.append(one.key), lambda *_: None)
        self.inside.declare_queryable(job_key(ENCODE, "w", "*"), lambda query: self.heard.append("a job"))

    def _start_router(self):
        environment = os.environ | {"RUST_LOG": TRACED, "NO_COLOR": "1", "PYTHONPATH": str(ROOT / "src")}
        environment[VARIABLE] = str(self.own.bundle("edge1"))
        with self.log.open("wb") as log:
            router = subprocess.Popen(
                [sys.executable, "-c", ROUTER, self.local, self.tls],
                stdout=log, stderr=subprocess.STDOUT, env=environment,
            )  # fmt: skip
        self.router_pid = router.pid
        self._ending.append(lambda: (router.terminate(), router.wait(30)))
        until(lambda: listened_to(self.local) and listened_to(self.tls), START_S)

    def _start_services(self, folder):
        loop = asyncio.new_event_loop()
        threading.Thread(target=loop.run_forever, daemon=True).start()
        settings = {"scene_store": {"path": str(folder / "s.sqlite")}, "prior_gateway": {"archive": str(folder / "p")}}
        for name in ("scene_store", "prior_gateway", "place_graph"):
            service = BY_NAME[name]
            cfg = msgspec.convert(settings.get(name, {}), service.config)
            identity = Identity("A" if service.scope == "robot" else "*", name, 1)

            async def begin(service=service, cfg=cfg, identity=identity):
                return await _in_charge(service, ZenohBus(self.local), cfg, identity)

            host = asyncio.run_coroutine_threadsafe(begin(), loop).result(START_S)
            running = asyncio.run_coroutine_threadsafe(host.run(), loop)
            self.hosts[name] = host
            self._ending.append(lambda host=host, running=running: (
                loop.call_soon_threadsafe(host.stop), running.result(30)
            ))  # fmt: skip
        until(lambda: self.records.told.count("started") == len(self.hosts), START_S)

    def end_of(self, bundle):
        """A session of Zenoh with somebody's keys: a liar uses no client of ours."""
        return contextlib.closing(zenoh.open(client_config(self.tls, read_bundle(bundle))))

    def close(self):
        for stop in reversed(self._ending):
            stop()


def until(condition, timeout_s=PATIENCE_S):
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < end_s, "did not happen"
        time.sleep(0.05)
    return found


def connects(stage, config, pattern):
    """Row of somebody who tries to connect: what happened, where that is logged, and the line."""
    begin = len(stage.log.read_text())
    try:
        zenoh.open(config).close()
        return "CONNECTED", "", ""
    except zenoh.ZError:
        line = until(lambda: re.search(f".*(?:{pattern}).*", stage.log.read_text()[begin:]))
        return NOT_CONNECTED, ROUTER_LOG, line[0]


def at_the_router(stage, bundle, act, pattern):
    """Row of a participant whose message the router must refuse: nobody has heard it."""
    begin, heard = len(stage.log.read_text()), len(stage.heard)
    with stage.end_of(bundle) as end:
        act(end)
        line = until(lambda: re.search(f".*(?:{pattern}).*", stage.log.read_text()[begin:]))
        time.sleep(0.3)
        came = stage.heard[heard:]
    return (BY_ROUTER if not came else f"HEARD: {came}"), TRACE_LOG, line[0]


def at_the_service(stage, act, where, counted, pattern, *, bundle=None):
    """Row of a message that gets as far as a service (name, topic), which must count and log it."""
    name, topic = where
    until(lambda: not len(stage.hosts[name].inbox))
    counts, begin = stage.hosts[name].inbox.of(topic.name), len(stage.records.told)
    before, consumed = getattr(counts, counted), counts.consumed
    with stage.end_of(bundle) if bundle else contextlib.nullcontext(stage.inside) as end:
        act(end)
        until(lambda: getattr(counts, counted) > before)
        line = until(lambda: next((one for one in stage.records.told[begin:] if re.search(pattern, one)), ""))
    taken = counts.consumed - consumed
    return (f"{BY_SERVICE}, {counted}" if not taken or counted == "limited" else f"TAKEN: {taken}"), SERVICE_LOG, line
