"""Scene store: deltas in, durable scene out, compared with plain dictionaries kept beside."""

import os
import signal
import sqlite3
import subprocess
import sys
import time

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import ObjectPrior, Prior, Provenance, RegionPrior, Task, TaskRequest
from prior_sg.schemas.regions import Region, RegionDelta, Transition
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.status import EpochRequest, Tick
from prior_sg.schemas.topics import (
    DELTAS,
    EPOCH,
    OBJECT_SNAPSHOT,
    PLACE_SNAPSHOT,
    REGION_SNAPSHOT,
    SCENE,
    SCENE_REVISION,
    TASK_IN_FORCE,
)
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Ask, Identity
from prior_sg.services.scene_store import service
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core import telling
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.database import Database
from prior_sg.services.scene_store.storage.sqlite import APPLICATION_ID
from prior_sg.services.scene_store.storage.tables import StoreError
from tests.help.paths import ROOT
from tests.services.scene_store.former import SCENE as SCENE_OF_LAYOUT_5
from tests.services.scene_store.former import write_layout_5

ROBOT = "spot"
LABELS = ["kitchen", "hall", "office"]
IDENTITY = Identity(robot="*", instance="a", epoch=7)


def place_delta(revision, places=(), edges=(), *, robot=ROBOT, epoch=1, **fields):
    """places: (id, x, y, z, radius); edges: (a, b, clearance)."""
    rows = np.array(places, np.float32).reshape(-1, 5)
    links = np.array(edges, np.float32).reshape(-1, 3)
    pairs = {"merged_ids", "removed_edges"}
    arrays = {
        name: np.array(fields.pop(name, []), np.int64).reshape((-1, 2) if name in pairs else -1)
        for name in ("removed_ids", "merged_ids", "removed_edges")
    }
    defaults = {"stamp_ns": 1000 * (revision + 1), "frame_id": revision}
    return PlaceDelta(
        robot=robot,
        epoch=epoch,
        revision=revision,
        place_ids=np.array([row[0] for row in places], np.int64),
        positions_m=rows[:, 1:4],
        radii_m=rows[:, 4],
        basis_points=np.full(len(rows), 2, np.int16),
        edges=np.array([link[:2] for link in edges], np.int64).reshape(-1, 2),
        clearances_m=links[:, 2],
        **arrays,
        **(defaults | fields),
    )


def region_delta(revision, beliefs=(), regions=(), *, labels=LABELS, epoch=1, **fields):
    """beliefs: (place, region, posterior, unknown); regions: (id, label, number of places)."""
    arrays = {name: np.array(fields.pop(name, []), np.int64) for name in ("removed_ids", "removed_place_ids")}
    defaults = {"robot": ROBOT, "stamp_ns": 1000 * (revision + 1) + 500, "environment": "flat", "task": "clean"}
    return RegionDelta(
        epoch=epoch,
        revision=revision,
        prior_digest="d",
        space="s",
        labels=list(labels),
        regions=[
            Region(id=i, label=label, place_count=n, probability=0.75, position_m=(i + 0.1, 0.0, 1.0), area_m2=2.5)
            for i, label, n in regions
        ],
        place_ids=np.array([row[0] for row in beliefs], np.int64),
        place_regions=np.array([row[1] for row in beliefs], np.int64),
        posteriors=np.array([row[2] for row in beliefs], np.float16).reshape(-1, len(labels)),
        unknown=np.array([row[3] for row in beliefs], np.float16),
        energy=-1.5,
        **arrays,
        **(defaults | fields),
    )


def received(message):
    """As it arrives: through bytes, arrays read-only."""
    return decode(type(message), encode(message))


class Store:
    """A store driven by hand, on a file or in memory; it survives a killed process, not a power cut."""

    def __init__(self, path=":memory:", **settings):
        self.cfg = Config(path=str(path), **{"synchronous": "normal", **settings})
        self.runner = Runner(service.SERVICE, self.cfg, IDENTITY, wire=True)
        self.state = self.runner.state

    def feed(self, *messages):
        """What it publishes and what it asks."""
        self.runner.asks.clear()
        return [*self.runner.feed(*messages), *self.runner.asks]

    def scene(self, robot=ROBOT, **when):
        return self.runner.answer(SCENE, SceneRequest(robot=robot, **when))

    def reopened(self, **settings):
        self.runner.close()
        return Store(**{**msgspec.structs.asdict(self.cfg), **settings})


