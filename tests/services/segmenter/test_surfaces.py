"""Whose surface each crop shows: by brute force, and what is kept against all found anew."""

import numpy as np
import pytest

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.segmenter.core.evidence import surfaces
from prior_sg.services.segmenter.core.evidence.kernel import Frame
from prior_sg.services.segmenter.core.evidence.surfaces import Shown, Spheres
from prior_sg.services.segmenter.core.slices import at_once

CAMERA = Intrinsics(width_px=640, height_px=480, fx_px=320.0, fy_px=320.0, cx_px=319.5, cy_px=239.5)


def frame(surface_m: np.ndarray, centers_px, sigmas_px, camera_from_world=None) -> Frame:
    """A camera at the origin that looks along z, or elsewhere."""
    count = len(sigmas_px)
    return Frame(
        camera_from_world=np.eye(4) if camera_from_world is None else camera_from_world,
        intrinsics=CAMERA,
        centers_px=np.array(centers_px, np.float32).reshape(-1, 2),
        sigmas_px=np.array(sigmas_px, np.float32),
        layer_starts=np.array([0]),
        embeddings=np.eye(3, dtype=np.float16)[np.zeros(count, int)],
        surface_m=surface_m.astype(np.float16),
    )


def shares_of(frames, positions_m, radii_m):
    return at_once(Shown().shares(dict(enumerate(frames)), Spheres(np.arange(len(radii_m)), positions_m, radii_m)))


def drawn(rng) -> Frame:
    """A frame somewhere in a room, crops and depth at random."""
    angle = rng.uniform(0, 2 * np.pi)
    pose = np.eye(4)
    pose[:3, :3] = [(np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle))]
    pose[:3, 3] = rng.uniform(-5, 5, 3)
    surface_m = rng.uniform(0.2, 4, (12, 16)) * (rng.random((12, 16)) > 0.2)
    return frame(surface_m, rng.uniform(0, 480, (6, 2)), rng.uniform(30, 200, 6), pose)


def test_each_cell_falls_to_the_nearest_free_spheres():
    rng = np.random.default_rng(2)
    points_m, positions_m, radii_m = rng.uniform(-3, 3, (50, 3)), rng.uniform(-3, 3, (40, 3)), rng.uniform(0.1, 1, 40)
    places, parts, limits_m = surfaces._nearest(points_m, positions_m, radii_m, np.zeros(3), 9.0)
    gaps_m = np.linalg.norm(points_m[:, None] - positions_m[None], axis=2) - radii_m
    for point in range(len(points_m)):
        order = np.argsort(gaps_m[point])[: surfaces.NEAREST]
        near = order[gaps_m[point, order] < surfaces.REACH_M]
        weights = np.exp(-np.maximum(gaps_m[point, near], 0.0) / surfaces.SOFT_M)
        expected = dict(zip(near.tolist(), weights / max(weights.sum(), 1e-12), strict=True))
        held = parts[point] > 0
        found = dict(zip(places[point, held].tolist(), parts[point, held].tolist(), strict=True))
        assert found == pytest.approx(expected)
        assert limits_m[point] == pytest.approx(min(gaps_m[point, order[-1]], surfaces.REACH_M))


def test_a_crop_shows_the_places_before_its_surface_on_the_camera_s_side():
    """A wall 3 m away: the left half of the picture shows the place on the left, nothing the one behind the wall."""
    positions_m = np.array([(-1.5, 0.0, 2.0), (1.5, 0.0, 2.0), (0.0, 0.0, 4.5)])
    view = frame(np.full((60, 80), 3.0), [(160, 240), (480, 240)], [150, 150])
    shares = shares_of([view], positions_m, np.array([0.9, 0.9, 0.9])).toarray()
    assert shares[0, 0] > 0.7 and shares[1, 1] > 0.7
    assert (shares[:, 2] < 0.1).all() and (shares.sum(axis=1) <= 1 + 1e-9).all()


def test_a_frame_without_depth_and_a_map_without_frames_show_nothing():
    positions_m, radii_m = np.array([(0.0, 0.0, 2.0)]), np.array([1.0])
    assert shares_of([], positions_m, radii_m).shape == (0, 1)
    nothing = shares_of([frame(np.zeros((60, 80)), [(320, 240)], [200])], positions_m, radii_m)
    assert nothing.shape == (1, 1) and nothing.nnz == 0


def test_many_frames_are_stood_for_by_a_regular_sample_and_those_without_crops_by_none():
    wall = np.full((60, 80), 3.0)
    full, empty = frame(wall, [(320, 240)], [200]), frame(wall, [], [])
    assert list(surfaces.sampled({3: full, 4: empty, 7: full})) == [3, 7] and surfaces.sampled({1: empty}) == {}
    many = dict.fromkeys(range(surfaces.FRAMES + 1), full)
    assert surfaces.FRAMES / 2 <= len(surfaces.sampled(many)) <= surfaces.FRAMES


@pytest.mark.parametrize("seed", range(4))
def test_what_is_kept_while_places_and_frames_come_move_and_go_equals_all_found_anew(seed):
    rng = np.random.default_rng(seed)
    frames = {number: drawn(rng) for number in range(40)}
    places = {number: (rng.uniform(-8, 8, 3) * (1, 0.2, 1), rng.uniform(0.2, 1)) for number in range(0, 300, 2)}
    shown, asked = Shown(), 0
    for turn in range(12):
        ids = np.array(sorted(places))
        spheres = Spheres(ids, np.array([places[i][0] for i in ids]), np.array([places[i][1] for i in ids]))
        found, anew = at_once(shown.shares(frames, spheres)), at_once(Shown().shares(frames, spheres))
        for part in ("data", "indices", "indptr"):
            np.testing.assert_array_equal(getattr(found, part), getattr(anew, part))
        asked += len(frames)
        one, gone = rng.choice(ids, 2, replace=False).tolist()
        places[one] = (places[one][0] + rng.normal(0, 0.2, 3), places[one][1] + rng.uniform(0, 0.1))
        del places[gone]
        places[301 + 2 * turn] = (rng.uniform(-8, 8, 3) * (1, 0.2, 1), 0.7)
        frames[100 + turn], frames[turn + 1] = drawn(rng), drawn(rng)
        del frames[turn + 20]
    assert shown.renewed < 0.8 * asked


def test_frames_that_no_change_is_near_are_not_looked_at_again():
    wall = np.full((60, 80), 3.0)
    away = np.eye(4)
    away[0, 3] = -50.0
    frames = {1: frame(wall, [(320, 240)], [200]), 2: frame(wall, [(320, 240)], [200], away)}
    positions_m, radii_m = np.array([(0.0, 0.0, 2.0), (50.0, 0.0, 2.0)]), np.array([1.0, 1.0])
    shown = Shown()
    for radius_m, renewed in ((1.0, 2), (1.0, 2), (1.1, 3)):
        at_once(shown.shares(frames, Spheres(np.array([4, 9]), positions_m, np.array([1.0, radius_m]))))
        assert shown.renewed == renewed
    assert at_once(shown.shares(frames, Spheres(np.array([4]), positions_m[:1], radii_m[:1]))).shape == (2, 1)
    assert shown.renewed == 4
