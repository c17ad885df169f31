"""A program's end of a running system, on the local bus with the services played here."""

import contextlib
import threading

import msgspec
import numpy as np
import pytest

import prior_sg
from prior_sg.deploy.api.client import MOST_CHANGES, MOST_PRIORS, Changes, Client
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.priors import PriorList, PriorRequest
from prior_sg.schemas.scene import SceneRevision
from prior_sg.schemas.topics import PRIORS, REGION_DELTA, SCENE_REVISION, alive_key
from prior_sg.services.runtime.bus import Hub, LocalBus
from tests.deploy.api.test_scene import message
from tests.help.store import StandIn, delta
from tests.help.world import prior

ROBOT = "ada"
replace = msgspec.structs.replace


def follow(scene, task, digest):
    return message(task=task, prior_digest=digest)


def joined(mute=(), scene=message()):
    system = StandIn(scene, follow, mute=mute, behind_s=0.2)
    return system, Client(robot=ROBOT, bus=system.open_bus())


def test_a_task_returns_the_scene_that_the_store_has_of_it():
    system, client = joined()
    with client:
        system.bus.publish(REGION_DELTA, delta(ROBOT, "sweep", "of an earlier time"))
        scene = client.task("sweep", regions=["kitchen", "hall"])
    assert scene.task == "sweep" and [task.environment for task in system.tasks] == ["home"]
    assert system.tasks[0].regions == ["kitchen", "hall"]
    assert scene.message.prior_digest == system.scenes[-1].prior_digest


def test_the_scene_of_a_task_has_the_names_of_its_objects(monkeypatch):
    with joined()[1] as client:
        assert [item.label for item in client.task("sweep").message.objects] == [
            item.label for item in message().objects
        ]
    monkeypatch.setattr("prior_sg.deploy.api.client.NAMES_WAIT_S", 0.3)
    with joined(mute=["names"])[1] as client:
        assert {item.label for item in client.task("sweep").message.objects} == {""}


def test_a_task_in_force_is_answered_at_once():
    system, client = joined()
    with client:
        first, second = client.switch("sweep"), client.switch("sweep")
    assert second.scene.revision == first.scene.revision and second.prior == first.prior
    assert len(system.tasks) == 2


def test_a_client_keeps_few_priors():
    hub = Hub()
    known = {one.digest(): one for one in (prior(["kitchen"], task=f"task {number}") for number in range(20))}

    def serve(request):
        digest = decode(PriorRequest, request.payload).digest
        request.reply(encode(PriorList(priors=[known[digest]])))

    LocalBus(hub).serve(PRIORS.key, serve)
    with Client(robot=ROBOT, bus=LocalBus(hub)) as client:
        assert [client.prior_of(digest) for digest in known] == list(known.values())
        assert len(client._priors) == MOST_PRIORS


def followed(scene, task, digest):
    return replace(scene, task=task, prior_digest=digest)


class Merging(StandIn):
    """A merged map of robots' stand-ins, which follows them once all have a task."""

    def __init__(self, robots, **options):
        of = [one.robot for one in robots]
        super().__init__(message(merged_of=of, task="; ".join(of)), hub=robots[0].hub, **options)
        self.robots, self.over = robots, threading.Event()
        threading.Thread(target=self.follow, daemon=True).start()

    def follow(self):
        while not self.over.wait(0.05):
            first, *others = (one.scenes[-1] for one in self.robots)
            if first.task != self.scenes[-1].task and all(one.task == first.task for one in others):
                self.store(replace(self.scenes[-1], task=first.task, prior_digest=first.prior_digest))


@contextlib.contextmanager
def merging(**options):
    """Two robots, of which options are the second's, and their merged map."""
    first = StandIn(message(robot="r1"), followed, behind_s=0.1, hub=Hub())
    first.bus.bus.announce(alive_key("scene_store", "s-1"))
    second = StandIn(message(robot="r2"), followed, behind_s=0.3, hub=first.hub, **options)
    merged = Merging([first, second])
    try:
        with Client(robot=ROBOT, bus=first.open_bus()) as client:
            yield first, second, merged, client
    finally:
        merged.over.set()


def test_a_task_for_a_merged_map_is_given_to_each_of_its_robots():
    with merging() as (first, second, merged, client):
        told = []
        switch = client.switch("sweep", regions=["kitchen", "hall"], on_prior=told.append)
    assert told == [switch.prior], "once, though two robots got it"
    assert [[(task.task, task.environment) for task in one.tasks] for one in (first, second, merged)] == [
        [("sweep", "home")],
        [("sweep", "home")],
        [],
    ]
    assert switch.scene.message.robot == ROBOT and switch.scene.task == "sweep"
    assert switch.scene.message.prior_digest == switch.prior.digest() == second.scenes[-1].prior_digest


def test_who_of_a_merged_map_does_not_take_a_task_is_told(monkeypatch):
    with merging(mute=["regions"]) as (first, second, merged, client):
        said = "r2 does not follow the task: no regions for the new task within 1 s; see `prior-sg health`; r1 took it"
        with pytest.raises(prior_sg.TaskError, match=said):
            client.switch("sweep", timeout_s=1.0)
        assert first.scenes[-1].task == "sweep" and second.scenes[-1].task != "sweep"
    monkeypatch.setattr("prior_sg.deploy.api.client.MERGE_WAIT_S", 0.3)
    with merging() as (_, _, merged, client):
        merged.over.set()
        with pytest.raises(prior_sg.TaskError, match="r1, r2 follow the task, and their merged map ada does not"):
            client.switch("sweep")