def content(scene):
    """The bytes of a scene, whatever its revision."""
    return encode(scene.unnumbered())


def asked(outputs):
    return [output.query for output in outputs if isinstance(output, Ask)]


def revisions(outputs):
    return [output[1] for output in outputs if not isinstance(output, Ask) and output[0] is SCENE_REVISION]


def edge_list(scene):
    return [
        (*edge, clearance) for edge, clearance in zip(scene.edges.tolist(), scene.clearances_m.tolist(), strict=True)
    ]


def random_run(seed, steps=60):
    """A plausible stream of both writers and, kept separately as plain dictionaries, what must come of it."""
    rng = np.random.default_rng(seed)
    places, edges, beliefs, regions, out = {}, {}, {}, {}, []
    next_id = 0
    for revision in range(steps):
        gone_edges = [edge for edge in sorted(edges) if rng.random() < 0.1]
        gone = [place for place in sorted(places) if rng.random() < 0.05]
        for edge in gone_edges:
            edges.pop(edge)
        for place in gone:
            places.pop(place)
        edges = {edge: c for edge, c in edges.items() if edge[0] in places and edge[1] in places}
        fresh = {next_id + i: None for i in range(rng.integers(0, 5))}
        next_id += len(fresh)
        touched = {place: tuple(np.float32(rng.normal(size=4)).tolist()) for place in [*fresh, *list(places)[:2]]}
        places.update(touched)
        ids = sorted(places)
        pairs = [rng.choice(ids, 2, replace=False).tolist() for _ in range(4)] if len(ids) > 1 else []
        links = {(min(a, b), max(a, b)): float(np.float32(rng.random())) for a, b in pairs}
        edges.update(links)
        out.append(
            place_delta(
                revision,
                [(place, *values) for place, values in touched.items()],
                [(*edge, clearance) for edge, clearance in links.items()],
                removed_ids=gone,
                removed_edges=gone_edges,
                camera_m=tuple(np.float32(rng.normal(size=3)).tolist()),
            )
        )
        changed = {place: (int(rng.integers(0, 4)), rng.dirichlet(np.ones(3)).astype(np.float16)) for place in ids[-3:]}
        for place in gone:
            beliefs.pop(place, None)
        beliefs.update(changed)
        entry = (int(rng.integers(0, 4)), LABELS[int(rng.integers(0, 3))], int(rng.integers(1, 9)))
        dropped = [region for region in sorted(regions) if rng.random() < 0.1]
        for region in dropped:
            regions.pop(region)
        regions[entry[0]] = entry
        rows = [(place, region, posterior, 0.25) for place, (region, posterior) in changed.items()]
        out.append(region_delta(revision, rows, [entry], removed_ids=dropped, removed_place_ids=gone))
    return out, places, edges, beliefs, regions


def snapshots_of(store, place_revision, region_revision):
    """What the two writers would answer at these revisions, taken from a store that has seen all."""
    scene = store.scene()
    graph = store.state.robots[ROBOT].graph
    places = place_delta(
        place_revision,
        [(i, *p.position_m, p.radius_m) for i, p in graph.places.items()],
        edge_list(scene),
        snapshot=True,
        past_frame_ids=np.array(sorted(graph.sightings), np.int64),
        past_cameras_m=scene.trajectory,
    )
    regions = region_delta(
        region_revision,
        [(i, b.region, b.posterior, b.unknown) for i, b in graph.beliefs.items()],
        [(r.id, r.label, r.place_count) for r in graph.regions.values()],
        snapshot=True,
    )
    return places, regions


