"""A worker of the encoding pool: keyframes in, feature pyramids and detected objects out; answers text queries."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.objects import Detections
from prior_sg.schemas.priors import PriorRequest, TaskRequest
from prior_sg.schemas.topics import DETECTIONS, ENCODE, PRIOR, PRIORS, PYRAMID, TASK, TASK_IN_FORCE, TEXT
from prior_sg.services import intent
from prior_sg.services.feature_pyramid.core.crops import Config, Selection, coarse_surface, select_crops
from prior_sg.services.feature_pyramid.detectors.base import Detector, Found, Shot, lift, load_detector, object_crops
from prior_sg.services.feature_pyramid.encoders.base import Encoder, Options, load_encoder, space_of
from prior_sg.services.intent import Vocabulary
from prior_sg.services.runtime.service import Ask, Identity, Output, Service

QUESTIONS = {TaskRequest: TASK_IN_FORCE, PriorRequest: PRIORS}


class View(NamedTuple):
    """A keyframe, read: what is left to do is the encoder's."""

    selection: Selection
    sought: tuple[str, ...]  # names of the objects that the detector was asked for
    found: list[Found]  # objects
    points_camera_m: list[np.ndarray]  # of each object, (point, 3)
    crops: list[np.ndarray]  # RGB, uint8 (side, side, 3): those selected, then one of each object
    surface_m: np.ndarray
    broken: bool


@dataclass
class Worker:
    """Loaded weights, what to look for, the keyframes that are being made ready, and how many could not be read."""

    instance: str
    encoder: Encoder
    detector: Detector
    vocabulary: Vocabulary = field(default_factory=Vocabulary)
    broken: int = 0
    reader: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, thread_name_prefix="reader"))
    views: dict[tuple[str, int], Future[View]] = field(default_factory=dict)  # by robot and frame
    encoded: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)


class BrokenImage(ValueError):
    """The image bytes of a keyframe cannot be used."""


def init(cfg: Config, identity: Identity) -> Worker:
    """Load the encoder of the configured space and the detector. Raises EncoderUnavailable."""
    options = Options(cfg.threads, cfg.batch_size, cfg.runtime, cfg.device)
    return Worker(identity.instance, load_encoder(cfg.space, options), load_detector(cfg))


def prepare(state: Worker, messages: list[Message], cfg: Config) -> None:
    """Read the keyframes that wait, on a thread of their own, while the encoder is at work on others."""
    for frame in messages:
        if isinstance(frame, Keyframe) and _key(frame) not in state.views:
            sought = look_for(state, frame.robot, cfg)
            state.views[_key(frame)] = state.reader.submit(view, frame, state.detector, sought, cfg)


def step(state: Worker, message: Message, cfg: Config) -> Iterator[Output]:
    """A pyramid and detections per keyframe, empty when nothing is found or an image is broken: the job is done.

    A detector that is not yet told what to look for has not looked: its keyframes have no detections.
    """
    if not isinstance(message, Keyframe):
        intent.hear(state.vocabulary, message)
        return
    if state.detector.prompted and not cfg.detector_prompts:
        for question in intent.questions(state.vocabulary, message.robot):
            yield Ask(QUESTIONS[type(question)], question)
    key, sought = _key(message), look_for(state, message.robot, cfg)
    waiting = state.views.pop(key, None)
    seen = None if waiting is None else waiting.result()
    if seen is None or seen.sought != sought:  # made ready before the prior changed
        state.encoded.pop(key, None)
        seen = view(message, state.detector, sought, cfg)
    state.broken += seen.broken
    embeddings = state.encoded.pop(key) if key in state.encoded else encode(state, seen)
    split = len(seen.selection.crops)
    yield PYRAMID, pyramid(state, message, seen, embeddings[:split])
    if sought or not state.detector.prompted:
        yield DETECTIONS, detections(state, message, seen, embeddings[split:])


def look_for(state: Worker, robot: str, cfg: Config) -> tuple[str, ...]:
    """Names of the objects that the detector is asked for: those of the settings, else of the robot's prior."""
    if not state.detector.prompted:
        return ()
    return cfg.detector_prompts or intent.objects(state.vocabulary, robot)


def view(frame: Keyframe, detector: Detector, sought: tuple[str, ...], cfg: Config) -> View:
    """Decode a keyframe, select its crops by depth, and detect; neither crops nor objects when an image is broken."""
    try:
        color, depth_m, broken = read_color(frame), read_depth(frame), False
    except BrokenImage:
        color, depth_m = blank(frame)
        broken = True
    camera = frame.intrinsics
    selection = select_crops(depth_m, camera, cfg)
    found = [] if broken else detector.detect(Shot(color, depth_m, camera, frame.world_from_camera), sought)
    found, points_camera_m = lift(found, depth_m, camera, cfg)
    crops = selection.crops.cut(color) + object_crops(found, camera.width_px, camera.height_px).cut(color)
    return View(selection, sought, found, points_camera_m, crops, coarse_surface(depth_m, cfg.surface_cell_px), broken)


