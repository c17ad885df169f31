"""Intruders: what each tries on a fleet with keys, what happens, and where that is logged. Prints the table:

python -m tests.help.intruder_rows
"""

import contextlib
import itertools
import json
import logging
import struct
import tempfile
import time
import zlib
from pathlib import Path
from unittest import mock

import numpy as np
import psutil
import zenoh

from prior_sg.schemas.codec import decode_plain, encode, encode_plain
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.priors import PriorClaim, Task
from prior_sg.schemas.topics import (
    ENCODE,
    KEYFRAME,
    MB,
    PLACE_DELTA,
    PRIOR,
    PRIOR_CLAIM,
    SCENE,
    TASK,
    job_key,
)
from prior_sg.services.runtime import zenoh_session
from prior_sg.services.runtime.bus import pack_header
from prior_sg.services.runtime.keys import read_bundle
from prior_sg.services.runtime.zenoh_session import client_config
from tests.help.examples import PRIOR as A_PRIOR
from tests.help.intruders import BLOCK, BY_ROUTER, Row, Stage, at_the_router, at_the_service, connects, until
from tests.help.world import no_places

UNAUTHORISED = "is unauthorized to Put"
WRITERS = itertools.count()
ROWS = []  # (intruder, what is tried, function of a stage)


def row(who, tried):
    """Note a function as a row of the table."""

    def note(function):
        ROWS.append((who, tried, function))
        return function

    return note


