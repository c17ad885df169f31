"""A run that is over: its log with every revision and image, or the store's database with every revision."""

import bisect
import contextlib
import logging
import threading
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.deploy.api.client import Health
from prior_sg.deploy.api.history import History, open_history
from prior_sg.deploy.api.scene import Scene as AskedScene
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.inspecting import replay
from prior_sg.deploy.viewing.cloud import Cloud, small_image
from prior_sg.deploy.viewing.sources import Camera, Likeness, Say
from prior_sg.schemas.codec import DecodeError, Message, copied, decode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.topics import KEYFRAME, POSE_UPDATE, POSTERIOR, PRIOR
from prior_sg.services.deltas import PoseCorrections
from prior_sg.services.images import ImageFault
from prior_sg.services.refusals import InputRefused
from prior_sg.services.runtime.record import LogError, Logged, read_log
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.scene_store.storage import is_url

logger = logging.getLogger(__name__)
IMAGE_PX = 320
LIVE_ONLY = "this is a recording; a task can be given to a running system (`prior-sg up`, then `prior-sg view`)"


class Recorded:
    """One robot of a history; with a log also its images, points, priors and votes, read on a thread of their own."""

    live = False

    def __init__(self, history: History, robot: str, title: str, log: Path | None = None) -> None:
        self.robot, self.title, self.cloud = robot, title, Cloud()
        self._history, self._log = history, log
        self._revisions = history.revisions(robot)
        if not self._revisions:
            others = f"; name one of {', '.join(history.robots)} with --robot" if history.robots else ""
            raise UserError(f"{title} holds no scene of {robot}{others}")
        self._cameras: list[Camera] = []
        self._priors: dict[str, Prior] = {}
        self._segmenter: Runner | None = None
        self._open = contextlib.ExitStack()
        self._asking = threading.Lock()
        self._closed = threading.Event()
        self._reader = threading.Thread(target=self._read_log, name="images", daemon=True)
        self._reader.start()

    def _read_log(self) -> None:
        poses = PoseCorrections()
        try:
            for logged in [] if self._log is None else read_log(self._log, (KEYFRAME, POSE_UPDATE, PRIOR)):
                if self._closed.is_set():
                    return
                with contextlib.suppress(DecodeError, InputRefused):  # no service took it either
                    self._take(logged, poses)
        except LogError as error:
            logger.warning("the rest of the images is not shown: %s", error)

    def _take(self, logged: Logged, poses: PoseCorrections) -> None:
        message = decode(logged.topic.type, logged.payload)
        if isinstance(message, Prior):
            self._priors[message.digest()] = message
        elif robot_of(message) != self.robot:
            return
        elif isinstance(message, PoseUpdate):
            self.cloud.move(poses.take(message) or {})
        elif isinstance(message, Keyframe):
            with contextlib.suppress(ImageFault):  # the map has refused such a keyframe, too
                pose = poses.pose(message.frame_id, message.world_from_camera)
                frame = msgspec.structs.replace(message, world_from_camera=pose)
                self.cloud.add(frame)
                self._cameras.append(camera_of(frame))

    def stamps(self) -> list[int]:
        return [revision.stamp_ns for revision in self._revisions]

    def scene(self, moment: int | None = None) -> Scene:
        revision = self._revisions[-1 if moment is None else min(moment, len(self._revisions) - 1)]
        return self._history.scene(self.robot, revision.revision).message

    def wait(self, timeout_s: float) -> bool:
        self._closed.wait(timeout_s)
        return False

    def camera(self, until_ns: float = np.inf) -> Camera | None:
        cameras = list(self._cameras)
        at = bisect.bisect_right([camera.stamp_ns for camera in cameras], until_ns)
        return cameras[at - 1] if at else None

    def likeness(self, scene: Scene, text: str) -> Likeness:
        return Likeness(*AskedScene(scene, self.prior(scene.prior_digest)).likeness(text))

    def explain(self, place_id: int, say: Say) -> PosteriorReply:
        if self._log is None:
            raise UserError("a database holds beliefs but no votes; open the run's folder or log.mcap to see why")
        with self._asking:
            if self._segmenter is None:
                say("feeding the recording to its segmenter once more")
                log = replay.open_log(self._log, "segmenter")
                lives = [life for life in log.lives if life.started.robot == self.robot]
                if not lives:
                    raise LogError(f"{self._log} holds no segmenter of {self.robot}")
                self._segmenter = self._open.enter_context(replay.final(log, lives[-1]))
            asked = PosteriorRequest(robot=self.robot, place_id=place_id)
            reply: PosteriorReply = self._segmenter.answer(POSTERIOR, asked)
        if not reply.found:
            raise UserError(f"at the end of the recording there is no labelled place {place_id}")
        return reply

    def prior(self, digest: str) -> Prior | None:
        return self._priors.get(digest)

    def health(self) -> Health | None:
        return None

    def switch(self, task: str, environment: str, say: Say) -> str:
        raise UserError(LIVE_ONLY)

    def close(self) -> None:
        self._closed.set()
        self._reader.join()
        with self._asking:
            self._open.close()
        self._history.close()


def robot_of(message: Message) -> str:
    """Whose message it is."""
    return str(getattr(message, "robot", ""))


def camera_of(frame: Keyframe) -> Camera:
    """What the page shows of a keyframe. Raises ImageFault."""
    image = small_image(frame, IMAGE_PX)
    depth = copied(msgspec.structs.replace(frame, color=b""))
    return Camera(frame.frame_id, frame.stamp_ns, frame.intrinsics, depth.world_from_camera, image, depth)


def open_recorded(place: str, robot: str) -> Recorded:
    """A run's folder, a log, or a database by its file or address. Raises UserError, LogError, StoreError."""
    if is_url(place):
        return Recorded(open_history(place), robot, "database")
    path = Path(place)
    if path.is_dir():
        found = [path / name for name in ("log.mcap", "scene.sqlite") if (path / name).exists()]
        if not found:
            raise UserError(f"{path} holds neither log.mcap nor scene.sqlite; name the folder of a run")
        path = found[0]
    if not path.exists():
        raise UserError(f"{path} does not exist; make a run with `prior-sg demo`")
    log = path if path.suffix == ".mcap" else None
    return Recorded(open_history(path), robot, path.name if log is None else f"recording {path.name}", log)
