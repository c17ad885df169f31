"""The scene over HTTP, over a stand-in for a running system."""

import asyncio
import contextlib
import json
import socket
import time

import httpx
import msgspec
import numpy as np
import pytest
from litestar.testing import TestClient

from prior_sg.deploy.benches.queries import synthetic_scene
from prior_sg.deploy.serving import events
from prior_sg.deploy.serving import system as module
from prior_sg.deploy.serving.events import Feed, Feeds
from prior_sg.deploy.serving.gate import Entrance
from prior_sg.deploy.serving.http import http_app
from prior_sg.deploy.serving.system import System
from prior_sg.deploy.showing.export import scene_json
from prior_sg.schemas.codec import decode
from prior_sg.schemas.frames import IngestState
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.topics import INGEST_STATE
from tests.help.homes import marked_home
from tests.help.served import served
from tests.help.store import StandIn

replace = msgspec.structs.replace
SCENE = synthetic_scene(400, 30)
TOKEN = "a-long-secret-of-ours"
V1 = "/v1/bench"


def renamed(scene, label="nursery"):
    """Its first region under another name."""
    return replace(scene, regions=[replace(scene.regions[0], label=label), *scene.regions[1:]])


def relabel(scene, task, digest):
    if task == "impossible":
        return None
    return replace(renamed(scene, f"room to {task}"), task=task, prior_digest=digest)


@contextlib.contextmanager
def opened(entrance=Entrance()):
    """The stand-in, its application, and what ends those who follow changes."""
    store = StandIn(SCENE, relabel)
    system = System(store.open_bus, store.robot)
    feeds = Feeds(system)
    try:
        yield store, http_app(system, feeds, entrance), feeds
    finally:
        system.close()


@contextlib.contextmanager
def client_of(app):
    with TestClient(app, base_url="http://127.0.0.1") as client:
        yield client


@pytest.fixture(scope="module")
def get():
    """JSON of an address, for tests that change nothing."""
    with opened() as (_, app, _), client_of(app) as client:

        def fetched(address, expected=200):
            reply = client.get(address)
            assert reply.status_code == expected, reply.text
            if expected != 200:
                assert reply.headers["content-type"] == "application/problem+json"
                assert reply.json()["status"] == expected and reply.json()["detail"]
            return reply.json()

        yield fetched


def test_a_scene_in_all_its_forms(get):
    with opened() as (_, app, _), client_of(app) as client:
        assert client.get(f"{V1}/scene").json()["regions"]["total"] == len(SCENE.regions)
        assert client.get(f"{V1}/scene.json").json() == json.loads(json.dumps(scene_json(SCENE)))
        assert decode(Scene, client.get(f"{V1}/scene.msgpack").content).unnumbered() == SCENE
        text = client.get(f"{V1}/scene.txt", params={"budget_tokens": 250}).text
        assert text.startswith('Task: "bench"') and "Left out" in text


@pytest.mark.parametrize("form", ["scene", "scene.json", "scene.msgpack", "scene.txt"])
def test_a_scene_is_sent_again_only_when_it_has_changed(form):
    with opened() as (store, app, _), client_of(app) as client:
        first = client.get(f"{V1}/{form}")
        known = {"If-None-Match": f'"other", {first.headers["etag"]}'}
        again = client.get(f"{V1}/{form}", headers=known)
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", first.headers["etag"])
        store.store(renamed(SCENE))
        newer = client.get(f"{V1}/{form}", headers=known)
        assert newer.status_code == 200 and newer.headers["etag"] != first.headers["etag"]
        assert b"nursery" in newer.content


def test_who_asks_for_the_whole_at_once_shares_what_is_written():
    written = []

    def write(scene):
        time.sleep(0.05)
        written.append(scene.robot)
        return b"x"

    async def asked(system):
        tag = await system.tag("bench")
        many = [asyncio.create_task(system.written("bench", f"{tag} {i}", "slow", write)) for i in range(60)]
        return await asyncio.gather(*many), await system.written("bench", "later", "slow", write)

    with opened() as (store, _, _):
        system = System(store.open_bus, store.robot)
        bodies, _ = asyncio.run(asked(system))
        system.close()
    assert bodies == [b"x"] * 60
    assert len(written) == 3  # of the first, of all who came meanwhile, of one who came later


