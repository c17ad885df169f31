"""A running system: its scene as the store has it, its images as they arrive.

Images that come faster than they can be drawn wait, the newest of them; the others are fetched from ingest's archive
when there is time, as those from before the page was opened are.
"""

import contextlib
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
MOST_IMAGES = 64  # that wait to be drawn
IDLE_S = 0.5  # without images, before those that were left out are fetched
TASK_WAIT_S = 300.0  # a language model may take minutes


class Images:
    """The newest keyframes that wait; `lacks` says that others exist: those before the first, and those left out."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._samples: deque[Sample] = deque(maxlen=MOST_IMAGES)
        self.lacks, self.closed = True, False

    def put(self, sample: Sample) -> None:
        """Add one, in place of the oldest where there are too many."""
        with self._changed:
            self.lacks |= len(self._samples) == MOST_IMAGES
            self._samples.append(sample)
            self._changed.notify()

    def take(self, timeout_s: float) -> Sample | None:
        """The oldest; None when none has come in time, or it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._samples or self.closed, timeout_s)
            return self._samples.popleft() if self._samples and not self.closed else None

    def close(self) -> None:
        """Wait for nothing more."""
        with self._changed:
            self.closed = True
            self._changed.notify()


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
        self._images = Images()
        self._archived_until = 0  # number of the first keyframe that was not fetched from the archive
        self._drawing = threading.Lock()  # of the cloud and the poses
        self._changed = threading.Event()
        changes = self._client.changes()
        threading.Thread(target=self._follow, args=(changes,), name="changes", daemon=True).start()
        threading.Thread(target=self._read_images, name="images", daemon=True).start()
        self._bus.listen(KEYFRAME, robot, self._images.put)
        self._bus.listen(POSE_UPDATE, robot, self._correct)

    def _follow(self, changes: Changes) -> None:
        for _ in changes:
            self._changed.set()

    def wait(self, timeout_s: float) -> bool:
        changed = self._changed.wait(timeout_s)
        self._changed.clear()
        return changed

    def _correct(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError, InputRefused), self._drawing:  # no service takes it either
            self.cloud.move(self._poses.take(decode(PoseUpdate, sample.payload)) or {})
        self._changed.set()

    def _read_images(self) -> None:
        """Images as they come; when none does, those that the archive has and were left out."""
        while not self._images.closed:
            if not self._draw_next(IDLE_S) and self._images.lacks:
                self._read_archive()

    def _draw_next(self, timeout_s: float) -> bool:
        """Draw the next image that arrives; False when none does in time."""
        if (sample := self._images.take(timeout_s)) is None:
            return False
        with contextlib.suppress(DecodeError):  # no service takes it either
            self._take_image(decode(Keyframe, sample.payload))
        return True

    def _read_archive(self) -> None:
        """Images from before the page was opened, or before there was time, as far as they are kept."""
        self._images.lacks = False
        with contextlib.suppress(BusError):  # no ingest, no images
            while not self._images.closed:
                request = ArchiveRequest(robot=self.robot, first_frame_id=self._archived_until)
                reply: ArchiveReply = self._bus.ask(ARCHIVE, request)
                if not reply.keyframes:
                    return
                for keyframe in reply.keyframes:
                    self._take_image(keyframe)
                self._archived_until = reply.keyframes[-1].frame_id + 1
                while self._draw_next(0.0):
                    continue

    def _take_image(self, keyframe: Keyframe) -> None:
        if keyframe.frame_id in self.cloud:
            return
        with contextlib.suppress(ImageFault), self._drawing:  # the map has refused such a keyframe, too
            pose = self._poses.pose(keyframe.frame_id, keyframe.world_from_camera)
            frame = msgspec.structs.replace(keyframe, world_from_camera=pose)
            self.cloud.add(frame)
            self._cameras.append(camera_of(frame))
        self._changed.set()

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
        self._images.close()
        self._client.close()
