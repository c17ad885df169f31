"""The measures of places: surfaces that keyframes agree with, and places found again, by hand."""

import cv2
import numpy as np
import pytest

from prior_sg.deploy.benches.exactness import COLUMNS, Places, agreed_points, found, measured_points, places_of, table
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.place_graph.core.config import Config

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


def test_half_of_a_short_recording_makes_a_map_of_its_own():
    wall = np.full((40, 40), 3000, np.uint16)
    made = places_of([keyframe(7, wall), keyframe(9, wall)], Config())
    assert len(made.spent_ms) == 2 and made.map_mb > 0


def test_the_table_has_a_row_for_each_scene_and_preset():
    shares = {key: 0.02 for key in ("too_wide", "too_wide_agreed", "too_narrow")}
    spread = {f"{key}_{end}": at for key in shares for end, at in (("least", 0.01), ("worst", 0.031))}
    found_again = {"found_grid": 0.5, "found_order": 1.0, "found_walk": 0.75}
    one = {"keyframes": 86.0, "places": 315.5, "ms_p50": 26.5, "ms_p99": 57.0, "map_mb": 11.0, "radius_m": 0.8}
    one |= shares | spread | found_again
    metrics = {f"{scene} {key}": value for scene in ("a home indoor", "b mixed") for key, value in one.items()}
    rows = table(metrics)
    assert [row[0] for row in rows] == ["a home indoor", "b mixed"]
    ranged = "2.0 (1.0-3.1)"
    assert rows[0][1:] == ["86", "316", "26.5/57.0", "11.0", ranged, ranged, ranged, "50, 100, 75"]
    assert len(COLUMNS) == len(rows[0])