def test_questions_by_address(get):
    assert get("/v1/robots") == ["bench"]
    assert "p-1" in get("/health")["silent"]
    assert get(f"{V1}/regions?limit=2")["answer"]["total"] == len(SCENE.regions)
    assert [one["id"] for one in get(f"{V1}/regions?label=ROOM KIND 1")["answer"]["things"]] == [2]
    assert get(f"{V1}/objects")["answer"]["total"] == 30
    assert get(f"{V1}/regions/2")["candidates"]["beliefs"][0]["label"] == "room kind 1"
    assert get(f"{V1}/regions/2")["neighbours"]["neighbours"]
    assert get(f"{V1}/objects/3")["answer"]["object"]["id"] == 3
    assert get(f"{V1}/places/7")["answer"]["place"]["radius_m"] > 0
    nearest = get(f"{V1}/near?x=1&y=1&z=1&k=3")["answer"]["things"]
    gaps = [thing["distance_m"] for thing in nearest]
    assert len(gaps) == 3 and gaps == sorted(gaps)
    within = get(f"{V1}/within?x=1&y=1&z=1&radius_m={gaps[1]}&what=object")["answer"]["things"]
    assert [one["id"] for one in within] == [one["id"] for one in nearest[:2]]
    assert get(f"{V1}/search?q=room kind 3&k=1")["answer"]["things"][0]["label"] == "room kind 3"
    assert "word by word" in get(f"{V1}/search?q=room")["answer"]["note"]
    assert get(f"{V1}/task")["answer"]["task"] == "bench"
    assert "not kept" in get(f"{V1}/changes?since=9")["answer"]["reason"]
    assert get(f"{V1}/missing")["answer"] == {
        "type": "missing",
        "labels": [],
        "openings": 0,
        "reason": "",
        "total": 0,
    }
    assert "no opening" in get(f"{V1}/unseen?label=room kind 3")["answer"]["reason"]
    assert "knows no region 'hall'" in get(f"{V1}/unseen?label=hall&from=1,1,1")["answer"]["reason"]


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("regions?limit=1", "1 of 4 are listed; limit=4 lists all"),
        ("objects?limit=29", "29 of 30 are listed; limit=30 lists all"),
        ("near?x=1&y=1&z=1", "1 of 30 are listed; k=30 lists all"),
        ("within?x=1&y=1&z=1&radius_m=99&limit=2", "2 of 34 are listed; limit=34 lists all"),
        ("search?q=room&what=region&k=1", "1 of 4 are listed; k=4 lists all"),
        ("regions/2", "10 of 20 are listed; limit=20 lists all"),
        ("regions/2?limit=20", ""),
        ("regions", ""),
        ("task", ""),
    ],
)
def test_what_an_answer_leaves_out_is_told(get, address, said):
    assert get(f"{V1}/{address}")["note"] == said


def test_markers_by_number():
    marked = replace(SCENE, markers=marked_home().markers)
    with opened() as (store, app, _), client_of(app) as client:
        store.store(replace(SCENE, markers=[]))
        assert "no printed marker" in client.get(f"{V1}/markers").json()["answer"]["reason"]
        store.store(marked)
        assert [one["marker"]["id"] for one in client.get(f"{V1}/markers").json()["answer"]["markers"]] == [7, 9]
        assert client.get(f"{V1}/markers?limit=1").json()["note"] == "1 of 2 are listed; limit=2 lists all"
        (found,) = client.get(f"{V1}/markers/7").json()["answer"]["markers"]
        assert found["marker"]["position_m"] == [4.45, 1.0, 1.5] and found["region"]["label"]
        missing = client.get(f"{V1}/markers/8")
        assert missing.status_code == 404 and "there is no marker 8" in missing.json()["detail"]
        assert client.get(f"{V1}/route?from=1,1,1&to=marker:7").json()["answer"]["found"]
        assert "2 spots" in client.get(f"{V1}/route?from=1,1,1&to=marker:9").json()["answer"]["reason"]


