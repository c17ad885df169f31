"""Integration kernel against loops over the equations, visibility by hand, and retroactive integration."""

import math

import numpy as np
import pytest

from prior_sg.services.segmenter.core.evidence import kernel
from prior_sg.services.segmenter.core.evidence.archive import FrameArchive, integrate_all
from prior_sg.services.segmenter.core.evidence.kernel import Evidence, KernelConfig, Targets
from tests.help.world import CAMERA, DIM, look, place_grid, pyramid, walk

CFG = KernelConfig()
RADIUS_M = 0.75


def literal_kernel(message, position_world, radius_m, gamma):
    """query_state, spatial_affinity, scale_trust, observation_trust, single_observation_feature; one term at a time."""
    x, y, z, _ = np.linalg.inv(message.world_from_camera) @ np.append(position_world, 1.0)
    u_p = np.array((CAMERA.fx_px * x / z + CAMERA.cx_px, CAMERA.fy_px * y / z + CAMERA.cy_px))
    sigma_p = CAMERA.fx_px * radius_m / z
    weights, best = [], {}
    for u, sigma, layer in zip(message.centers_px, message.sigmas_px, message.layers, strict=True):
        spatial = np.exp(-np.sum((u_p - u) ** 2) / (2 * (sigma_p**2 + sigma**2)))
        scale = np.exp(-((np.log(sigma_p) - np.log(sigma)) ** 2) / gamma)
        weights.append(spatial * scale)
        best[layer] = max(best.get(layer, (0.0,))[0], spatial), scale
    feature = sum(w * e.astype(float) for w, e in zip(weights, message.embeddings, strict=True))
    return np.array(weights), sum(scale * peak for peak, scale in best.values()), feature


def gather(frames, positions, order=None):
    """Evidence of places from frames."""
    evidence, archive = Evidence(), FrameArchive()
    for index in range(len(frames)) if order is None else order:
        archive.add(frames[index].frame_id, kernel.compact(frames[index]), math.inf)
    ids = list(range(len(positions)))
    evidence.add(ids)
    targets = Targets(evidence.of(ids), positions.astype(float))
    integrate_all(evidence, archive, targets, RADIUS_M, CFG)
    return evidence, targets


def test_kernel_equals_the_equations_term_by_term():
    message = pyramid(3, look(2, 2, 0.4), rooms=2)
    frame = kernel.compact(message)
    positions = np.array([(3.0, 2.2, 1.1), (3.5, 2.9, 0.4), (2.6, 2.3, 1.0), (6.0, 3.4, 1.2)])
    weights, trust = kernel.kernel(frame, positions, RADIUS_M, CFG.gamma)
    for row, position in enumerate(positions):
        expected_weights, expected_trust, _ = literal_kernel(message, position, RADIUS_M, CFG.gamma)
        np.testing.assert_allclose(weights[row], expected_weights, atol=2e-6)
        assert trust[row] == pytest.approx(expected_trust, abs=2e-6)


def test_crops_in_any_order_give_the_same_trust():
    message = pyramid(3, look(2, 2, 0.4), rooms=2)
    order = np.random.default_rng(0).permutation(len(message.layers))
    shuffled = pyramid(
        3,
        look(2, 2, 0.4),
        rooms=2,
        **{name: getattr(message, name)[order] for name in ("centers_px", "sigmas_px", "layers", "embeddings")},
    )
    positions = np.array([(3.0, 2.2, 1.1)])
    _, trust = kernel.kernel(kernel.compact(message), positions, RADIUS_M, CFG.gamma)
    _, again = kernel.kernel(kernel.compact(shuffled), positions, RADIUS_M, CFG.gamma)
    assert again == pytest.approx(trust, rel=1e-6)


def test_descriptor_is_the_trust_weighted_mean_over_frames():
    frames = walk(2)
    positions, _ = place_grid(2)
    evidence, targets = gather(frames, positions)
    place = 5
    total, trusts = np.zeros(DIM), []
    for message in frames:
        if place in kernel.visible(kernel.compact(message), targets.positions_m, CFG):
            _, trust, feature = literal_kernel(message, positions[place], RADIUS_M, CFG.gamma)
            total += trust * feature
            trusts.append(trust)
    assert evidence.frames[place] == len(trusts) > 1
    assert evidence.trust[place] == pytest.approx(sum(trusts), rel=1e-5)
    np.testing.assert_allclose(evidence.descriptors(np.array([place]))[0], total / np.linalg.norm(total), atol=1e-5)


