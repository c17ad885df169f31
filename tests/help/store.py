"""A running system on a local bus: a store that answers of scenes it is given, and all that a task needs."""

import threading
import time

import msgspec
import numpy as np

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.priors import PriorList, Task
from prior_sg.schemas.queries import SceneQuery
from prior_sg.schemas.regions import PosteriorReply, RegionDelta
from prior_sg.schemas.scene import SceneRequest, SceneRevision
from prior_sg.schemas.status import Consumed
from prior_sg.schemas.topics import (
    JOURNAL,
    OBJECT_DELTA,
    POSE_UPDATE,
    POSTERIOR,
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
from prior_sg.services.scene_store.core import graph, telling
from prior_sg.services.scene_store.core.queries.answering import reply
from prior_sg.services.scene_store.core.queries.index import Index
from tests.help.world import prior


class StandIn:
    """`relabel` makes of a scene and a task the scene that follows it, which the store has `behind_s` after the regions
    are told; `forgotten` revisions are not kept; `mute` says which of "prior", "regions", "names", "poses" stay out.
    On a `hub` that is given, it answers of its own robot alone.
    """

    def __init__(self, scene, relabel=lambda scene, task, digest: scene, *, mute=(), behind_s=0.0, hub=None):
        self.hub, self.robot, self.relabel = hub or Hub(), scene.robot, relabel
        of = "*" if hub is None else scene.robot
        self.mute, self.behind_s = mute, behind_s
        self.scenes, self.tasks, self.poses = [msgspec.structs.replace(scene, revision=0)], [], []
        self.forgotten = set()
        self.bus = BusClient(LocalBus(self.hub))
        serve = self.bus.bus.serve
        serve(SCENE.key.format(robot=of), self.show)
        serve(SCENE_QUERY.key.format(robot=of), self.answer)
        serve(PRIORS.key, lambda request: request.reply(encode(PriorList(priors=[], reason="no library"))))
        serve(POSTERIOR.key.format(robot=self.robot), self.explain)
        self.bus.bus.announce(alive_key("place_graph", "p-1"))
        self.bus.listen(TASK, self.robot, self.take)
        self.bus.listen(POSE_UPDATE, self.robot, self.correct)

    def open_bus(self):
        return LocalBus(self.hub)

    def show(self, request):
        robot = decode(SceneRequest, request.payload).robot
        request.reply(encode(self.scenes[-1] if robot == self.robot else empty(robot)))

    def explain(self, request):
        place = decode(POSTERIOR.request, request.payload).place_id
        request.reply(encode(PosteriorReply(robot=self.robot, place_id=place, found=place == 1, label="kitchen")))

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
        if "prior" in self.mute:
            return
        made = prior(["kitchen", "hall"], environment=task.environment, task=task.task, vocabulary=task.regions)
        self.bus.publish(PRIOR, made)
        threading.Timer(0.05, self.label, (task, made.digest())).start()

    def label(self, task, digest):
        """Regions first, then the names of objects; the store is behind both."""
        scene = self.relabel(self.scenes[-1], task.task, digest)
        if scene is None or "regions" in self.mute:
            return
        self.bus.publish(REGION_DELTA, delta(self.robot, task.task, digest))
        time.sleep(self.behind_s)
        unnamed = [msgspec.structs.replace(item, label="") for item in scene.objects]
        self.store(msgspec.structs.replace(scene, objects=unnamed))
        if "names" not in self.mute:
            self.bus.publish(OBJECT_DELTA, names(self.robot, scene.objects, digest))
            time.sleep(self.behind_s)
            self.store(scene)

    def correct(self, sample):
        self.poses.append(decode(PoseUpdate, sample.payload))
        if "poses" in self.mute:
            return
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


def names(robot, objects, digest):
    """What the segmenter tells of objects that a prior names."""
    none = np.zeros(0, np.int64)
    return ObjectDelta(
        robot=robot, epoch=1, revision=0, stamp_ns=1, prior_digest=digest, objects=objects, removed_ids=none
    )


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
    return telling.scene(graph.Graph(robot))
