"""Depth images agree under right poses and contradict each other under wrong ones."""

import itertools

import numpy as np
import pytest

from prior_sg.services.ingest.core.agreement import DepthView, agreement, moving_pairs, with_poses
from tests.help import room

POSES = room.walk()
VIEWS = [DepthView(room.depth_of(pose), room.CAMERA, pose) for pose in POSES]
AXES = [
    np.array([[sign[i] * (order[i] == k) for k in range(3)] for i in range(3)], float)
    for order in itertools.permutations(range(3))
    for sign in itertools.product((1, -1), repeat=3)
]
ROTATIONS = [axes for axes in AXES if np.linalg.det(axes) > 0]


def lifted(rotation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose


def test_right_poses_agree():
    found = agreement(VIEWS)
    assert found.share > 0.97
    assert found.median_error_m < 0.02
    assert found.pairs == len(VIEWS) - 1


@pytest.mark.parametrize("wrong", range(1, 24))
def test_any_other_camera_axes_contradict(wrong):
    rotation = [axes for axes in ROTATIONS if not np.array_equal(axes, np.eye(3))][wrong - 1]
    found = agreement(with_poses(VIEWS, [pose @ lifted(rotation) for pose in POSES]))
    assert not found.share > 0.75


def test_inverted_poses_contradict():
    assert not agreement(with_poses(VIEWS, [np.linalg.inv(pose) for pose in POSES])).share > 0.6


@pytest.mark.parametrize("seed", range(8))
def test_the_world_may_lie_anywhere_and_turned_anyhow(seed):
    rng = np.random.default_rng(seed)
    world = lifted(np.linalg.qr(rng.normal(size=(3, 3)))[0])
    world[:3, :3] *= np.sign(np.linalg.det(world[:3, :3]))
    world[:3, 3] = rng.normal(size=3) * 100
    moved = agreement(with_poses(VIEWS, [world @ pose for pose in POSES]))
    assert moved.share == pytest.approx(agreement(VIEWS).share, abs=0.01)


def test_holes_and_noise_are_borne():
    rng = np.random.default_rng(1)
    views = []
    for view in VIEWS:
        noisy = view.depth_m + rng.normal(scale=0.01, size=view.depth_m.shape)
        views.append(
            DepthView(np.where(rng.random(noisy.shape) < 0.6, 0, noisy), view.intrinsics, view.world_from_camera)
        )
    assert agreement(views).share > 0.9


def test_what_stands_in_front_hides_what_is_behind_without_contradicting():
    near = DepthView(np.full((72, 96), 1.0), room.CAMERA, np.eye(4))
    far = DepthView(np.full((72, 96), 5.0), room.CAMERA, np.eye(4))
    found = agreement([far, near])
    assert found.share == 0.0, "the near surface stands where the other image saw free space"
    assert found.points < 2 * 1500, "the far points are hidden, and not compared"


def test_nothing_is_said_where_nothing_can_be():
    away = [VIEWS[0].world_from_camera, VIEWS[0].world_from_camera @ lifted(np.diag((-1.0, 1, -1)))]
    for views in (
        [],
        VIEWS[:1],
        with_poses(VIEWS[:1] * 2, away),
        [DepthView(np.zeros((4, 4)), room.CAMERA, np.eye(4))] * 2,
    ):
        found = agreement(views)
        assert np.isnan(found.share)
        assert found.pairs == 0


def test_pairs_have_moved():
    still = [POSES[0]] * 5 + POSES[4:6]
    pairs = moving_pairs(still, least_m=0.1)
    assert all(np.linalg.norm(still[i][:3, 3] - still[j][:3, 3]) > 0 for i, j in pairs)
    assert (4, 5) in pairs
