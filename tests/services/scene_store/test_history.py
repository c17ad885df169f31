"""History: at every revision what a replay of the deltas up to there gives, in both databases; how it is thinned."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.schemas.codec import encode
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.schemas.priors import Task
from prior_sg.schemas.scene import HistoryRequest
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import HISTORY
from prior_sg.services.runtime.config import ConfigError, resolve
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core import keeping, telling
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.core.image import graph_of, image_of
from prior_sg.services.scene_store.database import Database
from prior_sg.services.scene_store.storage.tables import StoreAway, StoreError
from tests.help.databases import new_database
from tests.services.scene_store.test_scene_store import (
    ROBOT,
    Store,
    content,
    place_delta,
    random_run,
    region_delta,
    snapshots_of,
)


def object_delta(revision, count, **fields):
    items = [
        SceneObject(
            id=i,
            label=("kitchen table", "bed", "Küchen-Stuhl")[i % 3],
            probability=0.5,
            known=0.5,
            position_m=(i, revision, 0.5),
            min_m=(i - 0.5, revision - 0.5, 0.0),
            max_m=(i + 0.5, revision + 0.5, 1.0),
            frames=1,
        )
        for i in range(count)
    ]
    head = {"robot": ROBOT, "epoch": 1, "revision": revision, "stamp_ns": 1000 * revision, "prior_digest": "d"}
    return ObjectDelta(objects=items, removed_ids=np.zeros(0, np.int64), **head, **fields)


def whole_run(seed, steps):
    """Deltas of all writers; in the middle a new place graph, a snapshot, a gap that closes late, and tasks."""
    deltas = random_run(seed, steps)[0]
    full = Store()
    full.feed(*deltas)
    snapshots = snapshots_of(full, steps + 2, steps + 2)
    objects = [object_delta(i, i + 1) for i in range(3)]
    tasks = [Task(robot=ROBOT, stamp_ns=t, environment="flat", task=f"task {t}") for t in (5, 9)]
    late = [
        place_delta(steps + 4, [(1, 0, 0, 0, 2)], camera_m=(9.0, 9.0, 9.0)),
        place_delta(steps + 3, [(2, 0, 0, 0, 2)], camera_m=(8.0, 8.0, 8.0)),
        place_delta(0, [(7, 1, 1, 1, 1), (8, 1, 1, 1, 1)], [(7, 8, 0.5)], epoch=2, camera_m=(1.0, 2.0, 3.0)),
        region_delta(steps + 3, [(7, 3, [1, 0, 0], 0)], [(3, "hall", 1)], labels=["a", "b", "c"]),
    ]
    half = len(deltas) // 2
    return [tasks[0], *deltas[:half], objects[0], tasks[1], *deltas[half:], objects[1], *snapshots, *late, objects[2]]


@pytest.mark.parametrize("seed", range(2))
def test_history_at_every_revision_is_what_the_store_answered_then(place, seed, monkeypatch):
    monkeypatch.setattr(keeping, "LEAST_WEIGHT", 4000)  # so that there are several snapshots
    store, told, stamps = Store(place), {}, {}
    for i, message in enumerate(whole_run(seed, steps=12)):
        store.feed(message, *([Tick(stamp_ns=i)] if i % 5 == 0 else []))
        scene = store.scene()
        told[scene.revision], stamps[scene.revision] = encode(scene), scene.stamp_ns
    del told[-1], stamps[-1]
    store = store.reopened()
    key = store.state.database.storage.robots()[ROBOT]
    assert len(store.state.database.storage.marks(key)) > 2
    rng = np.random.default_rng(seed)
    for revision in [*told, *rng.permutation(sorted(told)).tolist()]:
        assert encode(store.scene(revision=revision)) == told[revision]
    for stamp_ns in {*stamps.values(), *(stamp + 1 for stamp in stamps.values())}:
        newest = max(revision for revision, stamp in stamps.items() if stamp <= stamp_ns)
        assert encode(store.scene(stamp_ns=stamp_ns)) == told[newest]
    listed = store.runner.answer(HISTORY, HistoryRequest(robot=ROBOT)).revisions
    assert [row.revision for row in listed] == list(range(max(told) + 1))  # one gap closed with two at once
    assert len(told) == len(listed) - 1
    assert all(row.stamp_ns == stamps.get(row.revision, row.stamp_ns) for row in listed)
    assert {row.kind for row in listed} == {"place", "region", "object"} and {row.session for row in listed} == {7}
    store.runner.close()


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), cut=st.integers(0, 40))
def test_a_graph_is_its_image(seed, cut):
    store = Store()
    store.feed(*whole_run(seed, steps=8)[:cut])
    graph = store.state.robots[ROBOT].graph if store.state.robots else core.Graph(ROBOT)
    again = graph_of(image_of(graph))
    assert encode(image_of(again)) == encode(image_of(graph))
    assert encode(telling.scene(again)) == encode(telling.scene(graph))
    for name in ("places", "edges", "neighbours", "sightings", "regions", "objects", "alignment", "task", "origin_m"):
        if name != "neighbours":
            assert getattr(again, name) == getattr(graph, name)
    linked = {place: others for place, others in graph.neighbours.items() if others}
    assert again.neighbours == linked


def test_what_is_asked_before_the_first_and_beyond_the_last(place):
    store = Store(place)
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]), place_delta(1, [(2, 0, 0, 0, 1)]))
    assert store.scene(revision=10**9).revision == 1 and store.scene(stamp_ns=2**63 - 1).revision == 1
    assert store.scene(revision=-5).revision == -1 and store.scene(stamp_ns=999).revision == -1
    assert store.scene(revision=1, stamp_ns=1500).revision == 0
    assert store.scene("nobody", revision=0).revision == -1
    store.runner.close()


def fed(place, seconds, **kept):
    """One place delta a second, a snapshot whenever there is time."""
    store = Store(place, **kept)
    for i in range(seconds):
        delta = place_delta(i, [(j, i, 0, 0, 1) for j in range(20)], stamp_ns=int(1e9 * i))
        store.feed(delta, *([Tick(stamp_ns=i)] if i % 3 == 2 else []))
    return store


def served(store):
    """Revisions that are listed; each must be given as it was."""
    listed = [row.revision for row in store.state.database.history(ROBOT)]
    for revision in listed:
        scene = store.scene(revision=revision)
        assert scene.revision == revision and scene.positions_m[0, 0] == revision
    return listed


def test_old_history_is_thinned_as_the_setting_says_but_never_the_present(place, monkeypatch):
    monkeypatch.setattr(keeping, "LEAST_WEIGHT", 10)
    monkeypatch.setattr(keeping, "EVENT_WEIGHT", 5000)
    store = fed(place, 60, history="sampled", history_last=10, history_every_s=20.0)
    listed = served(store)
    assert set(range(50, 60)) <= set(listed) and len(listed) <= 10 + 3 + 5
    old = [revision for revision in listed if revision < 47]
    assert [revision // 20 for revision in old] == sorted({revision // 20 for revision in old}) and len(old) >= 2
    store = store.reopened(history="last", history_last=10)
    store.feed(*[place_delta(i, [(0, i, 0, 0, 1)], stamp_ns=int(1e9 * i)) for i in range(60, 63)], Tick(stamp_ns=0))
    listed = served(store)
    assert listed == list(range(listed[0], 63)) and 50 < listed[0] <= 53
    present = encode(store.scene())
    store = store.reopened(history="last", history_last=0)
    assert encode(store.scene()) == present
    store.feed(place_delta(63, [(0, 63, 0, 0, 1)], stamp_ns=int(63e9)), Tick(stamp_ns=0))
    assert served(store) == [63]
    assert encode(store.reopened().scene()) != present


def test_all_is_kept_by_default(tmp_path, monkeypatch):
    monkeypatch.setattr(keeping, "LEAST_WEIGHT", 10)
    store = fed(tmp_path / "scene.sqlite", 30)
    assert served(store) == list(range(30))


MARKS = [keeping.Mark(sequence=10 * i, revision=10 * i - 1, session=1, stamp_ns=int(30e9 * i)) for i in range(1, 11)]


@pytest.mark.parametrize(
    ("settings", "present", "expected"),
    [
        ({"history": "all"}, 120, None),
        ({"history": "last", "history_last": 1000}, 120, None),
        ({"history": "last", "history_last": 50}, 120, keeping.Thinned(70, [10, 20, 30, 40, 50, 60])),
        ({"history": "last", "history_last": 0}, 99, keeping.Thinned(100, [10, 20, 30, 40, 50, 60, 70, 80, 90])),
        ({"history": "sampled", "history_last": 50}, 120, keeping.Thinned(70, [20, 40])),
        ({"history": "sampled", "history_last": 50, "history_every_s": 1e9}, 120, keeping.Thinned(70, MARKS[:5])),
    ],
)
def test_what_goes(settings, present, expected):
    found = keeping.thinned(Config(**settings), MARKS, present)
    if expected is not None and expected.snapshots == MARKS[:5]:
        expected = keeping.Thinned(70, [10, 20, 30, 40, 50])
    assert found == expected


def test_reading_a_revision_costs_at_most_about_two_snapshots():
    """Events since a snapshot never weigh more than it did, but for what is held back for a quiet moment."""
    store = Store()
    for revision in range(300):
        rng = np.random.default_rng(revision)
        rows = [(int(place), *rng.normal(size=4)) for place in rng.integers(0, 500, 40)]
        store.feed(place_delta(revision, rows), Tick(stamp_ns=revision))
        standing = store.state.database._standings[ROBOT]
        assert standing.weight <= max(standing.snapshot_bytes, keeping.LEAST_WEIGHT) + 4000
    storage = store.state.database.storage
    sizes = [storage.run(f"SELECT sum(length(payload)) FROM {table}")[0][0] for table in ("events", "snapshots")]
    assert sizes[1] < sizes[0]  # snapshots at most double what is kept


def test_two_robots_and_two_sessions_in_one_place(place):
    store = Store(place)
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]), place_delta(0, [(1, 5, 0, 0, 1)], robot="other"))
    store.runner.close()
    from prior_sg.services.runtime.runner import Runner
    from prior_sg.services.runtime.service import Identity
    from prior_sg.services.scene_store import service

    with Runner(service.SERVICE, store.cfg, Identity("*", "b", 8), wire=True) as runner:
        runner.feed(place_delta(1, [(2, 0, 0, 0, 1)]), place_delta(0, [(9, 5, 0, 0, 1)], robot="other", epoch=2))
    store = store.reopened()
    assert [(row.revision, row.session) for row in store.state.database.history(ROBOT)] == [(0, 7), (1, 8)]
    assert store.scene("other", revision=0).place_ids.tolist() == [1] and store.scene("other").place_ids.tolist() == [9]
    assert [found.id for found in store.state.database.nearest("other", "place", (0, 0, 0), 5)] == [9]
    assert store.state.database.nearest("nobody", "place", (0, 0, 0), 5) == []
    store.runner.close()


def test_a_second_connection_reads_while_the_first_writes(place):
    store = Store(place)
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]))
    reader = Database(store.cfg, read_only=True)
    store.feed(place_delta(1, [(2, 0, 0, 0, 1)]))
    assert sorted(reader.at(ROBOT).places) == [1, 2] and sorted(reader.at(ROBOT, revision=0).places) == [1]
    with pytest.raises(StoreError, match="cannot be read or written"):
        reader.put_task(core.Graph(ROBOT), Task(robot=ROBOT, stamp_ns=1, environment="e", task="t"))
    reader.close()
    store.runner.close()


def test_a_full_disk_costs_nothing_that_was_committed(tmp_path):
    store = Store(str(tmp_path / "scene.sqlite"))
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]))
    pages = store.state.database.storage.run("PRAGMA page_count")[0][0]
    store.state.database.storage.run(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StoreAway, match=r"disk is full\); free the disk: the store then goes on"):
        for revision in range(1, 200):
            store.feed(place_delta(revision, [(revision + 1, revision, 0, 0, 1)]))
    store = store.reopened()
    assert len(store.scene(ROBOT).place_ids) == revision
    store.feed(place_delta(revision, [(revision + 1, revision, 0, 0, 1)]))
    assert len(store.scene(ROBOT).place_ids) == revision + 1
    store.runner.close()


def test_a_server_that_has_gone_is_one_that_can_come_back(postgres):
    store = Store(new_database(postgres))
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]))
    store.state.database.storage.connection.close()
    with pytest.raises(StoreAway, match="start the server"):
        store.feed(place_delta(1, [(2, 0, 0, 0, 1)]))


def brute_nearest(entries, point_m, count):
    away = {number: np.sum((np.array(entry.position_m) - point_m) ** 2) for number, entry in entries.items()}
    return sorted(away, key=lambda number: (away[number], number))[:count]


def brute_overlapping(boxes, low_m, high_m):
    return [
        number
        for number, (low, high) in sorted(boxes.items())
        if all(a <= d and b >= c for a, b, c, d in zip(low, high, low_m, high_m, strict=True))
    ]


def test_the_index_answers_as_a_search_through_everything(place):
    rng = np.random.default_rng(5)
    store = Store(place)
    centres = rng.uniform(-20, 20, (300, 3)).astype(np.float32).tolist()
    store.feed(
        place_delta(0, [(i, *xyz, 0.1 + i % 7) for i, xyz in enumerate(centres)]),
        place_delta(0, [(i, 0, 0, 0, 1) for i in range(50)], robot="other"),
        place_delta(1, [(3, 1, 2, 3, 1.5)], removed_ids=range(10, 60)),
        object_delta(0, 40),
        object_delta(1, 30),
        region_delta(0, regions=[(1, "hall", 2), (2, "living_room", 2), (3, "Hallway 2", 1)]),
        region_delta(1, regions=[(2, "bath room", 2)], removed_ids=[1]),
    )
    database, graph = store.state.database, store.state.robots[ROBOT].graph
    spheres = {
        number: ([c - at.radius_m for c in at.position_m], [c + at.radius_m for c in at.position_m])
        for number, at in graph.places.items()
    }
    boxes = {number: (entry.min_m, entry.max_m) for number, entry in graph.objects.items()}
    for kind, entries, limits in (("place", graph.places, spheres), ("object", graph.objects, boxes)):
        for _ in range(40):
            point, size = rng.uniform(-30, 30, 3), rng.uniform(0, 10, 3)
            found = [one.id for one in database.nearest(ROBOT, kind, tuple(point.tolist()), 7)]
            assert found == brute_nearest(entries, point, 7)
            low, high = tuple((point - size).tolist()), tuple((point + size).tolist())
            assert [one.id for one in database.overlapping(ROBOT, kind, low, high)] == brute_overlapping(
                limits, low, high
            )
    assert len(database.nearest(ROBOT, "place", (0, 0, 0), 1000)) == len(graph.places)
    found = database.labelled(ROBOT, "region", "hall")
    assert [(one.id, one.label, one.position_m) for one in found] == [(3, "Hallway 2", graph.regions[3].position_m)]
    assert [one.id for one in database.labelled(ROBOT, "region", "ROOM ba")] == [2]
    assert database.labelled(ROBOT, "region", "living") == database.labelled(ROBOT, "region", "' & | \" * !") == []
    chairs = [number for number, entry in graph.objects.items() if "Stuhl" in entry.label]
    assert [one.id for one in database.labelled(ROBOT, "object", "küchen")] == chairs
    store.runner.close()


def test_absurd_labels_end_no_store(place):
    store = Store(place)
    labels = ["a\0b", "w" * 5000 + " x", " ".join(f"w{i}" for i in range(3000)), "", "_", "😀'\"\\;--"]
    store.feed(region_delta(0, regions=[(i, label, 1) for i, label in enumerate(labels)]))
    assert [region.label for region in store.reopened().scene().regions] == labels
    assert [one.id for one in store.reopened().state.database.labelled(ROBOT, "region", "w" * 70)] == [1]


def test_a_password_stays_out_of_settings_and_messages():
    for url in ("postgresql://me:secret@host/db", "postgres://host/db?user=me&password=secret"):
        with pytest.raises(ConfigError, match="PGPASSWORD") as caught:
            resolve(Config, "scene_store", {"scene_store": {"path": url}})
        assert "secret" not in str(caught.value)
    with pytest.raises(StoreError, match="cannot be reached") as caught:
        Database(Config(path="postgresql://me@127.0.0.1:1/db"))
    assert "postgresql://127.0.0.1:1/db" in str(caught.value) and "\n" not in str(caught.value)


def test_two_stores_on_one_file_destroy_nothing(tmp_path):
    first = Store(tmp_path / "scene.sqlite")
    second = Store(tmp_path / "scene.sqlite")
    first.feed(place_delta(0, [(1, 0, 0, 0, 1)]))
    with pytest.raises(StoreError, match="written by another scene_store"):
        second.feed(place_delta(0, [(2, 0, 0, 0, 1)]))
    assert first.reopened().scene().place_ids.tolist() == [1]


def test_an_event_of_no_kind_is_told(tmp_path):
    store = Store(tmp_path / "scene.sqlite")
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]))
    store.state.database.storage.run("UPDATE events SET kind = 'song'")
    with pytest.raises(StoreError, match="of unknown kind"):
        store.reopened()


def test_only_one_store_writes_to_a_server(postgres):
    url = new_database(postgres)
    with pytest.raises(StoreError, match="holds no scenes"):
        Database(Config(path=url), read_only=True)
    store = Store(url)
    with pytest.raises(StoreError, match="written by another scene_store"):
        Database(Config(path=url, busy_timeout_ms=50))
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]))
    assert content(store.reopened().scene()) and msgspec.structs.asdict(store.cfg)["path"] == url