@pytest.mark.parametrize("seed", range(5))
def test_scene_equals_a_plain_model(seed):
    deltas, places, edges, beliefs, regions = random_run(seed)
    store = Store()
    outputs = store.feed(*deltas)
    scene = store.scene()
    assert len(revisions(outputs)) == len(deltas)
    assert [r.revision for r in revisions(outputs)] == list(range(len(deltas)))
    assert scene.place_ids.tolist() == sorted(places)
    assert np.array_equal(np.c_[scene.positions_m, scene.radii_m], np.float32([places[i] for i in sorted(places)]))
    assert edge_list(scene) == [(*edge, edges[edge]) for edge in sorted(edges)]
    assert [(r.id, r.label, r.place_count) for r in scene.regions] == [regions[i] for i in sorted(regions)]
    for row, place in enumerate(sorted(places)):
        region, posterior = beliefs.get(place, (-1, np.zeros(3)))
        assert scene.place_regions[row] == region
        assert np.array_equal(scene.posteriors[row], posterior)
        assert scene.unknown[row] == (0.25 if place in beliefs else 1.0)
    assert scene.trajectory.tolist() == [list(delta.camera_m) for delta in deltas[::2]]
    last = revisions(outputs)[-1]
    assert (last.places, last.edges, last.regions, last.epoch) == (len(places), len(edges), len(regions), 7)


def test_order_of_the_two_writers_does_not_matter():
    deltas = random_run(3)[0]
    one, other = Store(), Store()
    one.feed(*deltas)
    other.feed(*deltas[1::2], *deltas[0::2])
    assert encode(one.scene()) == encode(other.scene())


@pytest.mark.parametrize("cut", [1, 20, 77, 119])
def test_resumes_from_the_file_and_equals_an_undisturbed_run(tmp_path, cut):
    deltas = random_run(1)[0]
    whole, store = Store(), Store(tmp_path / "scene.sqlite")
    whole.feed(*deltas)
    store.feed(*deltas[:cut])
    before = encode(store.scene())
    store = store.reopened()
    assert encode(store.scene()) == before
    outputs = store.feed(*deltas[max(0, cut - 4) :])  # at least once: some come again
    assert [r.revision for r in revisions(outputs)] == list(range(cut, len(deltas)))
    assert encode(store.scene()) == encode(whole.scene())
    assert encode(store.reopened().scene()) == encode(whole.scene())


def test_missed_deltas_are_made_up_by_snapshots(tmp_path):
    deltas = random_run(2)[0]
    whole, store = Store(), Store(tmp_path / "scene.sqlite")
    whole.feed(*deltas[:100])
    store.feed(*deltas[:30])
    store = store.reopened()
    assert asked(store.feed(Tick(stamp_ns=1))) == [PLACE_SNAPSHOT, REGION_SNAPSHOT, OBJECT_SNAPSHOT]
    assert asked(store.feed(Tick(stamp_ns=2))) == []
    outputs = store.feed(*deltas[90:100])  # a gap: they wait, and the host is asked again (it knows the question)
    assert set(asked(outputs)) == {PLACE_SNAPSHOT, REGION_SNAPSHOT} and not revisions(outputs)
    at_92 = Store()
    at_92.feed(*deltas[:92])
    outputs = store.feed(*snapshots_of(at_92, 45, 45))
    assert not asked(outputs) and len(revisions(outputs)) == 2 + 8
    assert content(store.scene()) == content(whole.scene())
    whole.feed(*deltas[100:])
    assert not asked(store.feed(*deltas[100:]))
    assert content(store.scene()) == content(whole.scene())
    assert content(store.reopened().scene()) == content(whole.scene())


def test_a_quiet_writer_is_caught_up_after_a_restart(tmp_path):
    deltas = random_run(4)[0]
    whole, store = Store(), Store(tmp_path / "scene.sqlite")
    whole.feed(*deltas)
    store.feed(*deltas[:40])
    store = store.reopened()
    outputs = store.feed(*snapshots_of(whole, 59, 59))
    assert asked(outputs) == [PLACE_SNAPSHOT, REGION_SNAPSHOT, OBJECT_SNAPSHOT]
    assert content(store.scene()) == content(whole.scene())


def test_overtaken_deltas_still_tell_where_their_cameras_were():
    deltas = random_run(2)[0]
    whole, store = Store(), Store()
    whole.feed(*deltas)
    bare = place_delta(59, [(1, 0, 0, 0, 1)], snapshot=True)
    store.feed(bare)
    assert len(store.scene().trajectory) == 0
    assert not revisions(store.feed(*deltas[::2]))
    assert store.scene().trajectory.tolist() == whole.scene().trajectory.tolist()


