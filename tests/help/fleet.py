"""A fleet with keys on one machine: routers over TLS on loopback, and what tests do at their ends."""

import json
import time

import zenoh

from prior_sg.deploy.keys.access import access_control
from prior_sg.deploy.keys.authority import Authority
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.keys import VARIABLE, Beyond, read_bundle
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router
from prior_sg.services.runtime.zenoh_session import client_config

ROBOTS = ("robotA", "robotB")
PARTICIPANTS = (("edge", "edge1"), *(("robot", name) for name in ROBOTS), ("viewer", "anna"), ("operator", "otto"))


def beyond(folder, listen=(), join=(), thin_bps=0):
    bundle = read_bundle(folder)
    access = access_control(bundle.about.participants, ["lo"])
    return Beyond(bundle=bundle, access=access, listen=listen, join=join, thin_bps=thin_bps)


class Fleet:
    """Two authorities, an edge's router and one of robotA, and the ends of the bus that tests ask for."""

    def __init__(self, folder, thin_bps=0):
        self.own, self.foreign = Authority.create(folder / "own"), Authority.create(folder / "foreign")
        for role, name in PARTICIPANTS:
            self.own.add(role, name)
        self.own.add("viewer", "late", days=0)
        self.own.add("robot", "stolen")
        self.foreign.add("robot", "robotA")
        self.old = folder / "old"
        self.own.bundle("robotB").rename(self.old)
        self.own.rotate("robotB")
        self.own.revoke("stolen")
        self.tls, self.local, self.robot = (free_endpoint(f"{kind}/127.0.0.1:0") for kind in ("tls", "tcp", "tcp"))
        edge = beyond(self.own.bundle("edge1"), listen=(self.tls,), thin_bps=thin_bps)
        robot = beyond(self.own.bundle("robotA"), join=(self.tls,), thin_bps=thin_bps)
        self.stops = [open_router(self.local, edge), open_router(self.robot, robot)]

    def bus(self, folder, patch, wait_s=0.1):
        patch.setenv(VARIABLE, str(folder))
        bus = ZenohBus(self.tls, wait_s)
        self.stops.append(bus.close)
        return bus

    def at(self, endpoint):
        bus = ZenohBus(endpoint, 2.0)
        self.stops.append(bus.close)
        return bus

    def close(self):
        for stop in reversed(self.stops):
            stop()


def until(condition, timeout_s=30.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not happen"
        time.sleep(0.02)


def without_certificate(fleet):
    """A client that knows the authority and has no certificate of its own."""
    settings = json.loads(client_config(fleet.tls, read_bundle(fleet.own.bundle("anna"))).get_json("transport"))
    tls = {"root_ca_certificate": settings["link"]["tls"]["root_ca_certificate"], "verify_name_on_connect": False}
    config = {"mode": "client", "connect": {"endpoints": [fleet.tls], "timeout_ms": 500}}
    return zenoh.Config.from_json5(json.dumps(config | {"transport": {"link": {"tls": tls}}}))
