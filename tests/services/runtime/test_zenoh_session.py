"""Samples that come for a subscription that has just ended: none is lost for others, and Zenoh says little of them."""

import os
import re
import subprocess
import sys
import threading
import time

import pytest
import zenoh

from prior_sg.schemas.topics import PLACE_DELTA
from prior_sg.services.runtime.bus import pack_header
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_session import Presence, client_config, fixed_part

CLOSES = 20
CLOSING = """
import sys, threading
from prior_sg.schemas.topics import PLACE_DELTA
from prior_sg.services.runtime.zenoh_bus import ZenohBus
for _ in range(int(sys.argv[2])):
    bus, heard = ZenohBus(sys.argv[1]), [threading.Semaphore(0) for _ in range(2)]
    for robot, one in zip(("*", "flood"), heard, strict=True):
        bus.subscribe(PLACE_DELTA, PLACE_DELTA.pattern(robot), lambda sample, one=one: one.release(), lambda *_: None)
    for _ in range(300):  # what writers keep for late readers, and more
        assert all(one.acquire(timeout=20) for one in heard)
    bus.close()
"""
ENDING = """
import sys, threading
from prior_sg.schemas.topics import INGEST_STATE
from prior_sg.services.runtime.bus import pack_header
from prior_sg.services.runtime.zenoh_bus import ZenohBus
reader, writer, heard = ZenohBus(sys.argv[1]), ZenohBus(sys.argv[1]), threading.Event()
key = INGEST_STATE.pattern("ending")
reader.subscribe(INGEST_STATE, INGEST_STATE.pattern("*"), lambda sample: heard.set(), lambda *_: None)
reader.subscribe(INGEST_STATE, key, lambda sample: None, lambda *_: None)()
while not heard.wait(0.1):
    writer.put(INGEST_STATE, key, b"x", pack_header("w", 0, 0))
reader.close()
writer.close()
"""
SERVED = """
import sys, threading
from prior_sg.schemas.topics import SCENE_QUERY
from prior_sg.services.runtime.zenoh_bus import ZenohBus
server, caller = ZenohBus(sys.argv[1]), ZenohBus(sys.argv[1])
server.serve(SCENE_QUERY.key.format(robot="*"), lambda request: request.refuse("heard"))
server.serve(SCENE_QUERY.key.format(robot="ending"), lambda request: request.refuse("heard"))()
for _ in range(3):
    answered = threading.Event()
    caller.call(SCENE_QUERY.key.format(robot="ending"), b"", 20.0, lambda answer: answered.set())
    assert answered.wait(30)
caller.close()
server.close()
"""
CALLED = re.compile(r'recv Request .*?scope: (\d+), suffix: "([^"]*)"')
RECEIVED = re.compile(r'recv Push .*?scope: (\d+), suffix: "([^"]*)"')


def output_of(script, *arguments, **environment):
    command = [sys.executable, "-c", script, *map(str, arguments)]
    around = os.environ | environment
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=120, env=around).stdout


@pytest.fixture
def flooded(endpoint):
    """A router over which a writer sends thousands of samples a second."""
    over, bus = threading.Event(), ZenohBus(endpoint)

    def write():
        number = 0
        while not over.is_set():
            bus.put(PLACE_DELTA, PLACE_DELTA.pattern("flood"), b"x", pack_header("w", number, time.time_ns()))
            number += 1
            time.sleep(0.0002)

    writer = threading.Thread(target=write)
    writer.start()
    yield endpoint
    over.set()
    writer.join()
    bus.close()


def test_a_session_closes_without_a_word_about_what_still_comes(flooded):
    said = output_of(CLOSING, flooded, CLOSES)
    assert said.count("unknown") < CLOSES / 4, said  # one that is in a thread's hands then, Zenoh still complains of


def test_the_number_of_a_key_outlives_a_subscription_to_it_where_others_read_the_key(endpoint):
    """Zenoh gives it up in two steps, and loses what comes between them: too seldom to be seen by its loss."""
    received = RECEIVED.findall(output_of(ENDING, endpoint, RUST_LOG="zenoh::api::session=trace"))
    assert received and all(number != "0" and rest == "" for number, rest in received)


def test_the_number_of_a_key_outlives_a_server_of_it_where_others_serve_the_key(endpoint):
    """As with subscriptions: of 3500 calls beside a server that came and went 1700 times, six were never answered."""
    called = CALLED.findall(output_of(SERVED, endpoint, RUST_LOG="zenoh::api::session=trace"))
    assert called and all(number != "0" and rest == "" for number, rest in called)


@pytest.mark.parametrize(
    ("pattern", "part"),
    [("psg/*/places", "psg"), ("psg/r/places", "psg/r/places"), ("**", ""), ("a/b$*/c", "a"), ("a/b/**", "a/b")],
)
def test_the_fixed_part_of_a_pattern(pattern, part):
    assert fixed_part(pattern) == part


def test_what_a_session_watches_it_asks_for_over_another(endpoint):
    there, watcher = (zenoh.open(client_config(endpoint)) for _ in range(2))
    tokens = [there.liveliness().declare_token(f"psg/there/{number}") for number in range(5)]
    opened, seen = [], []
    presence = Presence(watcher, lambda: opened.append(zenoh.open(client_config(endpoint))) or opened[-1])

    def asked(pattern):
        return {str(reply.ok.key_expr) for reply in presence.ask(pattern, 20.0) if reply.ok is not None}

    everybody = {str(number) for number in range(5)}
    while {key.rpartition("/")[2] for key in asked("psg/there/*")} != everybody:
        time.sleep(0.01)
    assert not opened
    presence.watch("psg/there/**", lambda sample: seen.append(str(sample.key_expr)))
    for _ in range(200):
        assert {key.rpartition("/")[2] for key in asked("psg/*/*")} == everybody
    assert asked("psg/elsewhere/*") == set()
    assert len(opened) == 1 and not opened[0].is_closed()
    presence.close()
    assert opened[0].is_closed()
    assert len(seen) == len(set(seen)) == len(tokens)  # once each, and not again at each question
    watcher.close()
    there.close()