def test_stale_repeats_and_stale_snapshots_change_nothing():
    deltas = random_run(0)[0]
    store = Store()
    store.feed(*deltas)
    before = encode(store.scene())
    assert store.feed(*deltas, place_delta(10, [(1, 0, 0, 0, 9)], snapshot=True, epoch=1)) == []
    assert store.feed(place_delta(1000, [(1, 0, 0, 0, 9)], epoch=0)) == []
    assert encode(store.scene()) == before


@pytest.mark.parametrize("snapshot", [False, True])
def test_a_new_writer_replaces_everything_of_the_old(tmp_path, snapshot):
    store = Store(tmp_path / "scene.sqlite")
    store.feed(*random_run(0)[0])
    revision = 5 if snapshot else 0
    store.feed(
        place_delta(revision, [(3, 1, 2, 3, 0.5), (4, 1, 2, 3, 0.5)], [(3, 4, 0.25)], epoch=2, snapshot=snapshot),
        region_delta(revision, [(3, 8, [1, 0, 0], 0)], [(8, "kitchen", 1)], epoch=2, snapshot=snapshot),
    )
    for opened in (store, store.reopened()):
        scene = opened.scene()
        assert scene.place_ids.tolist() == [3, 4] and edge_list(scene) == [(3, 4, 0.25)]
        assert scene.place_regions.tolist() == [8, -1] and [r.id for r in scene.regions] == [8]
        assert len(scene.trajectory) == 0


def test_merging_leads_edges_to_the_survivor():
    store = Store()
    store.feed(
        place_delta(
            0, [(i, i, 0, 0, 1) for i in range(1, 5)], [(1, 2, 0.5), (2, 3, 0.25), (1, 3, 0.125), (2, 4, 0.75)]
        ),
        place_delta(1, merged_ids=[(2, 3)]),
    )
    assert edge_list(store.scene()) == [(1, 3, 0.125), (3, 4, 0.75)]  # 1-3 was there already and keeps its clearance
    assert store.scene().place_ids.tolist() == [1, 3, 4]


def test_unknown_references_do_no_harm(tmp_path):
    store = Store(tmp_path / "scene.sqlite")
    store.feed(
        region_delta(0, [(5, 1, [0.5, 0.25, 0.25], 0.125), (6, 77, [1, 0, 0], 0)], [(1, "hall", 2)], removed_ids=[9]),
        place_delta(0, [(6, 0, 0, 0, 1)], [(6, 99, 1.0), (6, 6, 1.0)], removed_ids=[41], removed_edges=[(1, 2)]),
        place_delta(1, merged_ids=[(50, 51), (52, 6)]),
    )
    scene = store.scene()
    assert scene.place_ids.tolist() == [6] and len(scene.edges) == 0 and scene.place_regions.tolist() == [77]
    store = store.reopened()
    store.feed(place_delta(2, [(5, 1, 1, 1, 1)]))
    scene = store.scene()
    assert scene.place_regions.tolist() == [1, 77]
    assert scene.posteriors[0].tolist() == [0.5, 0.25, 0.25] and scene.unknown.tolist() == [0.125, 0.0]


def test_new_labels_drop_old_posteriors(tmp_path):
    store = Store(tmp_path / "scene.sqlite")
    store.feed(
        place_delta(0, [(1, 0, 0, 0, 1), (2, 1, 0, 0, 1)]),
        region_delta(0, [(1, 0, [1, 0, 0], 0), (2, 0, [1, 0, 0], 0)], [(0, "kitchen", 2)]),
        region_delta(
            1, [(2, 4, [0.25, 0.75], 0)], [(4, "bath", 1)], removed_ids=[0], labels=["bath", "bed"], task="sleep"
        ),
    )
    for opened in (store, store.reopened()):
        scene = opened.scene()
        assert scene.labels == ["bath", "bed"] and scene.task == "sleep"
        assert scene.posteriors.tolist() == [[0, 0], [0.25, 0.75]] and scene.place_regions.tolist() == [-1, 4]