def encode(state: Worker, seen: View) -> np.ndarray:
    """Embeddings of the crops; a batch that they do not fill takes in those of keyframes that are ready and waiting."""
    joined: dict[tuple[str, int], View] = {}
    crops = list(seen.crops)
    for key, waiting in state.views.items():
        if len(crops) >= state.encoder.batch_size or not waiting.done() or waiting.exception() is not None:
            break
        if key not in state.encoded:
            joined[key] = waiting.result()
            crops += joined[key].crops
    embeddings = state.encoder.encode_images(crops)
    start = len(seen.crops)
    for key, other in joined.items():
        state.encoded[key] = embeddings[start : start + len(other.crops)]
        start += len(other.crops)
    return embeddings[: len(seen.crops)]


def pyramid(state: Worker, frame: Keyframe, seen: View, embeddings: np.ndarray) -> Pyramid:
    """What integration needs of a keyframe (eq. feature_pyramid)."""
    crops = seen.selection.crops
    return Pyramid(
        robot=frame.robot,
        frame_id=frame.frame_id,
        stamp_ns=frame.stamp_ns,
        space=state.encoder.space,
        worker=state.instance,
        intrinsics=frame.intrinsics,
        world_from_camera=frame.world_from_camera.copy(),
        centers_px=crops.centers_px,
        sigmas_px=crops.sigmas_px,
        layers=crops.layers,
        depths_m=seen.selection.depths_m,
        embeddings=embeddings.astype(np.float16),
        surface_m=seen.surface_m,
        crops_total=seen.selection.candidates,
    )


def detections(state: Worker, frame: Keyframe, seen: View, embeddings: np.ndarray) -> Detections:
    """What association over time needs of a keyframe; also without objects, for a look that finds nothing counts."""
    return Detections(
        robot=frame.robot,
        frame_id=frame.frame_id,
        stamp_ns=frame.stamp_ns,
        space=state.encoder.space,
        detector=state.detector.name,
        prompted=state.detector.prompted,
        worker=state.instance,
        intrinsics=frame.intrinsics,
        world_from_camera=frame.world_from_camera.copy(),
        boxes_px=np.array([one.box_px for one in seen.found], np.float32).reshape(-1, 4),
        scores=np.array([one.score for one in seen.found], np.float32),
        embeddings=embeddings.astype(np.float16),
        point_counts=np.array([len(points_m) for points_m in seen.points_camera_m], np.int32),
        points_camera_m=np.concatenate([np.zeros((0, 3)), *seen.points_camera_m]).astype(np.float16),
        surface_m=seen.surface_m.astype(np.float16),
        sought=list(seen.sought),
        names=np.array([one.name for one in seen.found if seen.sought], np.int16),
    )


def read_color(frame: Keyframe) -> np.ndarray:
    """RGB image, uint8 (h, w, 3). Raises BrokenImage."""
    return _decode(frame.color, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION, frame)


def read_depth(frame: Keyframe) -> np.ndarray:
    """Depth in metres, float32 (h, w), 0 = no measurement. Raises BrokenImage."""
    raw = _decode(frame.depth, cv2.IMREAD_UNCHANGED, frame)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise BrokenImage(f"depth of frame {frame.frame_id} is not a 16 bit image with one channel")
    return raw.astype(np.float32) * np.float32(frame.depth_scale_m)


def blank(frame: Keyframe) -> tuple[np.ndarray, np.ndarray]:
    """An image without any measurement, in place of a broken one."""
    size = (frame.intrinsics.height_px, frame.intrinsics.width_px)
    return np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)


def answer_text(state: Worker, request: TextRequest, cfg: Config) -> TextEmbeddings:
    """Descriptors of concepts. Raises ValueError for another space or a concept without phrases."""
    if request.space != state.encoder.space:
        raise ValueError(f"this worker serves the space {state.encoder.space}, not {request.space}")
    return state.encoder.encode_text(request.concepts)


def _key(frame: Keyframe) -> tuple[str, int]:
    return frame.robot, frame.frame_id


def _decode(data: bytes, mode: int, frame: Keyframe) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:
        raise BrokenImage(f"frame {frame.frame_id}: {error}") from error
    size = (frame.intrinsics.height_px, frame.intrinsics.width_px)
    if image is None or image.shape[:2] != size:
        raise BrokenImage(f"frame {frame.frame_id}: not an image of {size[1]} x {size[0]} pixels")
    return image


SERVICE = Service(
    name="feature_pyramid",
    purpose="Encodes keyframes as feature pyramids, detects objects in them, and encodes text as concept descriptors",
    scope="fleet",
    config=Config,
    init=init,
    step=step,
    reads=(TASK, PRIOR),
    writes=(PYRAMID, DETECTIONS),
    asks=(TASK_IN_FORCE, PRIORS),
    answers={TEXT: answer_text},
    job=ENCODE,
    job_group=lambda cfg: space_of(cfg.space),
    prepare=prepare,
    key_fields=lambda cfg: {"space": space_of(cfg.space)},
    close=lambda state: state.reader.shutdown(wait=False, cancel_futures=True),
    replay_tolerance=2e-3,  # of half-precision embeddings
)
