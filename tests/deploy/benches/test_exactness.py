"""The measures of places: surfaces that keyframes agree with, and places found again, by hand."""

import cv2
import numpy as np
import pytest

from prior_sg.deploy.benches.exactness import Places, agreed_points, found, measured_points
from prior_sg.schemas.frames import Intrinsics, Keyframe

CAMERA = Intrinsics(width_px=40, height_px=40, fx_px=20.0, fy_px=20.0, cx_px=19.5, cy_px=19.5)


def keyframe(frame_id: int, depth_mm: np.ndarray) -> Keyframe:
    return Keyframe(
        robot="r",
        frame_id=frame_id,
        stamp_ns=frame_id,
        intrinsics=CAMERA,
        world_from_camera=np.eye(4),
        color=b"",
        depth=cv2.imencode(".png", depth_mm)[1].tobytes(),
        depth_scale_m=0.001,
    )


def test_a_surface_of_one_image_that_others_see_through_is_noise():
    wall = np.full((40, 40), 3000, np.uint16)
    noisy = wall.copy()
    noisy[12:15, 12:15] = 1500  # three by three pixels in the air
    frames = [keyframe(0, wall), keyframe(1, noisy), keyframe(2, wall)]
    points = measured_points(frames, 5.0)
    assert (points[:, 2] < 2).sum() == 1  # of every sixth pixel
    agreed = agreed_points(points, frames)
    assert len(agreed) and (agreed[:, 2] > 2.9).all()
    assert (agreed_points(points, [frames[1]])[:, 2] < 2).any()  # with nobody to disagree it stays
    assert not len(measured_points(frames, 1.0))


def test_a_place_is_found_again_within_a_fifth_of_a_metre():
    def at(*xs: float) -> Places:
        return Places(np.array([(x, 0.0, 0.0) for x in xs]).reshape(-1, 3), np.ones(len(xs)), [], 0.0)

    assert found(at(0, 1, 2, 3), at(0.1, 1.25, 2.19)) == pytest.approx(0.5)
    assert found(at(0, 1), at()) == 0.0