def test_tasks_priors_and_robots(tmp_path):
    store = Store(tmp_path / "scene.sqlite")
    prior = Prior(
        environment="flat",
        task="clean",
        regions=[RegionPrior(name="hall", phrases=["a hall"], existence=1.0)],
        objects=[ObjectPrior(name="bed", phrases=["a bed"])],
        containment=np.full((1, 1), 0.5, np.float32),
        adjacency=np.ones((1, 1), np.float32),
        provenance=Provenance(source="library"),
    )
    tasks = [Task(robot=ROBOT, stamp_ns=t, environment="flat", task=f"task {t}", regions=["a", "b"]) for t in (5, 9, 7)]
    assert store.feed(prior, prior, *tasks) == []
    assert (store.scene().environment, store.scene().task) == ("flat", "task 9")
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)], robot="other"))
    assert store.scene().place_ids.tolist() == [] and store.scene("other").place_ids.tolist() == [1]
    assert store.scene("nobody").place_ids.tolist() == []
    store = store.reopened()
    assert store.scene().task == "task 9" and store.scene("other").place_ids.tolist() == [1]
    in_force = {r: service.answer_task(store.state, TaskRequest(robot=r), store.cfg).task for r in (ROBOT, "nobody")}
    assert in_force == {ROBOT: tasks[1], "nobody": None}
    rows = sqlite3.connect(store.cfg.path).execute("SELECT digest, message FROM priors").fetchall()
    assert [(digest, decode(Prior, blob)) for digest, blob in rows] == [(prior.digest(), prior)]
    database = store.state.database
    assert encode(database.prior(prior.digest())) == encode(prior) and database.prior("another") is None
    assert asked(store.feed(Tick(stamp_ns=1))) == [PLACE_SNAPSHOT, REGION_SNAPSHOT, OBJECT_SNAPSHOT] * 2


def test_history_lists_what_each_delta_left(tmp_path):
    store = Store(tmp_path / "scene.sqlite")
    store.feed(
        place_delta(0, [(1, 0, 0, 0, 1), (2, 0, 0, 0, 1)], [(1, 2, 1.0)]),
        region_delta(0, [], [(4, "hall", 1)]),
        place_delta(1, removed_ids=[1]),
    )
    database = store.reopened().state.database
    told = [msgspec.structs.astuple(row) for row in database.history(ROBOT, limit=2)]
    assert told == [(1, 7, "region", 1500, 2, 1, 1, 0), (2, 7, "place", 2000, 1, 0, 1, 0)]
    assert [row.revision for row in database.history(ROBOT, before=1)] == [0]
    assert database.history("nobody") == []


def test_nothing_received_is_kept_alive():
    store = Store()
    message = received(region_delta(0, [(1, 0, [1, 0, 0], 0)]))
    Runner(service.SERVICE, store.cfg, state=store.state).feed(message)
    posterior = store.state.robots[ROBOT].graph.beliefs[1].posterior
    assert not np.shares_memory(posterior, message.posteriors)


def test_everything_a_region_tells_survives_a_restart(tmp_path):
    way = Transition(region=8, edge=(1, 2), position_m=(0.5, 0.0, 1.0), clearance_m=0.4, door=True)
    region = Region(
        id=4,
        label=LABELS[0],
        place_count=2,
        probability=0.75,
        position_m=(0.1, 0.0, 1.0),
        area_m2=2.5,
        unknown=0.5,
        predicted=True,
        hull_m=[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)],
        neighbour_ids=[8],
        transitions=[way],
        object_ids=[3],
        parent="day zone",
    )
    beliefs = [(1, 4, [1, 0, 0], 0), (2, 4, [1, 0, 0], 0.5)]
    store = Store(tmp_path / "scene.sqlite")
    store.feed(place_delta(0, [(1, 0, 0, 1, 0.5), (2, 1, 0, 1, 0.5)]))
    store.feed(msgspec.structs.replace(region_delta(0, beliefs, predicted_ids=np.array([2])), regions=[region]))
    for scene in (store.scene(), store.reopened().scene()):
        assert scene.regions == [region]
        assert scene.predicted_ids.tolist() == [2]