def test_routes(get):
    by_point, by_id = get(f"{V1}/route?from=1,1,1&to=room kind 1"), get(f"{V1}/route?from=region:1&to=region:2")
    assert by_point["answer"]["goal"] == by_id["answer"]["goal"] and by_id["answer"]["length_m"] > 4
    assert "garage" in get(f"{V1}/route?from=1,1,1&to=garage")["answer"]["reason"]


FAULTY = [
    (f"{V1}/regions/99", 404, "there is no region 99"),
    (f"{V1}/regions/{2**70}", 400, "64 bits"),
    (f"{V1}/places/x", 404, ""),
    ("/v1/nobody/task", 404, "nothing is stored"),
    ("/v1/%20/task", 400, "the robot's name is empty"),
    ("/v1/fleet/task", 400, "is reserved"),
    ("/nowhere", 404, ""),
    (f"{V1}/near?x=1&y=1", 400, "'z'"),
    (f"{V1}/near?x=1&y=1&z=nan", 400, "z: "),
    (f"{V1}/near?x=1&y=1&z=1e999", 400, "z: "),
    (f"{V1}/near?x=1&y=1&z=1&k=0", 400, "k: "),
    (f"{V1}/near?x=1&y=1&z=1&k=99999999", 400, "k: "),
    (f"{V1}/near?x=1&y=1&z=1&what=house", 400, "what: "),
    (f"{V1}/route?from=1,1&to=room", 400, "an end of a route"),
    (f"{V1}/route?from=nan,1,1&to=room", 400, "an end of a route"),
    (f"{V1}/route?from=1e308,1,1&to=room", 400, "an end of a route"),
    (f"{V1}/search?q=%20", 400, "a text to search for"),
    (f"{V1}/scene.txt?budget_tokens=1", 400, "budget_tokens"),
]


@pytest.mark.parametrize(("address", "expected", "said"), FAULTY)
def test_what_cannot_be_answered_is_told(get, address, expected, said):
    assert said in get(address, expected)["detail"]


def test_any_questions_over_one_revision():
    with opened() as (_, app, _), client_of(app) as client:
        asked = {"questions": [{"type": "nearest", "point_m": [1, 1, 1]}, {"type": "by_label", "label": "room kind 1"}]}
        found = client.post(f"{V1}/query", json=asked).json()
        assert [one["type"] for one in found["answers"]] == ["things", "things"] and found["revision"] == 0
        for faulty in (
            b"",
            b"{",
            b'{"questions": [{"type": "sing"}]}',
            b'{"questions": [{"type": "nearest", "point_m": [1, 1, 1e400]}]}',
            b'{"questions": [], "more": 1}',
            b'{"questions": [{"type": "by_id", "what": "place", "id": 99999999999999999999999}]}',
            json.dumps({"questions": [{"type": "words_in_use"}] * 65}).encode(),
            json.dumps({"questions": [{"type": "by_label", "label": "a", "limit": 10_001}]}).encode(),
            json.dumps({"questions": [{"type": "by_label", "label": "a", "limit": 5_001}] * 2}).encode(),
            json.dumps({"questions": [{"type": "changed_since", "revision": 0}] * 9}).encode(),
            json.dumps({"questions": [{"type": "where_to_look", "label": "a"}] * 9}).encode(),
            json.dumps({"questions": [{"type": "by_label", "label": "a" * 2001}]}).encode(),
            b'{"questions": [{"type": "answers_to", "text": "a", "regions": {"room kind 1": 1e308}}]}',
            b'{"questions": [{"type": "in_radius", "point_m": [1e308, 1, 1], "radius_m": 1, "what": "place"}]}',
            b'{"questions": [{"type": "in_radius", "point_m": [1, 1, 1], "radius_m": 1e308, "what": "place"}]}',
            b'{"questions": ' + b"[" * 200_000,
        ):
            assert client.post(f"{V1}/query", content=faulty).status_code == 400, faulty
        assert client.post(f"{V1}/query", content=b" " * (5 * 2**20)).status_code == 413