def test_a_task_for_maps_that_are_merged_of_each_other_is_refused():
    first = StandIn(message(robot="r1", merged_of=["ada"]), hub=Hub())
    StandIn(message(robot="ada", merged_of=["r1"]), hub=first.hub)
    before = threading.active_count()
    refused = pytest.raises(prior_sg.TaskError, match="ada and r1 are merged of each other")
    with Client(robot="ada", bus=first.open_bus()) as client, refused:
        client.switch("sweep", timeout_s=1.0)
    assert threading.active_count() <= before + 1


def test_a_merged_map_takes_no_poses_and_says_who_does():
    system, client = joined(scene=message(merged_of=["r1", "r2"]))
    system.bus.bus.announce(alive_key("scene_store", "s-1"))
    of = "ada is the merged map of r1, r2"
    with client:
        with pytest.raises(prior_sg.PosesError, match=f"{of} and follows what they do: give the poses to a robot"):
            client.correct_poses({0: np.eye(4)})
        with pytest.raises(prior_sg.NotInSceneError, match=f"{of}: why a place carries its label is known"):
            client.explain(1)
    assert not system.tasks and not system.poses


def test_why_a_task_fails_is_told():
    with joined(mute=["prior"])[1] as client, pytest.raises(prior_sg.NoPriorError, match="no library"):
        client.task("sweep", timeout_s=2.0)
    with joined(mute=["regions"])[1] as client, pytest.raises(prior_sg.TaskError, match="no regions for the new task"):
        client.task("sweep", timeout_s=0.3)
    _, client = joined(scene=message(environment=""))
    with client, pytest.raises(prior_sg.TaskError, match="ada has no environment yet"):
        client.task("sweep")


def test_poses_are_taken_or_not():
    system, client = joined()
    with client:
        pose = np.eye(4)
        assert client.correct_poses({3: pose, 5: pose}) >= 0
        assert system.poses[0].frame_ids.tolist() == [3, 5]
        with pytest.raises(prior_sg.PosesError, match="cannot be used: world_from_camera"):
            client.correct_poses({3: np.zeros((4, 4))})
        with pytest.raises(prior_sg.PosesError, match="no poses"):
            client.correct_poses({})
    with joined(mute=["poses"])[1] as client, pytest.raises(prior_sg.PosesError, match="took no poses within"):
        client.correct_poses({3: pose}, timeout_s=0.2)
    with Client(bus=LocalBus(Hub())) as alone, pytest.raises(prior_sg.PosesError, match="no place_graph is running"):
        alone.correct_poses({3: pose})


def test_changes_leave_no_subscription_behind_and_wait_for_their_own_poses():
    system, client = joined()
    with client:
        before = len(system.hub.subscribers)
        client.task("sweep")
        client.correct_poses({3: np.eye(4)})
        assert len(system.hub.subscribers) == before
        system.mute = ["poses", "prior"]
        with pytest.raises(prior_sg.PosesError, match="took no poses within"):  # the journal tells of the first ones
            client.correct_poses({3: np.eye(4)}, timeout_s=0.1)
        with pytest.raises(prior_sg.NoPriorError):
            client.task("mop", timeout_s=0.1)
        assert len(system.hub.subscribers) == before


def test_explain_and_scene():
    with joined()[1] as client:
        assert client.explain(1).label == "kitchen" and len(client.scene().places) == 3
        with pytest.raises(prior_sg.NotInSceneError, match="ada has no labelled place 2"):
            client.explain(2)
    with Client(bus=LocalBus(Hub())) as alone, pytest.raises(prior_sg.BusError, match="nobody answers"):
        alone.scene()


def revision(number):
    return SceneRevision(robot=ROBOT, epoch=1, revision=number, stamp_ns=1, places=1, edges=0, regions=0)


def test_changes_arrive_until_the_client_is_closed():
    system, client = joined()
    stored, all_ = client.changes(), client.changes(deltas=True)
    system.bus.publish(SCENE_REVISION, revision(1))
    system.bus.publish(REGION_DELTA, delta(ROBOT, "sweep", "d"))
    seen = []
    follower = threading.Thread(target=lambda: seen.extend(stored))
    follower.start()
    closed = client.changes()
    closed.close()
    system.bus.publish(SCENE_REVISION, revision(2))
    assert list(closed) == []
    client.close()
    follower.join(5)
    assert not follower.is_alive() and [change.revision for change in seen] == [1, 2]
    assert [type(change).__name__ for change in all_] == ["SceneRevision", "RegionDelta", "SceneRevision"]


def test_of_changes_that_nobody_takes_the_newest_are_kept_and_the_others_counted():
    changes = Changes()
    for number in range(MOST_CHANGES + 3):
        changes.put(revision(number))
    changes.close()
    assert [change.revision for change in changes] == list(range(3, MOST_CHANGES + 3)) and changes.lost == 3


def test_health_names_who_is_silent():
    _, client = joined()
    with client:
        health = client.health()
    assert health.processes == [] and "nobody answers" in health.silent["p-1"]