def test_objects_change_merge_go_and_survive_a_restart(tmp_path):
    def item(number, label="bed", x_m=1.0):
        corner = (x_m - 0.5, 0.0, 0.0), (x_m + 0.5, 1.0, 0.5)
        fields = {"label": label, "probability": 0.6, "known": 0.9, "position_m": (x_m, 0.5, 0.25), "frames": 3}
        return SceneObject(id=number, min_m=corner[0], max_m=corner[1], **fields)

    def delta(revision, items, removed=(), merged=(), epoch=1, **fields):
        arrays = {"removed_ids": np.array(removed, np.int64), "merged_ids": np.array(merged, np.int64).reshape(-1, 2)}
        head = {"robot": ROBOT, "epoch": epoch, "revision": revision, "stamp_ns": revision, "prior_digest": "d"}
        return ObjectDelta(objects=items, **head, **arrays, **fields)

    store = Store(tmp_path / "scene.sqlite")
    store.feed(delta(0, [item(0), item(1), item(2)]), delta(1, [item(2, "sofa")], removed=[0], merged=[(1, 2)]))
    assert store.scene().objects == [item(2, "sofa")]
    store = store.reopened()
    assert store.scene().objects == [item(2, "sofa")]
    store.feed(delta(5, [item(7), item(2, "sofa", 2.0)], snapshot=True))
    assert store.reopened().scene().objects == [item(2, "sofa", 2.0), item(7)]


def test_openings_and_ground_are_kept_until_they_close_or_their_place_goes(tmp_path):
    store = Store(tmp_path / "scene.sqlite")
    opening = {"frontier_directions": np.array([(0, 0, 1), (1, 0, 0)], np.float32)}
    ground = {
        "surface_ids": np.array([1, 2]),
        "ellipses": np.array([(1, 0.5, 0.25), (3, 2, 1)], np.float32),
        "hull_counts": np.array([3, 0]),
        "hulls_m": np.array([(0, 0), (1, 0), (0, 1)], np.float32),
    }
    both = {"frontier_ids": np.array([1, 2]), "frontier_areas_m2": np.array([2.0, 0.5], np.float32)}
    store.feed(place_delta(0, [(1, 0, 0, 1, 0.5), (2, 1, 0, 1, 0.5)], **opening, **both, **ground))
    for scene in (store.scene(), store.reopened().scene()):
        assert (scene.frontier_ids.tolist(), scene.frontier_areas_m2.tolist()) == ([1, 2], [2.0, 0.5])
        assert scene.frontier_directions.tolist() == [[0, 0, 1], [1, 0, 0]]
        assert scene.ellipses.tolist() == [[1, 0.5, 0.25], [3, 2, 1]] and scene.hull_counts.tolist() == [3, 0]
        assert scene.hulls_m.tolist() == [[0, 0], [1, 0], [0, 1]]
    closed = {"frontier_ids": np.array([1]), "frontier_areas_m2": np.zeros(1, np.float32)}
    again = store.reopened()
    again.feed(place_delta(1, frontier_directions=np.zeros((1, 3), np.float32), **closed))
    again.feed(place_delta(2, removed_ids=[2]))
    for scene in (again.scene(), again.reopened().scene()):
        assert scene.frontier_ids.tolist() == [] and scene.surface_ids.tolist() == [1]


def test_a_file_of_the_former_layout_is_upgraded_and_its_present_begins_the_history(tmp_path):
    path = tmp_path / "scene.sqlite"
    write_layout_5(path)
    expected = decode(Scene, SCENE_OF_LAYOUT_5.read_bytes())
    opened = Store(path)
    for _ in range(2):
        opened = opened.reopened()
        assert content(opened.scene()) == content(expected)
        assert opened.scene("other").place_ids.tolist() == [1]
        (only,) = opened.state.database.history(ROBOT)
        assert (only.kind, only.revision, only.places) == ("snapshot", opened.scene().revision, len(expected.place_ids))
        assert content(opened.scene(revision=only.revision)) == content(expected)
        assert opened.scene(revision=only.revision - 1).revision == -1
        assert [found.id for found in opened.state.database.labelled(ROBOT, "object", "bed")] == [3]
    before = opened.scene().revision
    opened.feed(place_delta(7, [(1, 0, 0, 0, 1)]))
    assert [row.revision for row in opened.state.database.history(ROBOT)] == [before, before + 1]
    assert content(opened.scene(revision=before)) == content(expected)


