"""Crops told apart into places: against least squares, brute force, and information by hand."""

import numpy as np
import pytest
from scipy import sparse

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.segmenter.core.appearance import unmixing
from prior_sg.services.segmenter.core.appearance.information import InformationConfig, told, worth
from prior_sg.services.segmenter.core.appearance.unmixing import UnmixingConfig, shown, unmixed
from prior_sg.services.segmenter.core.evidence.kernel import Frame
from prior_sg.services.segmenter.core.map.arcs import arcs_of

CAMERA = Intrinsics(width_px=640, height_px=480, fx_px=320.0, fy_px=320.0, cx_px=319.5, cy_px=239.5)
LONG = UnmixingConfig(rounds=4000, steps=0, ridge=1e-9)


def apart(similarity, looks, shares, cfg):
    """On a graph without edges."""
    near = arcs_of(len(similarity), np.zeros((0, 2), np.int64), np.zeros(0))
    return unmixed(similarity, looks, sparse.csr_matrix(shares), near, cfg)


def frame(surface_m: np.ndarray, centers_px, sigmas_px, dim: int = 3) -> Frame:
    """A camera at the origin that looks along z."""
    count = len(sigmas_px)
    return Frame(
        camera_from_world=np.eye(4),
        intrinsics=CAMERA,
        centers_px=np.array(centers_px, np.float32).reshape(-1, 2),
        sigmas_px=np.array(sigmas_px, np.float32),
        layer_starts=np.array([0]),
        embeddings=np.eye(dim, dtype=np.float16)[np.zeros(count, int)],
        surface_m=surface_m.astype(np.float16),
    )


def test_two_places_that_every_crop_mixes_are_found_as_they_are():
    """Crops show 0.7 and 0.3 of a kitchen (4, 0) and a bath (0, 4): their mean tells kitchen from bath by 1.6 only."""
    shares, truth = np.array([(0.7, 0.3), (0.3, 0.7)]), np.array([(4.0, 0.0), (0.0, 4.0)])
    looks = shares @ truth
    blurred = shares.T @ looks
    assert blurred[0, 0] - blurred[0, 1] == pytest.approx(0.64)
    np.testing.assert_allclose(apart(blurred, looks, shares, LONG), truth, atol=1e-3)


def test_many_rounds_end_at_least_squares():
    rng = np.random.default_rng(1)
    shares = rng.uniform(0, 1, (30, 6)) ** 4
    shares /= shares.sum(axis=1, keepdims=True)
    looks = rng.normal(0, 2, (30, 4))
    expected = np.linalg.lstsq(shares, looks, rcond=None)[0]
    np.testing.assert_allclose(apart(np.zeros((6, 4)), looks, shares, LONG), expected, atol=1e-4)


def test_places_that_no_crop_shows_and_crops_that_show_nothing_change_nothing():
    similarity = np.array([(1.0, 2.0), (3.0, 4.0)])
    shares = np.array([(0.9, 0.0), (0.1, 0.0)])
    found = apart(similarity, np.array([(5.0, 5.0), (99.0, -99.0)]), shares, LONG)
    np.testing.assert_allclose(found, [(5.0, 5.0), (3.0, 4.0)], atol=1e-6)


def test_each_cell_falls_to_the_nearest_free_spheres():
    rng = np.random.default_rng(2)
    points_m, positions_m, radii_m = rng.uniform(-3, 3, (50, 3)), rng.uniform(-3, 3, (40, 3)), rng.uniform(0.1, 1, 40)
    places, parts = unmixing._nearest(points_m, positions_m, radii_m, np.zeros(3), 9.0)
    gaps_m = np.linalg.norm(points_m[:, None] - positions_m[None], axis=2) - radii_m
    for point in range(len(points_m)):
        order = np.argsort(gaps_m[point])[: unmixing.NEAREST]
        near = order[gaps_m[point, order] < unmixing.REACH_M]
        weights = np.exp(-np.maximum(gaps_m[point, near], 0.0) / unmixing.SOFT_M)
        expected = dict(zip(near.tolist(), weights / max(weights.sum(), 1e-12), strict=True))
        held = parts[point] > 0
        found = dict(zip(places[point, held].tolist(), parts[point, held].tolist(), strict=True))
        assert found == pytest.approx(expected)


def test_a_crop_shows_the_places_before_its_surface_on_the_camera_s_side():
    """A wall 3 m away: the left half of the picture shows the place on the left, nothing the one behind the wall."""
    positions_m = np.array([(-1.5, 0.0, 2.0), (1.5, 0.0, 2.0), (0.0, 0.0, 4.5)])
    view = frame(np.full((60, 80), 3.0), [(160, 240), (480, 240)], [150, 150])
    shares = shown([view], positions_m, np.array([0.9, 0.9, 0.9])).toarray()
    assert shares[0, 0] > 0.7 and shares[1, 1] > 0.7
    assert (shares[:, 2] < 0.1).all() and (shares.sum(axis=1) <= 1 + 1e-9).all()


def test_a_frame_without_depth_and_a_map_without_frames_show_nothing():
    positions_m, radii_m = np.array([(0.0, 0.0, 2.0)]), np.array([1.0])
    assert shown([], positions_m, radii_m).shape == (0, 1)
    nothing = shown([frame(np.zeros((60, 80)), [(320, 240)], [200])], positions_m, radii_m)
    assert nothing.shape == (1, 1) and nothing.nnz == 0


def test_many_frames_are_stood_for_by_a_regular_sample_and_those_without_crops_by_none():
    wall = np.full((60, 80), 3.0)
    full, empty = frame(wall, [(320, 240)], [200]), frame(wall, [], [])
    assert unmixing.sampled([full, empty, full]) == [full, full] and unmixing.sampled([empty]) == []
    many = [full] * (unmixing.FRAMES + 1)
    assert unmixing.FRAMES / 2 <= len(unmixing.sampled(many)) <= unmixing.FRAMES


def test_crops_tell_what_their_beliefs_share_with_the_labels():
    """Sure crops of four labels tell all; crops that say the same, however surely, nothing; unsure ones nothing."""
    many = 100_000 // 4
    sure = 50.0 * np.tile(np.eye(4), (many, 1))
    assert told(sure) == pytest.approx(1.0, abs=1e-3)
    assert told(50.0 * np.tile(np.eye(4)[:1], (4 * many, 1))) == pytest.approx(0.0, abs=1e-3)
    assert told(np.zeros((many, 4))) == pytest.approx(0.0, abs=1e-9)
    assert told(50.0 * np.eye(4)[:1]) == pytest.approx(20 / 21)  # one crop may well see one region only
    assert told(np.zeros((0, 4))) == told(np.zeros((5, 1))) == 0.0


def test_what_is_told_counts_between_two_bounds():
    cfg = InformationConfig(least=0.1, full=0.3)
    assert [worth(share, cfg) for share in (0.0, 0.1, 0.2, 0.3, 0.9)] == pytest.approx([0, 0, 0.5, 1, 1])


@pytest.mark.parametrize("wrong", [{"rounds": -1}, {"ridge": 0.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="range"):
        UnmixingConfig(**wrong)


def test_bounds_of_information_in_the_wrong_order_are_refused():
    with pytest.raises(ValueError, match="below"):
        InformationConfig(least=0.7)