CAMERA_AT_ORIGIN = look(0.0, 0.0, 0.0)  # looks along x at height 1
VISIBILITY = [  # position, seen; the surface lies at x = 3
    ("in front", (2.0, 0.0, 1.0), True),
    ("behind the camera", (-2.0, 0.0, 1.0), False),
    ("nearer than min_depth_m", (0.2, 0.0, 1.0), False),
    ("left of the image", (2.0, 1.7, 1.0), False),
    ("inside at the left border", (2.0, 1.55, 1.0), True),
    ("above the image", (2.0, 0.0, 2.3), False),
    ("behind the wall", (4.0, 0.0, 1.0), False),
    ("behind the wall within tolerance", (3.25, 0.0, 1.0), True),
]


@pytest.mark.parametrize("name, position, seen", VISIBILITY, ids=[case[0] for case in VISIBILITY])
def test_visibility(name, position, seen):
    message = pyramid(0, CAMERA_AT_ORIGIN, rooms=1, surface_m=np.full((12, 16), 3.0, dtype=np.float32))
    rows = kernel.visible(kernel.compact(message), np.array([position]), CFG)
    assert (len(rows) == 1) == seen


def test_beyond_the_depth_range_nothing_is_seen():
    message = pyramid(0, CAMERA_AT_ORIGIN, rooms=1, surface_m=np.full((12, 16), 50.0, dtype=np.float32))
    frame = kernel.compact(message)
    for depth_m, count in ((CFG.max_depth_m - 0.1, 1), (CFG.max_depth_m + 0.1, 0)):
        assert len(kernel.visible(frame, np.array([(depth_m, 0.0, 1.0)]), CFG)) == count


def test_a_hole_takes_the_depth_of_the_nearest_measured_cell():
    surface = np.zeros((3, 5), dtype=np.float32)
    surface[1, 0], surface[1, 4] = 2.0, 7.0
    filled = kernel.fill_holes(surface)
    np.testing.assert_array_equal(filled[:, 1], 2.0)
    np.testing.assert_array_equal(filled[:, 3], 7.0)
    assert surface[0, 0] == 0
    assert (kernel.fill_holes(np.zeros((3, 5), dtype=np.float32)) == 0).all()


def test_without_any_depth_nothing_is_seen():
    message = pyramid(0, CAMERA_AT_ORIGIN, rooms=1, surface_m=np.zeros((12, 16), dtype=np.float32))
    rows = kernel.visible(kernel.compact(message), np.array([(2.0, 0.0, 1.0)]), CFG)
    assert len(rows) == 0


def test_a_wall_hides_the_room_behind_it():
    positions, _ = place_grid(2)
    frame = kernel.compact(pyramid(0, look(3.0, 3.5, 0.0), rooms=2))  # faces the wall beside the doorway
    seen = kernel.visible(frame, positions.astype(float), CFG)
    assert len(seen) > 0
    assert (positions[seen, 0] <= 4.0).all()


def test_frustum_candidates_miss_no_frame_that_sees_a_place():
    frames = walk(3)
    positions, _ = place_grid(3)
    archive = FrameArchive()
    for message in frames:
        archive.add(message.frame_id, kernel.compact(message), math.inf)
    for row in range(0, len(positions), 5):
        place = positions[row : row + 1].astype(float)
        seeing = [i for i, f in enumerate(archive.frames) if len(kernel.visible(f, place, CFG))]
        assert set(seeing) <= set(archive.candidates(place, CFG).tolist())
        assert len(archive.candidates(place, CFG)) < len(frames)


def test_order_of_arrival_does_not_matter_beyond_rounding():
    frames = walk(2)
    positions, _ = place_grid(2)
    slots = np.arange(len(positions))
    expected, _ = gather(frames, positions)
    shuffled, _ = gather(frames, positions, np.random.default_rng(1).permutation(len(frames)))
    np.testing.assert_allclose(shuffled.descriptors(slots), expected.descriptors(slots), atol=1e-5)
    np.testing.assert_array_equal(shuffled.frames[slots], expected.frames[slots])


def test_slots_are_used_again_and_start_empty():
    positions, _ = place_grid(2)
    evidence, _ = gather(walk(2), positions)
    size = len(evidence.trust)
    slot = int(evidence.of([3])[0])
    evidence.remove([3])
    evidence.add([999])
    assert int(evidence.of([999])[0]) == slot
    assert evidence.trust[slot] == 0 and evidence.frames[slot] == 0 and not evidence.sums[slot].any()
    evidence.add(list(range(1000, 1000 + 2 * size)))
    assert len(set(evidence.of(sorted(evidence.slots)).tolist())) == len(evidence.slots)


def test_kept_frames_own_their_arrays():
    message = pyramid(3, look(2, 2, 0.4), rooms=2)
    frame = kernel.compact(message)
    for name in ("centers_px", "sigmas_px", "embeddings", "surface_m"):
        assert not np.shares_memory(getattr(frame, name), getattr(message, name))
