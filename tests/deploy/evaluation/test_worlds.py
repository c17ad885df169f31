"""Generated worlds: the same from the same seed, sane plans of every kind, walks in free space, exact depth."""

from dataclasses import replace

import numpy as np
import pytest

from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.deploy.evaluation.worlds import KINDS, views_of, world_of
from prior_sg.deploy.evaluation.worlds.outline import Rect, outline
from prior_sg.deploy.evaluation.worlds.plan import GLASS, NOTHING, Level, Plan
from prior_sg.deploy.evaluation.worlds.rays import LOST, THROUGH
from prior_sg.deploy.evaluation.worlds.walk import NARROW_CELLS
from prior_sg.deploy.evaluation.worlds.ways import CELL_M, ways_of
from prior_sg.deploy.evaluation.worlds.world import depths, filled
from prior_sg.schemas.frames import check_pose
from prior_sg.services.geometry import back_project, inside_polygon, transform
from prior_sg.services.ingest.core.config import Config

SEEDS = (1, 2)
SEEN_GLASS = np.full(1, 0.99)  # of the chances of a ray: glass returns it


@pytest.fixture(scope="module", params=[(kind, seed) for kind in KINDS for seed in SEEDS], ids=str)
def world(request):
    return world_of(*request.param)


@pytest.fixture(scope="module")
def home():
    return world_of("home", 1)


def matter_at(world, points_m):
    """What is there, (n,); 0 outside the grid."""
    cells = np.floor((points_m - world.origin_m) / world.voxel_m).astype(int)
    inside = ((cells >= 0) & (cells < world.grid.shape)).all(axis=1)
    found = np.zeros(len(points_m), np.uint8)
    found[inside] = world.grid[tuple(cells[inside].T)]
    return found


def polygon_area(polygon_m):
    x, y = polygon_m.T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


@pytest.mark.parametrize("walk", ["scanner", "passer-by"])
def test_a_kind_and_a_seed_always_give_the_same_world_and_views(walk):
    one, other = world_of("home", 3, walk), world_of("home", 3, walk)
    assert one.grid.tobytes() == other.grid.tobytes()
    assert one.world_from_camera.tobytes() == other.world_from_camera.tobytes()
    for a, b in zip(views_of(one), views_of(other), strict=True):
        assert (a.stamp_ns, a.depth_m.tobytes()) == (b.stamp_ns, b.depth_m.tobytes())


def test_another_seed_gives_another_world(home):
    assert world_of("home", 2).grid.tobytes() != home.grid.tobytes()


def test_both_walks_go_through_the_same_plan(home):
    passing = world_of("home", 1, "passer-by")
    assert passing.grid.tobytes() == home.grid.tobytes()
    assert 1 < len(passing.stamps_ns) < len(home.stamps_ns)


@pytest.mark.parametrize(("kind", "walk"), [("cave", "scanner"), ("home", "robot")])
def test_what_is_unknown_is_refused_in_one_sentence(kind, walk):
    with pytest.raises(ValueError, match=r"there is no \w+ .*; choose"):
        world_of(kind, 1, walk)


def test_regions_are_polygons_of_free_floor_that_do_not_overlap(world):
    for region in world.truth.regions:
        assert polygon_area(region.polygon_m) > 1.0, region.label
        low_m, high_m = region.polygon_m.min(axis=0), region.polygon_m.max(axis=0)
        grid_m = np.stack(np.meshgrid(*(np.arange(a + 0.07, b, 0.25) for a, b in zip(low_m, high_m, strict=True))), -1)
        points_m = grid_m.reshape(-1, 2)
        points_m = points_m[inside_polygon(points_m, region.polygon_m)]
        for other in world.truth.regions:
            if other is not region and other.z_min_m < region.z_max_m and region.z_min_m < other.z_max_m:
                assert not inside_polygon(points_m, other.polygon_m).any(), (region.label, other.label)