def test_a_task_is_switched():
    with opened() as (store, app, _), client_of(app) as client:
        taken = client.put(f"{V1}/task", json={"task": "  paint  walls ", "wait_s": 5})
        assert taken.status_code == 200 and "room to paint walls" in taken.json()["labels"]
        assert client.get(f"{V1}/task").json()["answer"]["task"] == store.tasks[0].task == "paint walls"
        assert taken.json()["may_be"] == ["kitchen", "hall"] and taken.json()["note"] == ""
        late = client.put(f"{V1}/task", json={"task": "impossible", "wait_s": 0.2})
        assert late.status_code == 202 and late.json()["prior_digest"] and "no regions" in late.json()["note"]
        for faulty in (
            {},
            {"task": ""},
            {"task": " "},
            {"task": "a\x1b"},
            {"task": "a" * 3000},
            {"task": "a", "wait_s": 1e9},
        ):
            assert client.put(f"{V1}/task", json=faulty).status_code == 400, faulty  # fmt: skip


def test_while_the_source_is_read_a_task_says_that_the_map_grows():
    with opened() as (store, app, _), client_of(app) as client:
        assert client.get(f"{V1}/source").status_code == 404
        read = IngestState(
            robot=store.robot,
            stamp_ns=1,
            frames_read=30,
            frames_total=86,
            keyframes=30,
            encoded=20,
            rejected=0,
            finished=False,
        )
        store.bus.publish(INGEST_STATE, read)
        assert client.get(f"{V1}/source").json() == {
            "robot": store.robot,
            "frames_read": 30,
            "frames_total": 86,
            "encoded": 20,
            "finished": False,
        }
        assert "30 of 86 frames" in client.put(f"{V1}/task", json={"task": "sweep"}).json()["note"]
        store.bus.publish(INGEST_STATE, replace(read, finished=True))
        assert client.put(f"{V1}/task", json={"task": "mop"}).json()["note"] == ""


def test_a_body_that_is_missing_is_told():
    with opened() as (_, app, _), client_of(app) as client:
        assert "the body is missing" in client.put(f"{V1}/task").json()["detail"]
        assert client.put(f"{V1}/task", json=[]).json()["detail"].startswith("the body: Expected `object`")


def test_poses_are_corrected():
    with opened() as (store, app, _), client_of(app) as client:
        pose = np.eye(4).tolist()
        taken = client.post(f"{V1}/poses", json={"poses": [{"frame": 3, "world_from_camera": pose}]})
        assert taken.status_code == 200 and store.poses[0].frame_ids.tolist() == [3]
        broken = client.post(
            f"{V1}/poses", json={"poses": [{"frame": 3, "world_from_camera": np.zeros((4, 4)).tolist()}]}
        )
        assert broken.status_code == 422 and "cannot be used" in broken.json()["detail"]
        twice = client.post(f"{V1}/poses", json={"poses": [{"frame": 3, "world_from_camera": pose}] * 2})
        assert twice.status_code == 400 and len(store.poses) == 1


def test_asking_for_many_robots_leaves_nothing_on_the_bus(monkeypatch):
    monkeypatch.setattr(module, "MOST_ROBOTS", 1)
    with opened() as (store, app, _), client_of(app) as client:
        for _ in range(3):
            assert client.get("/health").status_code == 200
            assert [client.get(f"/v1/{name}/task").status_code for name in ("nobody", "noone")] == [404, 404]
        assert len(store.hub.watchers) == 1


def test_without_a_system_it_says_so():
    with opened() as (store, app, _), client_of(app) as client:
        store.bus.bus.close()
        for reply in (client.get(f"{V1}/scene"), client.put(f"{V1}/task", json={"task": "paint"})):
            assert reply.status_code == 503 and "is the service running" in reply.json()["detail"]


def test_a_token_is_asked_for_on_everything():
    with opened(Entrance("127.0.0.1", TOKEN)) as (store, app, _), client_of(app) as client:
        assert client.get(f"{V1}/scene").status_code == 401
        assert client.put(f"{V1}/task", json={"task": "paint"}).status_code == 401 and not store.tasks
        assert client.post(f"{V1}/poses", json={}).status_code == 401
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        assert client.put(f"{V1}/task", json={"task": "paint", "wait_s": 5}, headers=bearer).status_code == 200
        described = client.get("/openapi/openapi.json", headers=bearer).json()
        assert described["components"]["securitySchemes"]["bearer"]["scheme"] == "bearer"


