"""A running system on a local bus: a store that answers of scenes it is given, and all that a task needs."""

import threading

import msgspec
import numpy as np

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.priors import PriorList, Task
from prior_sg.schemas.queries import SceneQuery
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import SceneRequest, SceneRevision
from prior_sg.schemas.status import Consumed
from prior_sg.schemas.topics import (
    JOURNAL,
    POSE_UPDATE,
    PRIOR,
    PRIORS,
    REGION_DELTA,
    SCENE,
    SCENE_QUERY,
    SCENE_REVISION,
    TASK,
    alive_key,
)
from prior_sg.services.runtime.bus import Hub, LocalBus
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.scene_store.core import graph
from prior_sg.services.scene_store.core.queries.answering import reply
from prior_sg.services.scene_store.core.queries.index import Index
from tests.help.world import prior


class StandIn:
    """`relabel` makes of a scene and a task the scene that follows it; `forgotten` revisions are not kept."""

    def __init__(self, scene, relabel=lambda scene, task, digest: scene):
        self.hub, self.robot, self.relabel = Hub(), scene.robot, relabel
        self.scenes, self.tasks, self.poses = [msgspec.structs.replace(scene, revision=0)], [], []
        self.forgotten = set()
        self.bus = BusClient(LocalBus(self.hub))
        serve = self.bus.bus.serve
        serve(SCENE.key.format(robot="*"), self.show)
        serve(SCENE_QUERY.key.format(robot="*"), self.answer)
        serve(PRIORS.key, lambda request: request.reply(encode(PriorList(priors=[], reason="no library"))))
        self.bus.bus.announce(alive_key("place_graph", "p-1"))
        self.bus.listen(TASK, self.robot, self.take)
        self.bus.listen(POSE_UPDATE, self.robot, self.correct)

    def open_bus(self):
        return LocalBus(self.hub)

    def show(self, request):
        robot = decode(SceneRequest, request.payload).robot
        request.reply(encode(self.scenes[-1] if robot == self.robot else empty(robot)))

    def answer(self, request):
        query = decode(SceneQuery, request.payload)
        scene = self.scenes[-1] if query.robot == self.robot else empty(query.robot)
        request.reply(encode(reply(Index(scene), query, self.older)))

    def older(self, revision):
        kept = 0 <= revision < len(self.scenes) and revision not in self.forgotten
        return self.scenes[revision] if kept else None

    def store(self, scene):
        """One revision more."""
        number = len(self.scenes)
        self.scenes.append(msgspec.structs.replace(scene, revision=number))
        counts = {"places": len(scene.place_ids), "edges": len(scene.edges), "regions": len(scene.regions)}
        told = SceneRevision(robot=self.robot, epoch=1, revision=number, stamp_ns=scene.stamp_ns, **counts)
        self.bus.publish(SCENE_REVISION, told)

    def take(self, sample):
        task = decode(Task, sample.payload)
        self.tasks.append(task)
        made = prior(["kitchen", "hall"], environment=task.environment, task=task.task, vocabulary=task.regions)
        self.bus.publish(PRIOR, made)
        threading.Timer(0.05, self.label, (task, made.digest())).start()

    def label(self, task, digest):
        scene = self.relabel(self.scenes[-1], task.task, digest)
        if scene is not None:
            self.bus.publish(REGION_DELTA, delta(self.robot, task.task, digest))
            self.store(scene)

    def correct(self, sample):
        self.poses.append(decode(PoseUpdate, sample.payload))
        entry = Consumed(
            robot=self.robot,
            service="place_graph",
            instance="p",
            order=0,
            topic="POSE_UPDATE",
            writer=sample.writer,
            sequence=sample.sequence,
        )
        self.bus.publish(JOURNAL, entry)


def delta(robot, task, digest):
    none = np.zeros(0, np.int64)
    return RegionDelta(
        robot=robot,
        epoch=1,
        revision=0,
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


def empty(robot):
    return graph.scene(graph.Graph(robot))