OLDER = {
    1: ("ALTER TABLE regions DROP COLUMN message", "ALTER TABLE beliefs DROP COLUMN predicted", "DROP TABLE origins"),
    4: ("DROP TABLE origins",),
}


@pytest.mark.parametrize("layout", OLDER)
def test_files_of_older_layouts_are_upgraded_step_by_step(tmp_path, layout):
    path = tmp_path / "scene.sqlite"
    missing = ("DROP TABLE place_details", "DROP TABLE objects") if layout == 1 else ()
    write_layout_5(path, *OLDER[layout], *missing, f"PRAGMA user_version = {layout}")
    scene, expected = Store(path).scene(), decode(Scene, SCENE_OF_LAYOUT_5.read_bytes())
    assert scene.place_ids.tolist() == expected.place_ids.tolist() and scene.origin_m == (0.0, 0.0, 0.0)
    assert [r.label for r in scene.regions] == [r.label for r in expected.regions]
    assert np.array_equal(scene.posteriors, expected.posteriors)
    assert len(scene.predicted_ids) == (0 if layout == 1 else len(expected.predicted_ids))


@pytest.mark.parametrize("layout", [*OLDER, 5])
def test_a_file_of_an_older_layout_that_is_only_read_stays_as_it_is(tmp_path, layout):
    path = tmp_path / "scene.sqlite"
    missing = ("DROP TABLE place_details", "DROP TABLE objects") if layout == 1 else ()
    write_layout_5(path, *OLDER.get(layout, ()), *missing, f"PRAGMA user_version = {layout}")
    before = path.read_bytes()
    reader = Database(Config(path=str(path)), read_only=True)
    expected = decode(Scene, SCENE_OF_LAYOUT_5.read_bytes())
    assert telling.scene(reader.at(ROBOT)).place_ids.tolist() == expected.place_ids.tolist()
    with pytest.raises(StoreError):
        reader.put_task(core.Graph(ROBOT), Task(robot=ROBOT, stamp_ns=1, environment="e", task="t"))
    reader.close()
    assert path.read_bytes() == before and [*tmp_path.iterdir()] == [path]
    assert Store(path).scene().place_ids.tolist() == expected.place_ids.tolist()


def test_the_offset_of_the_world_is_kept(tmp_path):
    origin_m = (512_345.0, 5_403_210.0, 312.0)
    store = Store(tmp_path / "scene.sqlite")
    store.feed(place_delta(0, [(1, 0, 0, 1, 0.5)], origin_m=origin_m))
    assert store.scene().origin_m == store.reopened().scene().origin_m == origin_m


def write_text(path):
    path.write_text("this is a diary, not a database " * 200)


def write_other(path):
    with sqlite3.connect(path) as sql:
        sql.execute("CREATE TABLE recipes (id)")


def write_future(path):
    write_other(path)
    with sqlite3.connect(path) as sql:
        sql.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        sql.execute("PRAGMA user_version = 99")


def write_damaged(path):
    store = Store(path)
    store.feed(*random_run(0)[0])
    service.close(store.state)
    data = bytearray(path.read_bytes())
    for page in range(2, len(data) // 4096):
        data[page * 4096 : page * 4096 + 2000] = bytes([0xA5]) * 2000
    path.write_bytes(data)


def make_folder(path):
    path.mkdir()


@pytest.mark.parametrize("spoil", [write_text, write_other, write_future, write_damaged, make_folder])
def test_a_file_that_is_no_scene_database_is_refused_in_one_sentence(tmp_path, spoil):
    path = tmp_path / "scene.sqlite"
    spoil(path)
    with pytest.raises(StoreError, match="another path") as caught:
        Store(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


WRITER = """
import sys
from tests.services.scene_store.test_scene_store import Store, random_run
store = Store(sys.argv[1])
deltas = random_run(6, steps=120)[0]
store.feed(deltas[0], deltas[1])
print("ready", flush=True)
store.feed(*deltas)
"""


def test_killed_at_any_moment_content_and_cursors_agree(tmp_path):
    deltas = random_run(6, steps=120)[0]
    progress = set()
    for attempt in range(3):
        path = tmp_path / f"{attempt}.sqlite"
        root = ROOT
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)],
            cwd=root,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(("src", "."))},
        )
        assert process.stdout.readline() == b"ready\n"
        time.sleep(0.03 * attempt)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        survivor, clean = Store(path), Store()
        graph = survivor.state.robots[ROBOT].graph
        done = graph.place_cursor.revision + graph.region_cursor.revision + 2
        assert done == graph.revision + 1 >= 2
        clean.feed(*deltas[:done])
        assert encode(survivor.scene()) == encode(clean.scene())
        survivor.feed(*deltas)
        clean.feed(*deltas[done:])
        assert encode(survivor.scene()) == encode(clean.scene())
        progress.add(done)
        service.close(survivor.state)
    assert len(progress) > 1  # killed at different moments


