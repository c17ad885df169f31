"""A worker of the encoding pool: keyframes in, feature pyramids out; answers text queries of its embedding space."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from schemas.codec import Message
from schemas.features import Pyramid, TextEmbeddings, TextRequest
from schemas.frames import Keyframe
from schemas.topics import ENCODE, PYRAMID, TEXT
from services.feature_pyramid.core import Config, coarse_surface, select_crops
from services.feature_pyramid.encoders import Encoder, load_encoder
from services.runtime.service import Identity, Output, Service


@dataclass
class Worker:
    """Loaded weights, and how many keyframes could not be read."""

    instance: str
    encoder: Encoder
    broken: int = 0


class BrokenImage(ValueError):
    """The image bytes of a keyframe cannot be used."""


def init(cfg: Config, identity: Identity) -> Worker:
    """Load the encoder of the configured space. Raises EncoderUnavailable."""
    return Worker(identity.instance, load_encoder(cfg.space, cfg.threads, cfg.batch_size))


def step(state: Worker, message: Message, cfg: Config) -> Iterator[Output]:
    """One pyramid per keyframe, empty when no crop survives or an image is broken: the job is done either way."""
    if not isinstance(message, Keyframe):
        return
    try:
        color, depth_m = read_color(message), read_depth(message)
    except BrokenImage:
        state.broken += 1
        color, depth_m = blank(message)
    yield PYRAMID, build_pyramid(state, message, color, depth_m, cfg)


def build_pyramid(state: Worker, frame: Keyframe, color: np.ndarray, depth_m: np.ndarray, cfg: Config) -> Pyramid:
    """Select crops by depth, encode them (eq. feature_pyramid). `color` uint8 (h, w, 3) RGB, `depth_m` (h, w)."""
    selection = select_crops(depth_m, frame.intrinsics, cfg)
    embeddings = state.encoder.encode_images(selection.crops.cut(color))
    return Pyramid(
        robot=frame.robot,
        frame_id=frame.frame_id,
        stamp_ns=frame.stamp_ns,
        space=state.encoder.space,
        worker=state.instance,
        intrinsics=frame.intrinsics,
        world_from_camera=frame.world_from_camera.copy(),
        centers_px=selection.crops.centers_px,
        sigmas_px=selection.crops.sigmas_px,
        layers=selection.crops.layers,
        depths_m=selection.depths_m,
        embeddings=embeddings.astype(np.float16),
        surface_m=coarse_surface(depth_m, cfg.surface_cell_px),
        crops_total=selection.candidates,
    )


def read_color(frame: Keyframe) -> np.ndarray:
    """RGB image, uint8 (h, w, 3). Raises BrokenImage."""
    return _decode(frame.color, cv2.IMREAD_COLOR_RGB, frame)


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
    purpose="Encodes keyframes as feature pyramids and text as concept descriptors",
    scope="fleet",
    config=Config,
    init=init,
    step=step,
    writes=(PYRAMID,),
    answers={TEXT: answer_text},
    job=ENCODE,
    key_fields=lambda cfg: {"space": cfg.space},
    replay_tolerance=2e-3,  # of half-precision embeddings
)
