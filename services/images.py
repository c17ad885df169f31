"""Colour and depth of a keyframe, decoded, and what can be wrong with them (pure)."""

import numpy as np

from prior_sg.schemas.codec import File
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.headers import ImageError, image_end, image_size
from prior_sg.services.opencv import cv2

MAX_PRINCIPAL_OFFSET = 0.45  # share of the image by which the principal point may be off its middle: crops


class ImageFault(ValueError):
    """A keyframe's images cannot be used; the text is the reason."""


def color_of(keyframe: Keyframe) -> np.ndarray:
    """Colour (h, w, 3) uint8, RGB. Raises ImageFault."""
    mode = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    return _decoded(keyframe.color, keyframe.intrinsics, "colour", mode)


def depth_of(keyframe: Keyframe, max_principal_offset: float) -> np.ndarray:
    """Depth (h, w) float32 in metres, 0 = no measurement or masked. Raises ImageFault.

    The principal point of a camera lies in its image, of a crop not in the middle; farther from this than
    `max_principal_offset` (share of the image), the intrinsics belong to another image size.
    """
    camera = keyframe.intrinsics
    image = _single_channel(keyframe.depth, camera, "depth")
    if image.dtype != np.uint16:
        raise ImageFault(f"the depth image has {8 * image.dtype.itemsize} bits per pixel instead of 16")
    for name, center, size in (("x", camera.cx_px, camera.width_px), ("y", camera.cy_px, camera.height_px)):
        if not abs(center - (size - 1) / 2) <= max_principal_offset * size:
            raise ImageFault(
                f"the principal point, {name} = {center:.1f}, is far from the middle of an image of {size} pixels: "
                "the intrinsics belong to another image size"
            )
    if keyframe.mask:
        image = np.where(_single_channel(keyframe.mask, camera, "mask") == 0, image, 0)
    if not image.any():
        raise ImageFault("the depth image holds no measurement")
    return image.astype(np.float32) * np.float32(keyframe.depth_scale_m)


def blank_of(keyframe: Keyframe) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth without any measurement, in place of images that cannot be used; shapes as of those."""
    size = (keyframe.intrinsics.height_px, keyframe.intrinsics.width_px)
    return np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)


def _single_channel(data: File, camera: Intrinsics, name: str) -> np.ndarray:
    image = _decoded(data, camera, name, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise ImageFault(f"the {name} image has {image.shape[2]} channels instead of one")
    return image


def _decoded(data: File, camera: Intrinsics, name: str, mode: int) -> np.ndarray:
    """Decodes only what its header says to be of the camera's size: others may be far larger than they look. OpenCV
    believes each part of a PNG how long it is, up to 2 GB, so one whose parts do not fit in is not given to it."""
    try:
        width_px, height_px, _ = image_size(data)
        _check_size(width_px, height_px, camera, name)
        image = cv2.imdecode(np.frombuffer(data, np.uint8, image_end(data)), mode)
    except (cv2.error, ImageError):
        image = None
    if image is None:
        raise ImageFault(f"the {name} image cannot be decoded")
    return image


def _check_size(width_px: int, height_px: int, camera: Intrinsics, name: str) -> None:
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise ImageFault(
            f"the {name} image has {width_px} x {height_px} pixels, "
            f"the intrinsics are for {camera.width_px} x {camera.height_px}"
        )