def test_a_failed_commit_leaves_the_file_as_it_was(tmp_path):
    store = Store(tmp_path / "scene.sqlite")
    store.feed(place_delta(0, [(1, 0, 0, 0, 1)]))
    before = encode(store.scene())
    store.state.database.storage.run(
        "CREATE TRIGGER full BEFORE INSERT ON places BEGIN SELECT RAISE(FAIL, 'disk full'); END"
    )
    with pytest.raises(StoreError, match="disk full"):
        store.feed(place_delta(1, [(2, 0, 0, 0, 1)], [(1, 2, 0.5)]))
    database = Database(store.cfg)
    assert encode(telling.scene(database.graphs()[ROBOT])) == before


def test_a_stored_robot_whose_name_cannot_be_used_is_left_out(tmp_path, caplog):
    """Files of earlier versions may hold some; the others go on."""
    path = str(tmp_path / "scene.sqlite")
    database = Database(Config(path=path))
    database.storage.robot_key("x//y")
    database.storage.robot_key(b"bytes")
    task = Task(robot="good", stamp_ns=1, environment="e", task="'; DROP TABLE robots;--")
    graph = core.Graph("good", task=task)
    database.put_task(graph, task)
    database.close()
    database = Database(Config(path=path))
    with caplog.at_level("WARNING"):
        graphs = database.graphs()
    database.close()
    assert list(graphs) == ["good"] and graphs["good"].task.task == "'; DROP TABLE robots;--"
    assert "left out" in caplog.text


def test_a_task_kept_from_a_clock_in_the_far_future_is_stamped_anew_so_that_the_next_one_is_newer(tmp_path):
    now_ns = 1_800_000_000 * 10**9
    forged = Task(robot=ROBOT, stamp_ns=2**62, environment="flat", task="old")
    store = Store(tmp_path / "scene.sqlite")
    store.feed(forged, Tick(stamp_ns=5))  # a clock that was never set judges none
    assert store.runner.answer(TASK_IN_FORCE, TaskRequest(robot=ROBOT)).task == forged
    store.feed(Tick(stamp_ns=now_ns), Task(robot=ROBOT, stamp_ns=now_ns + 1, environment="flat", task="new"))
    assert store.runner.answer(TASK_IN_FORCE, TaskRequest(robot=ROBOT)).task.task == "new"
    again = store.reopened()
    again.feed(Tick(stamp_ns=now_ns), Task(robot=ROBOT, stamp_ns=now_ns + 2, environment="flat", task="newer"))
    assert again.runner.answer(TASK_IN_FORCE, TaskRequest(robot=ROBOT)).task.task == "newer"


def test_the_store_says_how_far_epochs_have_come():
    store = Store()
    store.feed(place_delta(0, epoch=4))
    known = [store.runner.answer(EPOCH, EpochRequest(robot=ROBOT, topic=t.name, keeper="scene_store")) for t in DELTAS]
    told = {one.topic: (one.epoch, one.revision) for one in known}
    assert told == {"PLACE_DELTA": (4, 0), "REGION_DELTA": (-1, -1), "OBJECT_DELTA": (-1, -1)}
    assert store.runner.answer(EPOCH, EpochRequest(robot="new", topic="PLACE_DELTA", keeper="scene_store")).epoch == -1
