"""A program's end of a running system, on the local bus with the services played here."""

import threading
import time

import numpy as np
import pytest

import prior_sg
from prior_sg.deploy.api.client import Client
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.priors import PriorList, Task
from prior_sg.schemas.regions import PosteriorReply, RegionDelta
from prior_sg.schemas.scene import SceneRevision
from prior_sg.schemas.status import Consumed
from prior_sg.schemas.topics import (
    JOURNAL,
    POSE_UPDATE,
    POSTERIOR,
    PRIOR,
    PRIORS,
    REGION_DELTA,
    SCENE,
    SCENE_REVISION,
    TASK,
    alive_key,
)
from prior_sg.services.runtime.bus import Hub, LocalBus
from prior_sg.services.runtime.client import BusClient
from tests.deploy.api.test_scene import message
from tests.help.world import prior

ROBOT = "ada"


class System:
    """Answers a task with a prior and regions; `mute` names what it leaves out."""

    def __init__(self, hub, mute=()):
        self.hub, self.mute = hub, mute
        self.bus = BusClient(LocalBus(hub))
        self.scene, self.tasks, self.poses = message(), [], []
        self.bus.bus.serve(SCENE.key.format(robot=ROBOT), lambda request: request.reply(encode(self.scene)))
        self.bus.bus.serve(PRIORS.key, lambda request: request.reply(encode(PriorList(priors=[], reason="why not"))))
        self.bus.bus.serve(POSTERIOR.key.format(robot=ROBOT), self.explain)
        self.bus.bus.announce(alive_key("place_graph", "p-1"))
        self.bus.listen(TASK, ROBOT, self.take)
        self.bus.listen(POSE_UPDATE, ROBOT, self.correct)

    def explain(self, request):
        place = decode(POSTERIOR.request, request.payload).place_id
        request.reply(encode(PosteriorReply(robot=ROBOT, place_id=place, found=place == 1, label="kitchen")))

    def take(self, sample):
        task = decode(Task, sample.payload)
        self.tasks.append(task)
        if "prior" not in self.mute:
            made = prior(["kitchen", "hall"], environment=task.environment, task=task.task, vocabulary=task.regions)
            self.bus.publish(PRIOR, made)
            if "regions" not in self.mute:
                threading.Timer(0.1, self.label, (task, made.digest())).start()

    def label(self, task, digest):
        self.bus.publish(REGION_DELTA, delta(task.task, digest))
        time.sleep(0.2)  # the store is behind the segmenter
        self.scene = message(task=task.task, prior_digest=digest)

    def correct(self, sample):
        self.poses.append(decode(PoseUpdate, sample.payload))
        if "poses" not in self.mute:
            entry = Consumed(
                robot=ROBOT,
                service="place_graph",
                instance="p",
                order=0,
                topic="POSE_UPDATE",
                writer=sample.writer,
                sequence=sample.sequence,
            )
            self.bus.publish(JOURNAL, entry)


def delta(task, digest, revision=0):
    none = np.zeros(0, np.int64)
    return RegionDelta(
        robot=ROBOT,
        epoch=1,
        revision=revision,
        stamp_ns=1,
        prior_digest=digest,
        environment="home",
        task=task,
        space="s",
        labels=[],
        regions=[],
        removed_ids=none,
        place_ids=none,
        place_regions=none,
        posteriors=np.zeros((0, 0), np.float16),
        unknown=np.zeros(0, np.float16),
        removed_place_ids=none,
        energy=0.0,
    )


def joined(mute=()):
    hub = Hub()
    return System(hub, mute), Client(robot=ROBOT, bus=LocalBus(hub))


def test_a_task_returns_the_scene_that_the_store_has_of_it():
    system, client = joined()
    with client:
        system.bus.publish(REGION_DELTA, delta("sweep", "of an earlier time"))
        scene = client.task("sweep", regions=["kitchen", "hall"])
    assert scene.task == "sweep" and [task.environment for task in system.tasks] == ["home"]
    assert system.tasks[0].regions == ["kitchen", "hall"]
    assert scene.message.prior_digest == system.scene.prior_digest


def test_why_a_task_fails_is_told():
    with joined(mute=["prior"])[1] as client, pytest.raises(prior_sg.NoPriorError, match="why not"):
        client.task("sweep", timeout_s=2.0)
    with joined(mute=["regions"])[1] as client, pytest.raises(prior_sg.TaskError, match="no regions for the new task"):
        client.task("sweep", timeout_s=0.3)
    system, client = joined()
    system.scene = message(environment="")
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
    system.bus.publish(REGION_DELTA, delta("sweep", "d"))
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


def test_health_names_who_is_silent():
    _, client = joined()
    with client:
        health = client.health()
    assert health.processes == [] and "nobody answers" in health.silent["p-1"]
