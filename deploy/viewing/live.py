"""A running system: its scene as the store has it, its images as they arrive."""

import contextlib
import queue
import threading
import time
from collections import deque

import msgspec
import numpy as np

from prior_sg.deploy.api.client import Changes, Client, Health
from prior_sg.deploy.viewing.cloud import Cloud
from prior_sg.deploy.viewing.recorded import camera_of
from prior_sg.deploy.viewing.sources import Camera, Likeness, Say
from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.frames import ArchiveReply, ArchiveRequest, Keyframe, PoseUpdate
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import PosteriorReply
from prior_sg.schemas.scene import Scene, StoredRevision
from prior_sg.schemas.topics import ARCHIVE, KEYFRAME, POSE_UPDATE
from prior_sg.services.deltas import PoseCorrections
from prior_sg.services.images import ImageFault
from prior_sg.services.refusals import InputRefused
from prior_sg.services.runtime.bus import Bus, BusError, Sample
from prior_sg.services.runtime.client import BusClient

MOST_REVISIONS = 1000  # that the slider goes back
MOST_CAMERAS = 2000
TASK_WAIT_S = 300.0  # a language model may take minutes


class Live:
    """A robot on a bus, which is closed with it."""

    live = True

    def __init__(self, bus: Bus, robot: str, title: str = "live") -> None:
        self.robot, self.title, self.cloud = robot, title, Cloud()
        self._client = Client(robot=robot, bus=bus)
        self._bus = BusClient(bus)
        self._revisions: list[StoredRevision] = []
        self._cameras: deque[Camera] = deque(maxlen=MOST_CAMERAS)
        self._poses = PoseCorrections()
        self._samples: queue.SimpleQueue[Sample | ArchiveReply | None] = queue.SimpleQueue()
        self._changed = threading.Event()
        changes = self._client.changes()
        threading.Thread(target=self._follow, args=(changes,), name="changes", daemon=True).start()
        threading.Thread(target=self._read_images, name="images", daemon=True).start()
        for topic in (KEYFRAME, POSE_UPDATE):
            self._bus.listen(topic, robot, self._samples.put)
        threading.Thread(target=self._read_archive, name="archive", daemon=True).start()

    def _follow(self, changes: Changes) -> None:
        for _ in changes:
            self._changed.set()

    def wait(self, timeout_s: float) -> bool:
        changed = self._changed.wait(timeout_s)
        self._changed.clear()
        return changed

    def _read_archive(self) -> None:
        """Images from before the page was opened, as far as they are kept."""
        first = 0
        with contextlib.suppress(BusError):  # no ingest, no images
            while True:
                reply: ArchiveReply = self._bus.ask(ARCHIVE, ArchiveRequest(robot=self.robot, first_frame_id=first))
                if not reply.keyframes:
                    return
                self._samples.put(reply)
                first = reply.keyframes[-1].frame_id + 1

    def _read_images(self) -> None:
        while (arrived := self._samples.get()) is not None:
            with contextlib.suppress(DecodeError, InputRefused):  # no service takes it either
                if isinstance(arrived, ArchiveReply):
                    for keyframe in arrived.keyframes:
                        self._take_image(keyframe)
                else:
                    message = decode(arrived.topic.type, arrived.payload)
                    if isinstance(message, PoseUpdate):
                        self.cloud.move(self._poses.take(message) or {})
                    elif isinstance(message, Keyframe):
                        self._take_image(message)
            self._changed.set()

    def _take_image(self, keyframe: Keyframe) -> None:
        if keyframe.frame_id in self.cloud:
            return
        pose = self._poses.pose(keyframe.frame_id, keyframe.world_from_camera)
        with contextlib.suppress(ImageFault):  # the map has refused such a keyframe, too
            frame = msgspec.structs.replace(keyframe, world_from_camera=pose)
            self.cloud.add(frame)
            self._cameras.append(camera_of(frame))

    def stamps(self) -> list[int]:
        return [revision.stamp_ns for revision in self._revisions]

    def scene(self, moment: int | None = None) -> Scene:
        revisions = self._revisions
        if moment is not None and revisions:
            revision = revisions[min(moment, len(revisions) - 1)].revision
            return self._client.scene(revision=revision).message
        scene = self._client.scene().message
        if not revisions or revisions[-1].revision != scene.revision:
            self._revisions = self._client.history(MOST_REVISIONS)
        return scene

    def camera(self, until_ns: float = np.inf) -> Camera | None:
        seen = [camera for camera in list(self._cameras) if camera.stamp_ns <= until_ns]
        return max(seen, key=lambda camera: camera.stamp_ns, default=None)

    def likeness(self, scene: Scene, text: str) -> Likeness:
        return Likeness(*self._client.likeness(text))

    def explain(self, place_id: int, say: Say) -> PosteriorReply:
        return self._client.explain(place_id)

    def prior(self, digest: str) -> Prior | None:
        return self._client.prior_of(digest) if digest else None

    def health(self) -> Health | None:
        return self._client.health()

    def switch(self, task: str, environment: str, say: Say) -> str:
        since_s = time.monotonic()
        switch = self._client.switch(
            task, environment or None, None, TASK_WAIT_S, waiting=say, on_prior=lambda prior: say(prior.provenance.note)
        )
        took_s = time.monotonic() - since_s
        count = len(switch.scene.regions)
        return f"{count} regions, {switch.seconds:.1f} s after the task (with its prior {took_s:.1f} s)"

    def close(self) -> None:
        self._samples.put(None)
        self._client.close()
