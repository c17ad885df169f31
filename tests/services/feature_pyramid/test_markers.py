"""Printed markers in rendered views: posed by depth, also from aside; left out where size or depth do not fit."""

import numpy as np
import pytest

from prior_sg.schemas.topics import DETECTIONS
from prior_sg.services.feature_pyramid import service
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.markers import MarkersConfig, seen_markers
from prior_sg.services.feature_pyramid.detectors.load import load_detector
from prior_sg.services.feature_pyramid.worker import MARKERS_LEFT_OUT
from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.runtime.runner import Runner
from tests.help.markers import CAMERA, DICTIONARY, SIZE_M, facing, keyframe, on_wall, shot
from tests.services.feature_pyramid.test_detectors import Colours

CFG = MarkersConfig(dictionary=DICTIONARY, size_m=SIZE_M)
HUNG = on_wall((4.0, 2.0, 1.5), 0.7)
NOISE_M = 0.003  # at a metre; it grows with the square, as a structured-light camera's does


def off(camera_from_marker, truth):
    """Metres, radians between two poses."""
    turn = truth.copy()
    turn[:3, :3] = truth[:3, :3].T @ camera_from_marker[:3, :3]
    return np.linalg.norm(truth[:3, 3] - camera_from_marker[:3, 3]), rotation_angle_rad(turn)


@pytest.mark.parametrize(
    ("distance_m", "yaw", "pitch", "roll"),
    [(1.5, 0, 0, 0), (1.5, 0, 0, 0.4), (2.5, 0.9, 0, 0), (2.5, -0.9, 0.3, 1.6), (1.2, 0, -0.8, 3.0), (3.5, 0.3, 0, 0)],
)
def test_poses_are_right_from_ahead_and_aside(distance_m, yaw, pitch, roll):
    world_from_camera = facing(HUNG, distance_m, (yaw, pitch, roll), aside_m=(0.3, -0.2))
    seen = seen_markers(*shot(world_from_camera, [(7, HUNG)], noise_m=NOISE_M), CAMERA, CFG)
    assert seen.ids.tolist() == [7] and not seen.faults
    gap_m, gap_rad = off(seen.camera_from_marker[0], inverse(world_from_camera) @ HUNG)
    assert gap_m < 0.02 * distance_m and gap_rad < np.radians(4)


def test_depth_decides_which_way_a_far_marker_looks():
    """Views of a small image, nearly from ahead: from the corners alone the median is 7 degrees off, the worst 27."""
    turns = []
    for seed in range(20):
        world_from_camera = facing(HUNG, 3.0, (0.15, 0.1, 0))
        color, depth_m = shot(world_from_camera, [(3, HUNG)], noise_m=NOISE_M, seed=seed)
        seen = seen_markers(color, depth_m, CAMERA, CFG)
        turns += [off(pose, inverse(world_from_camera) @ HUNG)[1] for pose in seen.camera_from_marker]
    assert len(turns) == 20 and np.degrees(max(turns)) < 6


def test_a_wrong_size_is_told_and_nothing_posed():
    color, depth_m = shot(facing(HUNG, 1.5, (0.3, 0, 0)), [(7, HUNG)], size_m=0.15)
    seen = seen_markers(color, depth_m, CAMERA, CFG)
    assert not len(seen.ids)
    assert seen.faults == ["marker 7 measures 0.150 m by the depth image, markers.size_m says 0.2 m"]


def test_without_depth_nothing_is_posed():
    color, depth_m = shot(facing(HUNG, 1.5), [(7, HUNG)], hidden=True)
    assert seen_markers(color, depth_m, CAMERA, CFG).faults == ["marker 7 has no depth"]


def test_a_marker_that_is_too_small_in_the_image_is_left_out():
    color, depth_m = shot(facing(HUNG, 2.0), [(7, HUNG)])
    seen = seen_markers(color, depth_m, CAMERA, MarkersConfig(dictionary=DICTIONARY, size_m=SIZE_M, least_px=80))
    assert not len(seen.ids) and "pixels wide" in seen.faults[0]


def test_two_of_one_number_are_two():
    other = HUNG.copy()
    other[:3, 3] += 0.6 * HUNG[:3, 0]
    seen = seen_markers(*shot(facing(HUNG, 2.5, aside_m=(-0.3, 0)), [(7, HUNG), (7, other)]), CAMERA, CFG)
    assert seen.ids.tolist() == [7, 7]
    assert np.linalg.norm(np.diff(seen.camera_from_marker[:, :3, 3], axis=0)) == pytest.approx(0.6, abs=0.02)


def test_none_are_looked_for_unless_asked():
    assert Config().markers.dictionary == ""
    seen = seen_markers(*shot(facing(HUNG, 1.5), [(7, HUNG)]), CAMERA, Config().markers)
    assert not len(seen.ids) and not seen.faults


@pytest.mark.parametrize(
    "bad", [{"dictionary": "april"}, {"dictionary": DICTIONARY}, {"size_tolerance": 0.0}, {"least_px": 0.0}]
)
def test_bad_settings_are_refused(bad):
    with pytest.raises(ValueError, match=r"dictionary|size_m|size_tolerance"):
        MarkersConfig(**bad)


def test_markers_travel_with_detections_and_what_is_left_out_is_counted():
    cfg = Config(detector="none", markers=CFG)
    state = service.Worker("w", Colours(), load_detector(cfg))
    runner = Runner(service.SERVICE, cfg, state=state, wire=True)
    pose, told = facing(HUNG, 2.5, (0.4, 0, 0)), []
    for frame_id, size_m in enumerate((SIZE_M, 2 * SIZE_M)):
        frame = keyframe(frame_id, pose, *shot(pose, [(7, HUNG)], size_m=size_m))
        told += [message for topic, message in runner.feed(frame) if topic is DETECTIONS]
    state.reader.shutdown()
    assert [one.marker_ids.tolist() for one in told] == [[7], []]
    assert (told[0].marker_dictionary, told[0].marker_size_m) == (DICTIONARY, SIZE_M)
    assert pose @ told[0].camera_from_marker[0] == pytest.approx(HUNG, abs=0.03)
    assert [loss.what for loss in state.losses.told] == [MARKERS_LEFT_OUT]
