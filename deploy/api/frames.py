"""A frame from arrays in memory."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.pixels import encoded, millimetres
from prior_sg.services.ingest.sources.base import MILLIMETRE, SourceError


def frame_of(
    number: int,
    *,
    color: NDArray[np.uint8],
    depth: NDArray[Any],
    intrinsics: Intrinsics | ArrayLike,
    world_from_camera: ArrayLike,
    stamp_ns: int,
) -> RawFrame:
    """The frame of these arrays, as in `Mapper.add`; images are kept as PNG, depth to the millimetre.

    Raises SourceError.
    """
    color, depth = np.asarray(color), np.asarray(depth)
    if color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8:
        raise SourceError(f"color must be uint8 of shape (h, w, 3); got {color.dtype} of shape {color.shape}")
    if depth.shape != color.shape[:2]:
        raise SourceError(f"depth must have the shape {color.shape[:2]} of color; got {depth.shape}")
    try:
        return RawFrame(
            frame_id=number,
            stamp_ns=int(stamp_ns),
            intrinsics=_camera(intrinsics, color.shape[1], color.shape[0]),
            world_from_camera=np.array(world_from_camera, np.float64).reshape(4, 4),
            color=encoded(np.ascontiguousarray(color[:, :, ::-1]), ".png"),
            depth=_depth_png(depth),
            depth_scale_m=MILLIMETRE,
            index=number,
            total=0,
        )
    except ValueError as error:
        raise SourceError(f"frame {number} cannot be used: {error}") from error


def _camera(intrinsics: Intrinsics | ArrayLike, width_px: int, height_px: int) -> Intrinsics:
    if isinstance(intrinsics, Intrinsics):
        size = (intrinsics.width_px, intrinsics.height_px)
        if size != (width_px, height_px):
            raise ValueError(f"the camera has {size[0]} x {size[1]} pixels, the images {width_px} x {height_px}")
        return intrinsics
    matrix = np.array(intrinsics, np.float64)
    if matrix.shape != (3, 3):
        raise ValueError(f"intrinsics must be an Intrinsics or a matrix (3, 3); got shape {matrix.shape}")
    return Intrinsics(width_px, height_px, *matrix[(0, 1, 0, 1), (0, 1, 2, 2)].tolist())


def _depth_png(depth: NDArray[Any]) -> bytes:
    if depth.dtype == np.uint16:
        return encoded(np.ascontiguousarray(depth), ".png")
    if not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(f"depth must be float in metres or uint16 in millimetres; got {depth.dtype}")
    return encoded(millimetres(depth), ".png")
