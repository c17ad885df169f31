"""Crops are encoded as gravity has them, however the sensor is mounted."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.upright import quarter_turns, turned, turned_back
from prior_sg.services.feature_pyramid.detectors.base import Detector
from prior_sg.services.feature_pyramid.worker import view

LEVEL = np.array(((1.0, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)))  # looks along world y, upright


def rolled(quarters, degrees=0.0, pitch_deg=0.0, yaw_deg=0.0):
    """A pose whose sensor is turned clockwise about its optical axis, so that its pictures turn anticlockwise."""

    def about(axis, angle_deg):
        pose = np.eye(4)
        vector = math.radians(angle_deg) * np.eye(3)[axis]
        pose[:3, :3] = cv2.Rodrigues(vector)[0]
        return pose

    return about(2, yaw_deg) @ LEVEL @ about(0, pitch_deg) @ about(2, 90.0 * quarters + degrees)


@given(st.integers(0, 3), st.floats(-40, 40), st.floats(-60, 60), st.floats(-180, 180))
def test_the_turn_undoes_the_mounting(quarters, degrees, pitch_deg, yaw_deg):
    assert quarter_turns(rolled(quarters, degrees, pitch_deg, yaw_deg)) == quarters


@pytest.mark.parametrize("pitch_deg", [-90, -75, 75, 90])
@pytest.mark.parametrize("quarters", range(4))
def test_a_camera_that_looks_straight_up_or_down_is_left_alone(pitch_deg, quarters):
    assert quarter_turns(rolled(quarters, 0, pitch_deg)) == 0


@given(st.integers(0, 3), st.integers(1, 7), st.integers(1, 9), st.data())
def test_boxes_come_back_to_where_they_were(turns, width_px, height_px, data):
    left, right = sorted(data.draw(st.lists(st.integers(0, width_px), min_size=2, max_size=2, unique=True)))
    top, bottom = sorted(data.draw(st.lists(st.integers(0, height_px), min_size=2, max_size=2, unique=True)))
    image = np.zeros((height_px, width_px), bool)
    image[top:bottom, left:right] = True
    rows, columns = np.nonzero(turned(image, turns))
    box = np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]])
    np.testing.assert_array_equal(turned_back(box, turns, width_px, height_px), [[left, top, right, bottom]])


@pytest.mark.parametrize("quarters", range(4))
def test_the_encoder_sees_the_same_pictures_whichever_way_the_sensor_is_mounted(quarters, rng):
    """Pixels, intrinsics and pose turned together: the largest crop shows what the upright one shows."""
    color = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    upright = largest_crop(color, rolled(0))
    np.testing.assert_array_equal(largest_crop(np.rot90(color, quarters), rolled(quarters)), upright)


def largest_crop(color, world_from_camera):
    height_px, width_px = color.shape[:2]
    camera = Intrinsics(width_px, height_px, 100.0, 100.0, (width_px - 1) / 2, (height_px - 1) / 2)
    keyframe = Keyframe(
        robot="r1",
        frame_id=0,
        stamp_ns=0,
        intrinsics=camera,
        world_from_camera=world_from_camera,
        color=cv2.imencode(".png", np.ascontiguousarray(color[..., ::-1]))[1].tobytes(),
        depth=cv2.imencode(".png", np.full((height_px, width_px), 4000, np.uint16))[1].tobytes(),
        depth_scale_m=0.001,
    )
    seen = view(keyframe, Detector(), (), Config(layers=1, smallest_crop_px=120, overlap=0.0))
    return min(seen.crops, key=lambda crop: crop.tobytes())  # the order of crops turns with the image