@contextlib.contextmanager
def following(address, last=None):
    """Lines of the stream; they are read through one iterator, whose end is that of the connection."""
    headers = {} if last is None else {"Last-Event-ID": str(last)}
    with httpx.stream("GET", f"{address}{V1}/events", headers=headers, timeout=10) as reply:
        yield reply.iter_lines()


def events_of(lines, count):
    """So many events, as (name, id, data); comments do not count."""
    found, fields = [], {}
    for line in lines:
        if line.startswith((":", "retry")):
            continue
        if line:
            name, _, value = line.partition(": ")
            fields[name] = value
        elif fields:
            found.append((fields["event"], int(fields["id"]), json.loads(fields["data"])))
            fields = {}
            if len(found) == count:
                return found
    return found


def test_changes_are_followed_and_resumed(monkeypatch):
    monkeypatch.setattr(events, "PERIOD_S", 0.01)
    with opened() as (store, app, feeds), served(app, feeds.close) as address:
        with following(address) as lines, following(address) as others:
            ((name, number, data),) = events_of(lines, 1)
            assert (name, number, data["scene"]["task"]) == ("snapshot", 0, "bench")
            store.store(renamed(SCENE))
            ((name, number, data),) = events_of(lines, 1)
            assert (name, number, data["renamed"][0]["former_label"]) == ("changes", 1, "room kind 0")
            store.store(SCENE)
            assert [number for _, number, _ in events_of(others, 3)] == [0, 1, 2]
        with following(address, last=0) as lines:
            assert [(name, n) for name, n, _ in events_of(lines, 2)] == [("changes", 1), ("changes", 2)]
        with following(address, last=2) as lines:
            assert next(lines).startswith(": nothing new")
            store.store(renamed(SCENE))
            assert events_of(lines, 1)[0][:2] == ("changes", 3)
        store.forgotten.update(range(10))
        with following(address, last=9) as lines:
            ((name, number, data),) = events_of(lines, 1)
            assert (name, number) == ("snapshot", 3) and "revision 9 is not kept" in data["reason"]
        assert httpx.get(f"{address}{V1}/events", headers={"Last-Event-ID": "x"}).status_code == 400
        assert httpx.get(f"{address}/v1/nobody/events").status_code == 404
        with following(address) as lines:  # an open connection does not keep the server from ending
            assert events_of(lines, 1)


def test_a_client_that_leaves_within_its_request_is_no_fault(caplog):
    with opened() as (_, app, feeds), served(app, feeds.close) as address:
        host, port = address.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port))) as connection:
            connection.sendall(f"POST {V1}/query HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n{{".encode())
        assert httpx.get(f"{address}/v1/robots").status_code == 200
    assert "a request failed" not in caplog.text


def test_who_comes_at_once_shares_one_watcher():
    async def followed():
        feed = Feed(system, "bench")
        both = [feed.follow(None) for _ in range(2)]
        await asyncio.gather(*map(anext, both))
        return len(asyncio.all_tasks()) - 1

    with opened() as (store, _, _):
        system = System(store.open_bus, store.robot)
        assert asyncio.run(followed()) == 1


def test_what_came_while_nobody_followed_is_told(monkeypatch):
    monkeypatch.setattr(events, "PERIOD_S", 0.0)

    async def followed():
        feed = Feed(system, "bench")
        first = feed.follow(None)
        await anext(first)
        store.store(renamed(SCENE))
        feed.wake()
        await first.aclose()
        await feed._pump
        store.store(SCENE)
        resumed = feed.follow(0)
        return [(await anext(resumed)).revision for _ in range(2)]

    with opened() as (store, _, _):
        system = System(store.open_bus, store.robot)
        assert asyncio.run(asyncio.wait_for(followed(), 10)) == [1, 2]


def test_followers_are_bounded(monkeypatch):
    monkeypatch.setattr(events, "MOST_FOLLOWERS", 1)
    with opened() as (_, app, feeds), served(app, feeds.close) as address, following(address) as lines:
        assert events_of(lines, 1)
        refused = httpx.get(f"{address}{V1}/events")
        assert refused.status_code == 429 and "follow changes already" in refused.json()["detail"]
