"""Images of a keyframe, decoded."""

import cv2
import numpy as np

from prior_sg.schemas.frames import Keyframe


class BrokenImage(ValueError):
    """The image bytes of a keyframe cannot be used."""


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


def _decode(data: bytes, mode: int, frame: Keyframe) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:
        raise BrokenImage(f"frame {frame.frame_id}: {error}") from error
    size = (frame.intrinsics.height_px, frame.intrinsics.width_px)
    if image is None or image.shape[:2] != size:
        raise BrokenImage(f"frame {frame.frame_id}: not an image of {size[1]} x {size[0]} pixels")
    return image
