"""Depth from the two pictures of a stereo camera (pure)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.opencv import cv2

BLOCK_PX = 5
STEPS_PX = 16  # disparities that SGBM takes are a multiple of this
MOST_SHARE = 0.25  # of the picture's width that disparity may be
NEAREST_PX = 0.5  # disparities below tell nothing of how far away something is
Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Disparity (h, w), pixels of the left picture, not positive = none, of two rectified pictures (h, w[, 3]) uint8."""


@dataclass(frozen=True)
class Lens:
    """One of the two cameras, as it is calibrated."""

    intrinsics: Intrinsics
    model: str = ""  # fisheye, else OpenCV's
    distortion: tuple[float, ...] = ()

    def matrix(self) -> np.ndarray:
        """K, 3 x 3."""
        of = self.intrinsics
        return np.array(((of.fx_px, 0, of.cx_px), (0, of.fy_px, of.cy_px), (0, 0, 1)))


@dataclass(frozen=True)
class Pair:
    """A stereo camera whose pictures can be made rows of one plane."""

    intrinsics: Intrinsics  # of both rectified pictures
    baseline_m: float
    left_from_rectified: np.ndarray  # rotation, as a motion (4, 4)
    maps: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

    @staticmethod
    def of(left: Lens, right: Lens, right_from_left: np.ndarray) -> "Pair":
        """Raises ValueError for cameras that are not beside each other."""
        size = left.intrinsics.width_px, left.intrinsics.height_px
        if size != (right.intrinsics.width_px, right.intrinsics.height_px):
            raise ValueError("the two cameras have pictures of different sizes")
        fisheye = left.model == "fisheye"
        if fisheye != (right.model == "fisheye"):
            raise ValueError("one of the two cameras has a fisheye lens and the other has none")
        of = cv2.fisheye if fisheye else cv2
        ks = left.matrix(), right.matrix()
        ds = [np.array(lens.distortion or (0.0,) * 4) for lens in (left, right)]
        turn, shift = np.ascontiguousarray(right_from_left[:3, :3]), right_from_left[:3, 3:].copy()
        if fisheye:
            r1, r2, p1, p2, _ = cv2.fisheye.stereoRectify(ks[0], ds[0], ks[1], ds[1], size, turn, shift, 0)
        else:
            r1, r2, p1, p2, *_ = cv2.stereoRectify(ks[0], ds[0], ks[1], ds[1], size, turn, shift, alpha=0)
        baseline_m = -p2[0, 3] / p2[0, 0] if p2[0, 0] else 0.0
        if not baseline_m > 0:
            raise ValueError("the right camera is not to the right of the left one: exchange them")
        maps = tuple(
            of.initUndistortRectifyMap(k, d, r, p[:3, :3], size, cv2.CV_32FC1)
            for k, d, r, p in zip(ks, ds, (r1, r2), (p1, p2), strict=True)
        )
        left_from_rectified = np.eye(4)
        left_from_rectified[:3, :3] = r1.T
        focal = Intrinsics(*size, float(p1[0, 0]), float(p1[1, 1]), float(p1[0, 2]), float(p1[1, 2]))
        return Pair(focal, float(baseline_m), left_from_rectified, maps)  # type: ignore[arg-type]

    def rectified(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both pictures as if the cameras looked the same way, side by side."""
        first, second = (
            cv2.remap(picture, *maps, cv2.INTER_LINEAR) for picture, maps in zip((left, right), self.maps, strict=True)
        )
        return first, second

    def depth_m(self, disparity_px: np.ndarray) -> np.ndarray:
        """Depth (h, w), metres, 0 = none."""
        with np.errstate(invalid="ignore"):
            told = np.isfinite(disparity_px) & (disparity_px >= NEAREST_PX)
        return np.divide(
            self.intrinsics.fx_px * self.baseline_m, disparity_px, out=np.zeros(disparity_px.shape), where=told
        )


def semi_global(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Disparity (h, w), pixels, of OpenCV's semi-global matching (Hirschmüller 2008)."""
    most_px = max(1, round(left.shape[1] * MOST_SHARE / STEPS_PX)) * STEPS_PX
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=most_px,
        blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2,
        P2=32 * BLOCK_PX**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    return matcher.compute(left, right).astype(np.float32) / 16.0
