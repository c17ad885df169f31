"""Depth images as they arrive, and what can be wrong with them (pure)."""

import cv2
import numpy as np

from prior_sg.schemas.frames import Intrinsics, Keyframe


class ImageFault(ValueError):
    """A keyframe's images cannot be used; the text is the reason."""


def depth_of(keyframe: Keyframe, max_principal_offset: float) -> np.ndarray:
    """Depth (h, w) float32 in metres, 0 = no measurement or masked. Raises ImageFault.

    The principal point of a camera lies in its image, of a crop not in the middle; farther from this than
    `max_principal_offset` (share of the image), the intrinsics belong to another image size.
    """
    camera = keyframe.intrinsics
    image = _decoded(keyframe.depth, "depth")
    _check_size(image, camera, "depth")
    if image.dtype != np.uint16:
        raise ImageFault(f"the depth image has {8 * image.dtype.itemsize} bits per pixel instead of 16")
    for name, center, size in (("x", camera.cx_px, camera.width_px), ("y", camera.cy_px, camera.height_px)):
        if not abs(center - (size - 1) / 2) <= max_principal_offset * size:
            raise ImageFault(
                f"the principal point, {name} = {center:.1f}, is far from the middle of an image of {size} pixels: "
                "the intrinsics belong to another image size"
            )
    if keyframe.mask:
        mask = _decoded(keyframe.mask, "mask")
        _check_size(mask, camera, "mask")
        image = np.where(mask == 0, image, 0)
    if not image.any():
        raise ImageFault("the depth image holds no measurement")
    return image.astype(np.float32) * np.float32(keyframe.depth_scale_m)


def _decoded(data: bytes, name: str) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # empty, or a header that promises an absurd size
        image = None
    if image is None:
        raise ImageFault(f"the {name} image cannot be decoded")
    return image


def _check_size(image: np.ndarray, camera: Intrinsics, name: str) -> None:
    if image.ndim != 2:
        raise ImageFault(f"the {name} image has {image.shape[2]} channels instead of one")
    height_px, width_px = image.shape
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise ImageFault(
            f"the {name} image has {width_px} x {height_px} pixels, "
            f"the intrinsics are for {camera.width_px} x {camera.height_px}"
        )
