"""Facts of the bus: whether there is a router, who is on it, and what they say."""

import os
import time

from prior_sg.deploy.inspecting.doctor.findings import START, Finding, OnTheBus
from prior_sg.deploy.inspecting.health import look
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import (
    check_endpoint,
    check_reach,
    free_endpoint,
    listened_to,
    on_loopback,
    secured,
    unanswered,
)
from prior_sg.services.runtime.extras import release
from prior_sg.services.runtime.keys import VARIABLE
from prior_sg.services.runtime.zenoh_bus import ZenohBus

MAKE_KEYS = "prior-sg keys init"


def of_the_bus(connect: str) -> OnTheBus:
    """Asks everybody, as `prior-sg health` does."""
    try:
        check_endpoint(connect)
        check_reach(connect, with_keys=bool(os.environ.get(VARIABLE)))
    except BusError as error:
        return OnTheBus(told=[Finding("router", str(error), _mend_of_reach(connect))])
    try:
        if not listened_to(connect):
            return OnTheBus(told=[Finding("router", unanswered(connect), START)])
        bus = ZenohBus(connect, wait_s=0.0)
    except BusError as error:
        return OnTheBus(told=[_stranger(connect, str(error))])
    with BusClient(bus) as client:
        from_ns = time.time_ns()
        found = look(client)
        return OnTheBus(found=found, from_ns=from_ns, to_ns=time.time_ns(), release=release())


def _mend_of_reach(connect: str) -> str:
    try:
        return START if on_loopback(connect) and not secured(connect) else MAKE_KEYS
    except BusError:  # it is not even an endpoint
        return START


def _stranger(connect: str, said: str) -> Finding:
    """Something takes the connection and speaks another language, or does not know these keys."""
    if secured(connect):
        return Finding("router", said, "prior-sg keys list")
    try:
        mend = f"{START} --connect {free_endpoint(connect)}"
    except BusError:
        return Finding("router", said, START)
    return Finding("router", f"{connect} is taken by a program that is no router of Zenoh; choose another port", mend)
