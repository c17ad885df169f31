"""The camera of a source's images: as told, scaled to their size, and the lens that is to be straightened."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.options import ReadOptions, check_lens
from prior_sg.services.ingest.sources.base import Camera, Found
from prior_sg.services.ingest.sources.tables import SourceError
from prior_sg.services.opencv import cv2

ASPECT_TOLERANCE = 0.01
EDGE = 0.45  # share of the image by which a principal point may be off its middle; a crop may have 0.4
NORMALISED = 10.0  # a focal length below is no number of pixels


@dataclass(frozen=True)
class Sizes:
    """Width and height, pixels, that most images of a source have."""

    color: tuple[int, int]
    depth: tuple[int, int]


def camera_of_images(found: Found, options: ReadOptions, sizes: Sizes, notes: list[str]) -> Camera:
    """The camera of the depth images. Raises SourceError."""
    camera = _told(found.camera, options)
    try:
        check_lens(camera.model, camera.distortion)
    except ValueError as error:
        raise SourceError(f"the camera of {found.path} cannot be: {error}") from error
    own = (camera.intrinsics.width_px, camera.intrinsics.height_px)
    if not _same_aspect(sizes.color, sizes.depth):
        raise SourceError(
            f"the colour images of {found.path} have {_by(sizes.color)} pixels and the depth images "
            f"{_by(sizes.depth)}: they do not show the same view; register depth to colour first"
        )
    if sizes.color != sizes.depth:
        notes.append(f"colour of {_by(sizes.color)} pixels is resampled onto depth's {_by(sizes.depth)}")
    if own != sizes.depth:
        if not _same_aspect(own, sizes.depth):
            raise SourceError(
                f"the camera of {found.path} is for {_by(own)} pixels, the images have {_by(sizes.depth)}: "
                "give --intrinsics FX,FY,CX,CY,WIDTH,HEIGHT for the images as they are"
            )
        notes.append(f"the camera of {_by(own)} pixels is scaled to the images' {_by(sizes.depth)}")
        camera = replace(camera, intrinsics=scaled(camera.intrinsics, sizes.depth))
    _check_pixels(camera, found.path)
    _check_principal_point(camera, found.path)
    if camera.model == "fisheye" or any(camera.distortion):
        notes.append(f"images are undistorted ({camera.model or 'opencv'} lens, {len(camera.distortion)} coefficients)")
    return camera


def _told(camera: Camera, options: ReadOptions) -> Camera:
    """The camera with what the user says instead."""
    model = options.camera_model or ("" if options.distortion else camera.model)
    distortion = tuple(options.distortion) or (() if options.camera_model == "pinhole" else camera.distortion)
    intrinsics, published = camera.intrinsics, camera.published
    if options.intrinsics:
        size = options.intrinsics[4:] or (intrinsics.width_px, intrinsics.height_px)
        intrinsics, published = Intrinsics(int(size[0]), int(size[1]), *options.intrinsics[:4]), False
    return Camera(intrinsics, "" if model == "pinhole" else model, () if model == "pinhole" else distortion, published)


def _same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return abs(a[0] * b[1] - a[1] * b[0]) <= ASPECT_TOLERANCE * max(a[0] * b[1], a[1] * b[0])


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def scaled(camera: Intrinsics, size: tuple[int, int]) -> Intrinsics:
    """The camera of the same picture with another number of pixels."""
    x, y = size[0] / camera.width_px, size[1] / camera.height_px
    center = (camera.cx_px + 0.5) * x - 0.5, (camera.cy_px + 0.5) * y - 0.5
    return Intrinsics(*size, camera.fx_px * x, camera.fy_px * y, *center)


def _check_pixels(camera: Camera, path: Path) -> None:
    """Raise SourceError for a camera in shares of the image."""
    of = camera.intrinsics
    if min(of.fx_px, of.fy_px) >= NORMALISED:
        return
    x, y = of.width_px, of.height_px
    like = ",".join(f"{value:.6g}" for value in (of.fx_px * x, of.fy_px * y, of.cx_px * x, of.cy_px * y))
    raise SourceError(
        f"the camera of {path} has fx = {of.fx_px:.4g}, fy = {of.fy_px:.4g}: these are shares of the image, not "
        f"pixels; multiply fx and cx by the width and fy and cy by the height: --intrinsics {like}"
    )


def _check_principal_point(camera: Camera, path: Path) -> None:
    of = camera.intrinsics
    for name, center, size in (("x", of.cx_px, of.width_px), ("y", of.cy_px, of.height_px)):
        if not camera.published and not abs(center - (size - 1) / 2) <= EDGE * size:
            raise SourceError(
                f"the camera of {path} has its principal point at {name} = {center:.1f} of {size} pixels, outside the "
                "image: it belongs to another image size; give --intrinsics FX,FY,CX,CY,WIDTH,HEIGHT"
            )


def straight_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray] | None:
    """Where the pixels of a straight image lie in a bent one, (h, w) each; None for a pinhole."""
    if camera.model != "fisheye" and not any(camera.distortion):
        return None
    of = camera.intrinsics
    matrix = np.array(((of.fx_px, 0, of.cx_px), (0, of.fy_px, of.cy_px), (0, 0, 1)))
    size = (of.width_px, of.height_px)
    if camera.model == "fisheye":
        coefficients = np.array(camera.distortion or (0.0,) * 4)
        return cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
    x, y = cv2.initUndistortRectifyMap(matrix, np.array(camera.distortion), np.eye(3), matrix, size, cv2.CV_32FC1)
    return x, y