def test_a_scanner_visits_every_region(world):
    assert set(world.truth.region_of(world.world_from_camera[:, :3, 3]).tolist()) >= {
        region.id for region in world.truth.regions
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_passer_by_sees_a_part(kind):
    passing = world_of(kind, 1, "passer-by")
    visited = set(passing.truth.region_of(passing.world_from_camera[:, :3, 3]).tolist())
    assert len(visited) >= 2
    assert len(passing.stamps_ns) < len(world_of(kind, 1).stamps_ns)


def test_the_camera_goes_through_free_space_with_room_around(world):
    eyes_m = world.world_from_camera[:, :3, 3]
    assert not matter_at(world, eyes_m).any()
    for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        assert not matter_at(world, eyes_m + 0.25 * np.array([np.cos(angle), np.sin(angle), 0])).any()
    check_pose(world.world_from_camera)


def test_ingest_makes_a_keyframe_of_nearly_every_view_and_believes_all(world):
    cfg = Config()
    poses = world.world_from_camera
    moved_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = np.einsum("nji,njk->nik", poses[:-1, :3, :3], poses[1:, :3, :3])
    turned_deg = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    seconds = np.diff(world.stamps_ns) / 1e9
    assert (seconds > 0).all()
    assert (moved_m / seconds < 3.0).all()  # the place graph's max_speed_m_s
    assert np.mean((moved_m >= cfg.min_translation_m) | (turned_deg >= cfg.min_rotation_deg)) > 0.85
    assert moved_m.max() < (2.3 if world.outdoors else 1.2)
    assert turned_deg.max() < 110


def test_all_regions_are_joined_by_ways_a_person_can_go(world):
    ways = ways_of(world.grid, world.origin_m, world.voxel_m)
    nodes = np.flatnonzero((ways.clearance >= NARROW_CELLS).reshape(-1))
    feet_m = ways.position_m(nodes)
    start = np.argmin(np.linalg.norm(feet_m[:, :2] - world.world_from_camera[0, :2, 3], axis=1))
    reached = feet_m[ways.reached(int(nodes[start]), NARROW_CELLS)[nodes]]
    found = set(world.truth.region_of(reached + np.array([0, 0, 0.1])).tolist())
    assert found >= {region.id for region in world.truth.regions}


def test_objects_stand_in_the_world(world):
    assert world.objects
    for item in world.objects:
        assert (item.max_m > item.min_m).all(), item.label
        low, high = (np.rint((end - world.origin_m) / world.voxel_m).astype(int) for end in (item.min_m, item.max_m))
        assert world.grid[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].any(), item.label


def test_the_library_has_a_prior_for_the_labels(world):
    labels = sorted({region.label for region in world.truth.regions})
    prior = library_prior(world.environment, "inspection", labels)
    assert [region.name for region in prior.regions] == labels


def brute_depth(world, pose, rays_camera):
    """Depth at which rays enter the first of all voxels that are not nothing, each tried that reaches into the view."""
    solid = world.origin_m + np.argwhere(world.grid != NOTHING) * world.voxel_m
    eye_m = pose[:3, 3]
    x, y, z = ((solid + world.voxel_m / 2 - eye_m) @ pose[:3, :3]).T
    slack = 2 * world.voxel_m  # more than from a voxel's middle to its corners
    wide, high = np.abs(rays_camera[:, :2]).max(axis=0)
    solid = solid[
        (np.abs(z - 2.5) < 2.5 + slack) & (np.abs(x) < wide * z + 3 * slack) & (np.abs(y) < high * z + 3 * slack)
    ]
    depths_m = []
    for ray in rays_camera @ pose[:3, :3].T:
        with np.errstate(divide="ignore"):
            one, other = (solid - eye_m) / ray, (solid + world.voxel_m - eye_m) / ray
        enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
        hit = enter[(enter < leave - 1e-9) & (leave > 0)]
        depths_m.append(hit.min() if len(hit) else np.inf)
    return np.array(depths_m)


@pytest.mark.parametrize("kind", ["home", "shop"])
def test_rays_end_where_trying_every_voxel_says(kind):
    world, rng = world_of(kind, 1), np.random.default_rng(0)
    for pose in world.world_from_camera[:: len(world.stamps_ns) // 4]:
        rays = np.column_stack((rng.uniform(-1, 1, 12), rng.uniform(-0.7, 0.7, 12), np.ones(12)))
        depth_m, facing = depths(world, pose, rays, SEEN_GLASS.repeat(12))
        expected_m = brute_depth(world, pose, rays)
        near = expected_m < 4.5  # in the part of the grid that was tried
        np.testing.assert_allclose(depth_m[near], expected_m[near], atol=1e-6)
        assert near.sum() > 4
        assert ((facing > 0) & (facing <= 1)).all()


def test_measured_depth_lies_on_matter_but_for_noise(home):
    camera = home.intrinsics
    for view in list(views_of(home))[::8]:
        assert view.depth_m.shape == (camera.height_px, camera.width_px)
        assert view.depth_m.dtype == np.float32
        points = back_project(view.depth_m, camera)[view.depth_m > 0]
        points = points[points[:, 2] < 4]
        points_m = transform(view.world_from_camera, points)
        around = [
            matter_at(home, points_m + step) for step in 0.05 * np.vstack((np.eye(3), -np.eye(3), np.zeros((1, 3))))
        ]
        assert np.mean(np.any(around, axis=0)) > 0.995


def test_depth_has_noise_that_grows_and_holes(home):
    rays = np.tile([0.0, 0.0, 1.0], (4000, 1))
    view = next(views_of(home))
    assert 0.3 < (view.depth_m > 0).mean() < 1
    depth_m, _ = depths(home, view.world_from_camera, rays, SEEN_GLASS.repeat(len(rays)))
    assert np.ptp(depth_m) == 0  # the world itself has none


def glass_box():
    plan = Plan(np.random.default_rng(0), "glass")
    plan.slab(Rect(0, 0, 4, 4), 0.0)
    plan.box(Rect(2, 0, 2.05, 4), 0.0, 3.0, GLASS)
    plan.box(Rect(3, 0, 3.05, 4), 0.0, 3.0)
    return plan


def test_glass_lets_rays_pass_loses_them_or_returns_them(home):
    grid, origin_m = filled(glass_box())
    world = replace(home, grid=grid, origin_m=origin_m)
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # looks along x
    pose[:3, 3] = (1.01, 2.01, 1.51)
    rays = np.tile([0.0, 0.0, 1.0], (3, 1))
    chances = np.array([THROUGH / 2, (THROUGH + LOST) / 2, (LOST + 1) / 2])
    depth_m, _ = depths(world, pose, rays, chances)
    np.testing.assert_allclose(depth_m, [1.99, 0.0, 0.99])


def test_ways_climb_steps_and_not_tables():
    grid = np.zeros((60, 24, 60), np.uint8)
    grid[:, :, :4] = 1
    grid[30:, :, 4:7] = 1  # a step of 0.15 m
    grid[10:16, 10:14, 4:19] = 1  # a table
    ways = ways_of(grid, np.zeros(3), 0.05)
    start = int(np.ravel_multi_index((2, 6, 5), ways.heights.shape))
    reached = ways.position_m(np.flatnonzero(ways.reached(start, 1)))
    assert {round(z, 2) for z in reached[:, 2].tolist()} == {0.2, 0.35}
    assert ways.heights.shape[:2] == (30, 12)
    assert pytest.approx(0.1) == CELL_M


def test_an_outline_follows_touching_rectangles_and_moves_inwards():
    corners = outline([Rect(0, 0, 4, 2), Rect(0, 2, 2, 5)], 0.1)
    expected = [[0.1, 0.1], [3.9, 0.1], [3.9, 1.9], [1.9, 1.9], [1.9, 4.9], [0.1, 4.9]]
    assert sorted(corners.tolist()) == sorted(expected)
    assert polygon_area(corners) > 0


def test_a_door_fits_a_wall_that_just_suffices():
    """1.0 m for 0.8 m and 0.1 m of wall on each side: of 1.0 - 0.8 - 0.2 rounding makes less than nothing."""
    plan = Plan(np.random.default_rng(0), "corridor")
    one, other = (plan.room(label, Rect(x, 0, x + 3, 1), Level(0.0, 2.6)) for label, x in (("a", 0), ("b", 3)))
    plan.door(one, other, 0.8)
    assert len(one.kept_free) == len(other.kept_free) == 1


def test_nothing_is_put_where_it_would_block_the_way_between_two_doors():
    plan = Plan(np.random.default_rng(0), "corridor")
    rooms = [plan.room(name, Rect(x, 0, x + 3, 2), Level(0, 2.6)) for name, x in (("a", 0), ("b", 3), ("c", 6))]
    plan.door(rooms[0], rooms[1])
    plan.door(rooms[1], rooms[2])
    assert not plan.fits(rooms[1], Rect(4.2, 0.1, 4.6, 1.9))
    assert not plan.fits(rooms[1], Rect(2.9, 0.1, 3.4, 0.5))  # outside
    assert not plan.fits(rooms[1], rooms[1].kept_free[0])
