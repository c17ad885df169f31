"""What is done to each frame of a source, once that is known: sizes, lens, depth units, pose and origin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.headers import JPEG_MAGIC, ImageError, is_sized, trimmed
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.pixels import encoded, measured, millimetres, stored
from prior_sg.services.ingest.core.poses import PoseError, rigid
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    FrameError,
    Images,
    color_pixels,
    depth_pixels,
)
from prior_sg.services.ingest.sources.cameras import Sizes
from prior_sg.services.opencv import cv2

UNUSABLE = (FrameError, PoseError, ImageError)


@dataclass(frozen=True)
class Depth:
    """How depth images are read."""

    scale_m: float  # metres per unit of whole numbers
    float_scale_m: float  # the same of floating-point numbers
    invalid: tuple[float, ...]
    nearest_m: float
    farthest_m: float  # 0 = no limit
    unit_m: float  # metres per unit of the numbers that most images hold


@dataclass(frozen=True)
class Normaliser:
    """What is done to every frame of a source."""

    intrinsics: Intrinsics
    sizes: Sizes
    depth: Depth
    maps: tuple[np.ndarray, np.ndarray] | None  # where the pixels of a straight image lie in a bent one
    world_from_source: np.ndarray | None  # None = nothing to be done, so that poses pass unchanged
    origin_m: tuple[float, float, float]  # where the frames' world has its zero in the source's, levelled
    camera: str = ""  # its name, where the robot has several

    def frame(  # noqa: PLR0917
        self, index: int, total: int, frame_id: int, stamp_ns: int, source_from_camera: np.ndarray, images: Images
    ) -> RawFrame:
        """A frame whose images fit the camera and whose pose is a rigid motion. Raises one of UNUSABLE."""
        depth, depth_scale_m = self.depth_image(images.depth)
        try:
            return RawFrame(
                frame_id=frame_id,
                stamp_ns=stamp_ns,
                intrinsics=self.intrinsics,
                world_from_camera=self.pose(source_from_camera),
                color=self.color_image(images.color),
                depth=depth,
                mask=self.mask_image(images.mask),
                depth_scale_m=depth_scale_m,
                index=index,
                total=total,
                origin_m=self.origin_m,
                camera=self.camera,
            )
        except UNUSABLE:
            raise
        except ValueError as error:
            raise FrameError(str(error)) from error

    def bare(  # noqa: PLR0917
        self, index: int, total: int, frame_id: int, stamp_ns: int, source_from_camera: np.ndarray, images: Images
    ) -> RawFrame:
        """The frame without its images, of which only the files' headers and ends are looked at. Raises UNUSABLE."""
        kinds = (images.color, self.sizes.color, "colour"), (images.depth, self.sizes.depth, "depth")
        for data, expected, name in kinds:
            if isinstance(data, bytes) and is_sized(data):
                width_px, height_px, _ = measured(trimmed(data))
                self._check_size((width_px, height_px), expected, name)
        return RawFrame(
            frame_id=frame_id,
            stamp_ns=stamp_ns,
            intrinsics=self.intrinsics,
            world_from_camera=self.pose(source_from_camera),
            color=b"",
            depth=b"",
            depth_scale_m=self.depth.scale_m,
            index=index,
            total=total,
            camera=self.camera,
        )

    def pose(self, source_from_camera: np.ndarray) -> np.ndarray:
        """world_from_camera (4, 4), or of several (n, 4, 4). Raises PoseError."""
        pose = np.asarray(source_from_camera, np.float64)
        pose = rigid(pose) if pose.ndim == 2 else pose
        return pose if self.world_from_source is None else self.world_from_source @ pose

    def color_image(self, data: bytes | None) -> bytes:
        """The file where it fits, else a JPEG of a JPEG and a PNG of all else; empty for none. Raises UNUSABLE."""
        if data is None:
            return b""
        try:
            width_px, height_px, bits = measured(data)
        except ImageError as error:
            raise FrameError(f"the colour image is damaged: {error}") from error
        self._check_size((width_px, height_px), self.sizes.color, "colour")
        target = (self.intrinsics.width_px, self.intrinsics.height_px)
        if is_sized(data) and bits == 8 and self.sizes.color == target and self.maps is None:
            return trimmed(data)
        image = color_pixels(data)
        if self.sizes.color != target:
            image = cv2.resize(image, target, interpolation=cv2.INTER_AREA)
        if self.maps is not None:
            image = cv2.remap(image, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return encoded(image, ".jpg" if data.startswith(JPEG_MAGIC) else ".png")

    def depth_image(self, data: bytes | np.ndarray) -> tuple[bytes, float]:
        """A PNG of 16 bits, 0 = no measurement, and metres per unit. Raises UNUSABLE."""
        units, scale_m = self._depth_units(data)
        measured_m = units.astype(np.float64) * scale_m
        kept = valid_depth(units, () if isinstance(data, np.ndarray) else self.depth.invalid)
        kept &= measured_m >= self.depth.nearest_m
        kept &= (measured_m <= self.depth.farthest_m) if self.depth.farthest_m else True
        if units.dtype == np.uint16:
            untouched = bool((kept | (units == 0)).all()) and self.maps is None
            if untouched and isinstance(data, bytes) and is_sized(data):
                return trimmed(data), scale_m
            return encoded(self._straight(np.where(kept, units, 0).astype(np.uint16)), ".png"), scale_m
        return encoded(self._straight(millimetres(np.where(kept, measured_m, 0))), ".png"), MILLIMETRE

    def mask_image(self, data: bytes) -> bytes:
        """The mask at depth's size, straight where the lens bends."""
        target = (self.intrinsics.width_px, self.intrinsics.height_px)
        if not data or (self.sizes.color == target and self.maps is None):
            return data
        try:
            mask = stored(data)
        except ImageError as error:
            raise FrameError(f"the mask image is damaged: {error}") from error
        return encoded(self._straight(cv2.resize(mask, target, interpolation=cv2.INTER_NEAREST)), ".png")

    def _depth_units(self, data: bytes | np.ndarray) -> tuple[np.ndarray, float]:
        """Numbers of a depth image (h, w) as stored, and metres per unit."""
        if isinstance(data, np.ndarray):
            units, scale_m = data, 1.0
        else:
            units = depth_pixels(data)
            scale_m = self.depth.float_scale_m if units.dtype.kind == "f" else self.depth.scale_m
        if units.dtype.itemsize == 1:
            raise FrameError("the depth image has 8 bits per channel instead of 16")
        if units.ndim != 2:
            raise FrameError(f"the depth image has {units.shape[2]} channels instead of one")
        self._check_size((units.shape[1], units.shape[0]), self.sizes.depth, "depth")
        return units, scale_m

    def _straight(self, image: np.ndarray) -> np.ndarray:
        """An image of measurements, without the lens's distortion; no measurement is made up."""
        return image if self.maps is None else cv2.remap(image, *self.maps, cv2.INTER_NEAREST)

    def _check_size(self, size: tuple[int, int], expected: tuple[int, int], name: str) -> None:
        if size != expected:
            whose = "camera" if expected == (self.intrinsics.width_px, self.intrinsics.height_px) else "others"
            raise FrameError(
                f"the {name} image has {size[0]} x {size[1]} pixels, the {whose} {expected[0]} x {expected[1]}"
            )


def valid_depth(units: np.ndarray, invalid: Sequence[float]) -> np.ndarray:
    """Where a depth image (h, w) holds a measurement."""
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(units) & (units > 0) if units.dtype.kind == "f" else units > 0
    for value in invalid:
        if units.dtype != np.float16 or abs(value) <= float(np.finfo(np.float16).max):
            valid &= units != value
    return valid
