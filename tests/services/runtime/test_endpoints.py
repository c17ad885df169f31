"""Which endpoints are taken, which are free, and what is said of the others."""

import errno
import json
import socket
import time
from pathlib import Path

import pytest
import zenoh

from prior_sg.services.runtime import zenoh_router
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.endpoints import (
    cannot_listen,
    check_endpoint,
    free_endpoint,
    on_loopback,
    parse_endpoint,
)
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router, router_settings
from prior_sg.services.runtime.zenoh_session import client_config

ROUTER_FILE = Path(__file__).parents[3] / "deploy" / "router.json5"
NONSENSE = (
    "",
    "7447",
    "127.0.0.1:7447",
    "tcp/127.0.0.1",
    "tcp/:7447",
    "tcp/::1:7447",
    "tcp/[::1:7447",
    "tcp/127.0.0.1:-1",
    "tcp/127.0.0.1:99999",
    "tcp/127.0.0.1:7447/x",
    "tcp/a b:7447",
    "http://localhost:7447",
    "foo/127.0.0.1:7447",
)


def has_ipv6():
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


@pytest.mark.parametrize("text", NONSENSE)
def test_nonsense_is_refused_at_once_by_router_client_and_search(text):
    started_s = time.monotonic()
    for use in (free_endpoint, open_router, ZenohBus):
        with pytest.raises(BusError, match="--connect takes PROTOCOL/HOST:PORT") as refused:
            use(text)
        assert "\n" not in str(refused.value)
    assert time.monotonic() - started_s < 8  # none of them has waited for a router


def test_port_0_is_for_a_run_only():
    with pytest.raises(BusError, match="port 0"):
        check_endpoint("tcp/127.0.0.1:0")
    assert parse_endpoint(free_endpoint("tcp/127.0.0.1:0")).port > 0


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1",
        "127.0.0.2",
        "localhost",
        pytest.param("[::1]", marks=pytest.mark.skipif("not has_ipv6()")),
    ],
)
@pytest.mark.parametrize("protocol", ["tcp", "udp"])
def test_odd_loopbacks_carry_a_bus(protocol, host):
    endpoint = free_endpoint(f"{protocol}/{host}:0")
    assert endpoint.startswith(f"{protocol}/{host}:")
    stop = open_router(endpoint)
    try:
        ZenohBus(endpoint, wait_s=2.0).close()
    finally:
        stop()


def test_what_follows_the_port_is_kept():
    assert free_endpoint("tcp/127.0.0.1:0#iface=lo").endswith("#iface=lo")


def test_a_taken_port_gives_another_and_a_router_there_says_so():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        wanted = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        assert free_endpoint(wanted) != wanted
        with pytest.raises(BusError, match="in use"):
            open_router(wanted)


def test_an_address_of_another_host_is_told_from_a_taken_port():
    with pytest.raises(BusError, match="no address of this host"):
        free_endpoint("tcp/192.0.2.1:7447")
    with pytest.raises(BusError, match="not known here"):
        free_endpoint("tcp/nosuchhost.invalid:7447")


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EACCES, "above 1023"),
        (errno.EADDRINUSE, "in use"),
        (errno.EAFNOSUPPORT, "IPv6"),
        (errno.EMFILE, "ulimit -n"),
        (0, "Missing TLS private key"),
    ],
)
def test_causes_are_told_apart(number, said):
    assert said in cannot_listen("tcp/127.0.0.1:80", number, "Missing TLS private key")


def test_no_zenoh_of_ours_asks_for_shared_memory():
    for config in (
        client_config("tcp/127.0.0.1:1"),
        zenoh.Config.from_json5(json.dumps(router_settings("tcp/127.0.0.1:1"))),
        zenoh.Config.from_file(str(ROUTER_FILE)),
    ):
        assert config.get_json("transport/shared_memory/enabled") == "false"


def test_a_port_taken_after_it_was_found_free_is_no_end(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        found = [f"tcp/127.0.0.1:{taken.getsockname()[1]}", free_endpoint("tcp/127.0.0.1:0")]
        monkeypatch.setattr(zenoh_router, "free_endpoint", lambda wanted: found.pop(0))
        endpoint, stop = zenoh_router.open_free_router("tcp/127.0.0.1:0")
        stop()
    assert found == [] and endpoint.startswith("tcp/127.0.0.1:")


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:1", True),
        ("tcp/127.8.9.1:1", True),
        ("tcp/localhost:1", True),
        ("tcp/[::1]:1", True),
        ("unixsock-stream//tmp/x", True),
        ("tcp/0.0.0.0:1", False),
        ("tcp/[::]:1", False),
        ("udp/10.0.0.1:1", False),
        ("tcp/localhost.example.org:1", False),
    ],
)
def test_what_others_reach_is_refused_without_keys(endpoint, local):
    assert on_loopback(endpoint) == local
    if not local:
        for use in (open_router, ZenohBus):
            with pytest.raises(BusError, match="prior-sg keys init"):
                use(endpoint)


def test_a_router_file_of_one_host_listens_to_it_only():
    endpoints = json.loads(zenoh.Config.from_file(str(ROUTER_FILE)).get_json("listen/endpoints"))
    assert endpoints and all(map(on_loopback, endpoints))
