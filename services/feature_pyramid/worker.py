"""What a worker holds, and how a keyframe passes through it: read on a thread of its own, then encoded in batches."""

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.objects import Detections
from prior_sg.services import images, intent
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.crops import Selection, coarse_surface, select_crops
from prior_sg.services.feature_pyramid.core.lift import lift, object_crops
from prior_sg.services.feature_pyramid.core.markers import NO_MARKERS, MarkersSeen, seen_markers
from prior_sg.services.feature_pyramid.core.upright import quarter_turns, turned
from prior_sg.services.feature_pyramid.detectors.base import Detector, Found, Shot
from prior_sg.services.feature_pyramid.encoders.base import Encoder
from prior_sg.services.intent import Intent
from prior_sg.services.losses import Losses

log = logging.getLogger(__name__)
NOT_ENCODED, WITHOUT_CROPS = "keyframes not encoded", "keyframes without crops"
MARKERS_LEFT_OUT = "markers left out"


class View(NamedTuple):
    """A keyframe, read: what is left to do is the encoder's."""

    selection: Selection
    sought: tuple[str, ...]  # names of the objects that the detector was asked for
    found: list[Found]  # objects
    points_camera_m: list[np.ndarray]  # of each object, (point, 3)
    crops: list[np.ndarray]  # RGB, uint8 (side, side, 3), upright: those selected, then one of each object
    surface_m: np.ndarray
    markers: MarkersSeen
    fault: str  # why its images cannot be used; empty = they can


@dataclass
class Worker:
    """Loaded weights, what to look for, the keyframes that are being made ready, and what could not be encoded."""

    instance: str
    encoder: Encoder
    detector: Detector
    vocabulary: Intent = field(default_factory=Intent)
    losses: Losses = field(default_factory=Losses)
    reader: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, thread_name_prefix="reader"))
    views: dict[tuple[str, int], Future[View]] = field(default_factory=dict)  # by robot and frame
    encoded: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)


def prepare(state: Worker, messages: list[Message], cfg: Config) -> None:
    """Read the keyframes that wait, on a thread of their own, while the encoder is at work on others."""
    for frame in messages:
        if isinstance(frame, Keyframe) and _key(frame) not in state.views:
            sought = sought_by(state, frame.robot, cfg)
            state.views[_key(frame)] = state.reader.submit(view, frame, state.detector, sought, cfg)


def look_at(state: Worker, frame: Keyframe, cfg: Config) -> tuple[View, np.ndarray]:
    """What a keyframe shows, read ahead or now, and the embeddings of its crops (crop, dim)."""
    key, sought = _key(frame), sought_by(state, frame.robot, cfg)
    waiting = state.views.pop(key, None)
    seen = None if waiting is None else waiting.result()
    if seen is None or seen.sought != sought:  # made ready before the prior changed
        state.encoded.pop(key, None)
        seen = view(frame, state.detector, sought, cfg)
    if seen.fault:
        state.losses.add(NOT_ENCODED, seen.fault, of=f"keyframe {frame.frame_id}")
        log.warning("keyframe not encoded", extra={"frame": frame.frame_id, "why": seen.fault})
    elif not seen.selection.crops:
        reason = "no depth within range" if not seen.surface_m.any() else "no crop sees enough space at its depth"
        state.losses.add(WITHOUT_CROPS, reason, of=f"keyframe {frame.frame_id}")
        log.warning("keyframe without crops", extra={"frame": frame.frame_id, "why": reason})
    for fault in seen.markers.faults:
        state.losses.add(MARKERS_LEFT_OUT, fault, of=f"keyframe {frame.frame_id}")
    return seen, state.encoded.pop(key) if key in state.encoded else encode(state, seen)


def sought_by(state: Worker, robot: str, cfg: Config) -> tuple[str, ...]:
    """Names of the objects that the detector is asked for: those of the settings, else of the robot's prior."""
    if not state.detector.prompted:
        return ()
    return cfg.detector_prompts or intent.objects(state.vocabulary, robot)


def view(frame: Keyframe, detector: Detector, sought: tuple[str, ...], cfg: Config) -> View:
    """Decode a keyframe, select its crops by depth, and detect; neither crops nor objects when an image is broken."""
    try:
        color, depth_m, fault = images.color_of(frame), images.depth_of(frame, cfg.max_principal_offset), ""
    except images.ImageFault as found_fault:
        (color, depth_m), fault = images.blank_of(frame), str(found_fault)
    camera = frame.intrinsics
    selection = select_crops(depth_m, camera, cfg)
    found = [] if fault else detector.detect(Shot(color, depth_m, camera, frame.world_from_camera), sought)
    found, points_camera_m = lift(found, depth_m, camera, cfg)
    cut = selection.crops.cut(color) + object_crops(found, camera.width_px, camera.height_px).cut(color)
    crops = [turned(crop, quarter_turns(frame.world_from_camera)) for crop in cut]
    markers = NO_MARKERS if fault else seen_markers(color, depth_m, camera, cfg.markers)
    surface_m = coarse_surface(depth_m, cfg.surface_cell_px)
    return View(selection, sought, found, points_camera_m, crops, surface_m, markers, fault)


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


def detections(state: Worker, frame: Keyframe, seen: View, embeddings: np.ndarray, cfg: Config) -> Detections:
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
        marker_dictionary=cfg.markers.dictionary,
        marker_size_m=cfg.markers.size_m,
        marker_ids=seen.markers.ids,
        marker_sides_px=seen.markers.sides_px,
        camera_from_marker=seen.markers.camera_from_marker,
    )


def _key(frame: Keyframe) -> tuple[str, int]:
    return frame.robot, frame.frame_id