def png(width, height):
    """A depth image that is small as a file and says to be large."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 64)) + chunk(b"IEND", b"")


def keyframe(**changes):
    fields = {
        "robot": "A", "frame_id": 0, "stamp_ns": 1, "intrinsics": Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0),
        "world_from_camera": np.eye(4), "color": b"", "depth": b"", "depth_scale_m": 0.001,
    }  # fmt: skip
    return Keyframe(**(fields | changes))


def task(robot="A", stamp_ns=1):
    return Task(robot=robot, stamp_ns=stamp_ns, environment="e", task="t")


def forged(message, **fields):
    """The bytes of a message with fields that no message can have."""
    return encode_plain(decode_plain(encode(message), type(message).__name__) | fields)


def places(**changes):
    return no_places(**({"robot": "A"} | changes))


def header(writer="", number=0):
    return pack_header(writer or f"liar/{next(WRITERS)}/1", number, time.time_ns())


def put(key, message, **how):
    """An act: put bytes or a message there."""
    payload = message if isinstance(message, bytes) else encode(message)
    return lambda end: end.put(key, payload, attachment=header(**how), congestion_control=BLOCK)


def without_certificate(stage):
    settings = json.loads(client_config(stage.tls, read_bundle(stage.own.bundle("anna"))).get_json("transport"))
    tls = {"root_ca_certificate": settings["link"]["tls"]["root_ca_certificate"], "verify_name_on_connect": False}
    connect = {"endpoints": [stage.tls], "timeout_ms": 1000}
    text = json.dumps({"mode": "client", "connect": connect, "transport": {"link": {"tls": tls}}})
    return zenoh.Config.from_json5(text)


def plain(stage):
    endpoint = stage.tls.replace("tls/", "tcp/")
    return zenoh.Config.from_json5(
        json.dumps({"mode": "client", "connect": {"endpoints": [endpoint], "timeout_ms": 1000}})
    )


@row("a stranger", "to connect without a certificate")
def _(stage):
    return connects(stage, without_certificate(stage), "peer sent no certificates")


@row("a stranger", "to connect by plain TCP")
def _(stage):
    return connects(stage, plain(stage), "corrupt message")


@row("a stranger", "to connect with a certificate of another authority")
def _(stage):
    return connects(
        stage, client_config(stage.tls, read_bundle(stage.foreign.bundle("A"))), "fatal alert|UnknownIssuer"
    )


@row("a former viewer", "to connect with an expired certificate")
def _(stage):
    return connects(stage, client_config(stage.tls, read_bundle(stage.own.bundle("late"))), "certificate expired")


@row("a stolen robot", "to write with a revoked certificate")
def _(stage):
    act = put("psg/stolen/places", places(robot="stolen"))
    return at_the_router(stage, stage.own.bundle("stolen"), act, "did not match any configured ACL subject")


@row("robot B", "to write places of A")
def _(stage):
    return at_the_router(stage, stage.own.bundle("B"), put("psg/A/places", places()), UNAUTHORISED)


@row("robot B", "to write a keyframe of A")
def _(stage):
    return at_the_router(stage, stage.own.bundle("B"), put("psg/A/keyframe", keyframe()), UNAUTHORISED)


@row("robot B", "to give every robot a task, on `psg/*/task`")
def _(stage):
    return at_the_router(stage, stage.own.bundle("B"), put("psg/*/task", task()), UNAUTHORISED)


@row("robot B", "to forge a prior")
def _(stage):
    key = f"psg/fleet/prior/{A_PRIOR.digest()}"
    return at_the_router(stage, stage.own.bundle("B"), put(key, A_PRIOR), UNAUTHORISED)


@row("robot B", "to give a job as A")
def _(stage):
    def act(end):
        list(end.get(job_key(ENCODE, "w", "A"), payload=encode(keyframe())))

    return at_the_router(stage, stage.own.bundle("B"), act, "is unauthorized to Query")


@row("robot B", "to ask for the scene of A")
def _(stage):
    def act(end):
        list(end.get(SCENE.key.format(robot="A")))

    return at_the_router(stage, stage.own.bundle("B"), act, "is unauthorized to Query")


@row("a viewer", "to give a task")
def _(stage):
    return at_the_router(stage, stage.own.bundle("anna"), put("psg/A/task", task()), UNAUTHORISED)


@row("robot B", "a message of A on its own key")
def _(stage):
    act = put("psg/B/places", places())
    return at_the_service(
        stage, act, ("scene_store", PLACE_DELTA), "malformed", "it came on psg/B/places", bundle=stage.own.bundle("B")
    )


@row("robot B", "random bytes on its own key")
def _(stage):
    act = put("psg/B/places", b"\xff" * 64)
    return at_the_service(
        stage, act, ("scene_store", PLACE_DELTA), "malformed", "malformed message dropped", bundle=stage.own.bundle("B")
    )


@row("robot B", "a task of 5 MB")
def _(stage):
    return at_the_router(stage, stage.own.bundle("B"), put("psg/B/task", bytes(5 * MB)), "Msg intercepted!")


@row("robot B", "a message of 300 MB")
def _(stage):
    router, heard = psutil.Process(stage.router_pid), len(stage.heard)
    before_mb = router.memory_info().rss / MB
    with stage.end_of(stage.own.bundle("B")) as end:
        put("psg/B/pose_update", bytes(300 * MB))(end)
        put("psg/B/backfill", b"after it")(end)
        until(lambda: len(stage.heard) > heard)
    grown_mb = router.memory_info().rss / MB - before_mb
    came = [key for key in stage.heard[heard:] if key == "psg/B/pose_update"]
    return (f"{BY_ROUTER}, which keeps {grown_mb:.0f} MB" if not came else f"HEARD: {came}"), "nobody", ""


@row("robot A", "an old message of its own again, as it was")
def _(stage):
    act, bundle = put("psg/A/task", task(stamp_ns=5), writer="console/a/1", number=3), stage.own.bundle("A")
    counts = stage.hosts["scene_store"].inbox.of("TASK")
    before = counts.consumed
    with stage.end_of(bundle) as end:
        act(end)
        until(lambda: counts.consumed > before)
    said = "message seen before dropped"
    return at_the_service(stage, act, ("scene_store", TASK), "duplicate", said, bundle=bundle)


@row("robot A", "an old message of its own again, with a new number")
def _(stage):
    act = put("psg/A/task", task(stamp_ns=4), writer="console/a/1", number=9)
    return at_the_service(
        stage, act, ("scene_store", TASK), "malformed", "a replay: stamp_ns", bundle=stage.own.bundle("A")
    )


@row("a program on a host", "a delta numbered above those of who is in charge")
def _(stage):
    epoch = stage.hosts["place_graph"].identity.epoch
    act = put("psg/A/places", places(epoch=epoch + 10))
    return at_the_service(
        stage, act, ("scene_store", PLACE_DELTA), "malformed", "place_graph is in charge of place_graph"
    )


@row("a program on a host", "to name a robot `*`, `x//y` or `fleet`")
def _(stage):
    found = []
    for name in ("*", "x//y", "fleet"):
        act = put("psg/q/places", forged(places(), robot=name))
        found.append(at_the_service(stage, act, ("scene_store", PLACE_DELTA), "malformed", "the robot's name"))
    assert len({happened for happened, _, _ in found}) == 1, found
    return found[-1]


@row("a program on a host", "a prior whose question holds `../`")
def _(stage):
    claim = PriorClaim(question="0" * 32, holder="x", state="wants")
    act = put("psg/fleet/prior_claim/x", forged(claim, question="../../etc/x"))
    return at_the_service(stage, act, ("prior_gateway", PRIOR_CLAIM), "malformed", "cannot be part of a key")


@row("a program on a host", "a prior under the digest of another")
def _(stage):
    act = put(f"psg/fleet/prior/{'0' * 32}", A_PRIOR)
    return at_the_service(stage, act, ("prior_gateway", PRIOR), "malformed", "it came on psg/fleet/prior/000")


@row("robot B", "a flood of its own tasks")
def _(stage):
    def act(end):
        for number in range(3 * TASK.most_at_once):
            put("psg/B/task", task("B", number + 1), writer="flood/b/1", number=number)(end)

    bundle = stage.own.bundle("B")
    return at_the_service(
        stage, act, ("scene_store", TASK), "limited", "too many messages: .*psg/B/task", bundle=bundle
    )


@row("a program on a host", "a keyframe that says it has 30 000 x 30 000 pixels")
def _(stage):
    large = {"width_px": 30_000, "height_px": 30_000, "fx_px": 1.0, "fy_px": 1.0, "cx_px": 1.0, "cy_px": 1.0}
    act = put("psg/A/keyframe", forged(keyframe(), intrinsics=large))
    return at_the_service(stage, act, ("place_graph", KEYFRAME), "malformed", "image size 30000 x 30000")


@row("a program on a host", "a small keyframe whose PNG has 30 000 x 30 000 pixels")
def _(stage):
    host = stage.hosts["place_graph"]
    before_mb = psutil.Process().memory_info().rss / MB
    put("psg/A/keyframe", keyframe(depth=png(30_000, 30_000)))(stage.inside)
    loss = until(lambda: next(iter(host.status().losses), None))
    grown_mb = psutil.Process().memory_info().rss / MB - before_mb
    happened = "not mapped, told as a loss" if grown_mb < 500 else f"DECODED: {grown_mb:.0f} MB"
    return happened, "`health`, and the delta's event", loss.example


def table(folder):
    """All rows, on one stage, as they come."""
    logging.getLogger("prior_sg").setLevel(logging.INFO)
    with mock.patch.object(zenoh_session, "CONNECT_MS", 1500), contextlib.closing(Stage(folder)) as stage:
        for who, tried, does in ROWS:
            yield Row(who, tried, *does(stage))


def main():
    print("| intruder | what is tried | what happens | logged by |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        for one in table(Path(name)):
            said = f": `{one.said.strip()[-140:]}`" if one.said else ""
            print(f"| {one.who} | {one.tried} | {one.happened} | {one.logged}{said} |", flush=True)


if __name__ == "__main__":
    main()
