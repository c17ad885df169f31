"""Map, distances, Voronoi diagram and places, against SciPy, brute force, geometry by hand and exact floor plans."""

import csv
import functools
import heapq
import itertools
import json
from dataclasses import dataclass, field

import cv2
import msgspec
import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from prior_sg.schemas.codec import copied, encode
from prior_sg.schemas.frames import ArchiveReply, Intrinsics, Keyframe, PoseUpdate
from prior_sg.schemas.places import MapRequest, PlaceDelta, SnapshotRequest
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.succession import Succession, TakesOver
from prior_sg.schemas.topics import ARCHIVE, PLACE_DELTA, PLACE_SNAPSHOT, SCENE, VOXEL_MAP
from prior_sg.services import images
from prior_sg.services.geometry import inside_polygon, pose_from_quaternion
from prior_sg.services.place_graph import service
from prior_sg.services.place_graph.core import fusing, publishing, renewal
from prior_sg.services.place_graph.core import openings as frontiers
from prior_sg.services.place_graph.core import state as core
from prior_sg.services.place_graph.core.config import PRESETS, Config, preset
from prior_sg.services.place_graph.core.skeleton import distance, links
from prior_sg.services.place_graph.core.skeleton import places as extraction
from prior_sg.services.place_graph.core.volume import coarse, tsdf
from prior_sg.services.place_graph.core.volume.grid import (
    BLOCK,
    DERIVED,
    FAR_D2,
    FREE,
    MEASURED,
    OCCUPIED,
    UNKNOWN_D2,
    UNOBSERVED,
    Block,
    Box,
    VoxelGrid,
)
from prior_sg.services.place_graph.core.volume.tsdf import dilated
from prior_sg.services.refusals import NotYet
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.config import resolve
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from tests.help.paths import SHARED_DATA

DATA = SHARED_DATA
CAMERA = Intrinsics(120, 120, 60.0, 60.0, 59.5, 59.5)
CFG = Config()
FEARLESS = Config(max_speed_m_s=0.0)  # believes every pose
CFG_STRICT = Config(jump_slack_m=0.1, max_speed_m_s=0.01)
FORWARD = (0.5, -0.5, 0.5, -0.5)  # camera z along world x, image upright
HALF = np.sqrt(0.5)


# World by hand: solids are axis-aligned boxes; a cube of six 90 degree views sees everything around a point.


def views(x_m: float, y_m: float, z_m: float) -> list[np.ndarray]:
    base = pose_from_quaternion(np.array((x_m, y_m, z_m)), np.array(FORWARD))
    turns = [
        (0, 0, 0, 1),
        (0, HALF, 0, HALF),
        (0, 1, 0, 0),
        (0, -HALF, 0, HALF),
        (HALF, 0, 0, HALF),
        (-HALF, 0, 0, HALF),
    ]
    return [base @ pose_from_quaternion(np.zeros(3), np.array(q, float)) for q in turns]


def render(solids: np.ndarray, world_from_camera: np.ndarray) -> bytes:
    v, u = np.indices((CAMERA.height_px, CAMERA.width_px))
    rays = np.stack(((u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px, np.ones(u.shape)), axis=-1)
    rays = rays.reshape(-1, 1, 3) @ world_from_camera[:3, :3].T + 1e-12
    bounds = (solids - world_from_camera[:3, 3]) / rays[:, :, None]
    enter, leave = bounds.min(axis=2).max(axis=-1), bounds.max(axis=2).min(axis=-1)
    depth_m = np.where((enter < leave) & (enter > 0), enter, np.inf).min(axis=1)
    image = np.where(np.isfinite(depth_m), depth_m * 1000, 0).astype(np.uint16).reshape(u.shape)
    return cv2.imencode(".png", image)[1].tobytes()


def keyframe(frame_id: int, world_from_camera: np.ndarray, depth: bytes, camera: Intrinsics = CAMERA) -> Keyframe:
    return Keyframe(
        robot="r",
        frame_id=frame_id,
        stamp_ns=frame_id * 10**9,
        intrinsics=camera,
        world_from_camera=world_from_camera,
        color=b"",
        depth=depth,
        depth_scale_m=0.001,
    )


def shell(low: tuple[float, ...], high: tuple[float, ...], wall_m: float = 0.3) -> list[tuple]:
    """Six slabs around a room."""
    outer = np.array((np.array(low) - wall_m, np.array(high) + wall_m))
    slabs = []
    for axis in range(3):
        for side in range(2):
            slab = outer.copy()
            slab[1 - side, axis] = (low, high)[side][axis]
            slabs.append(slab)
    return slabs


ROOM = (np.zeros(3), np.array((4.0, 3.0, 2.4)))
ROOM_SOLIDS = np.array(shell(*ROOM))
TWO_ROOMS = np.array(
    [
        *shell((0, 0, 0), (6.2, 3, 2.4)),
        ((3.0, 0.0, 0.0), (3.2, 1.05, 2.4)),
        ((3.0, 1.95, 0.0), (3.2, 3.0, 2.4)),
        ((3.0, 1.05, 2.1), (3.2, 1.95, 2.4)),  # lintel: the doorway is 0.9 m wide and 2.1 m high
    ]
)


def walk(solids: np.ndarray, stations: list[tuple[float, float, float]]) -> list[Keyframe]:
    poses = [pose for station in stations for pose in views(*station)]
    return [keyframe(n, pose, render(solids, pose)) for n, pose in enumerate(poses)]


ROOM_WALK = walk(ROOM_SOLIDS, [(1.1, 1.4, 1.3), (2.9, 1.6, 1.2)])
TWO_ROOMS_WALK = walk(TWO_ROOMS, [(1.4, 1.5, 1.3), (3.1, 1.5, 1.3), (4.7, 1.5, 1.3)])


def start(cfg: core.Config = CFG) -> core.State:
    return service.init(cfg, Identity("r", "test", 7))


def play(state: core.State, frames: list[Keyframe], cfg: core.Config = CFG) -> list[PlaceDelta]:
    published = Runner(service.SERVICE, cfg, state=state).feed(*frames)
    assert all(topic is PLACE_DELTA for topic, _ in published)
    return [delta for _, delta in published]


@pytest.fixture(scope="module")
def room():
    state = start()
    return state, play(state, ROOM_WALK)


@pytest.fixture(scope="module")
def two_rooms():
    state = start()
    return state, play(state, TWO_ROOMS_WALK)


def ask(state: core.State, cfg: Config = CFG) -> PlaceDelta:
    return service.SERVICE.answers[PLACE_SNAPSHOT](state, SnapshotRequest(robot="r"), cfg)


# What a reader of the stream knows, in the order of application that the schema states.


@dataclass
class Reader:
    places: dict = field(default_factory=dict)
    edges: dict = field(default_factory=dict)
    merged: set = field(default_factory=set)
    frontiers: dict = field(default_factory=dict)

    def apply(self, delta: PlaceDelta) -> None:
        for a, b in delta.removed_edges.tolist():
            del self.edges[a, b]
        for gone in [*delta.removed_ids.tolist(), *delta.merged_ids[:, 0].tolist()]:
            del self.places[gone]
            self.frontiers.pop(gone, None)
            self.edges = {pair: c for pair, c in self.edges.items() if gone not in pair}
        for n, place_id in enumerate(delta.place_ids.tolist()):
            assert place_id not in self.merged
            self.places[place_id] = (
                *delta.positions_m[n].tolist(),
                float(delta.radii_m[n]),
                int(delta.basis_points[n]),
            )
        self.merged.update(delta.merged_ids[:, 0].tolist())
        assert all(into in self.places for _, into in delta.merged_ids.tolist())
        for (a, b), clearance in zip(delta.edges.tolist(), delta.clearances_m.tolist(), strict=True):
            assert a < b and a in self.places and b in self.places
            self.edges[a, b] = clearance
        openings = np.concatenate((delta.frontier_directions, delta.frontier_areas_m2[:, None]), axis=1)
        for place_id, opening in zip(delta.frontier_ids.tolist(), openings.tolist(), strict=True):
            assert place_id in self.places
            self.frontiers[place_id] = opening
            if not opening[3]:
                del self.frontiers[place_id]


def read(deltas: list[PlaceDelta]) -> Reader:
    reader = Reader()
    for delta in deltas:
        reader.apply(delta)
    return reader


def canonical(state: core.State) -> tuple[dict, dict]:
    """Places and edges by position instead of id."""
    places = state.graph.places
    edges = {
        (places[a].voxel, places[b].voxel): c for a, links_ in state.graph.edges.items() for b, c in links_.items()
    }
    return {p.voxel: p[1:] for p in places.values()}, edges


# Distance field.


def field_of(label: np.ndarray, max_distance: float) -> tuple[np.ndarray, np.ndarray]:
    d2, offset = np.full(label.shape, UNKNOWN_D2, np.int16), np.zeros((*label.shape, 3), np.int8)
    inner = np.zeros(label.shape, bool)
    inner[distance.RIM : -distance.RIM, distance.RIM : -distance.RIM, distance.RIM : -distance.RIM] = True
    _, inside = distance.repair(label, d2, offset, np.argwhere(inner), distance.RIM, int(max_distance**2))
    assert inside == (label[~inner] == UNOBSERVED).all()
    return d2, offset


def by_definition(label: np.ndarray, max_distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances and offsets by the definition, settled one by one in order of distance, without any of our code."""
    d2 = np.where(label == FREE, FAR_D2, UNKNOWN_D2).astype(np.int32)
    offset = np.zeros((*label.shape, 3), np.int8)
    d2[label == OCCUPIED] = 0
    queue = [(0, (0, 0, 0), tuple(voxel)) for voxel in np.argwhere(label == OCCUPIED).tolist()]
    free = set(map(tuple, np.argwhere(label == FREE).tolist()))
    settled: dict = {}
    while queue:
        reach, backwards, voxel = heapq.heappop(queue)  # of equal distances the largest offset comes first
        if voxel in settled:
            continue
        settled[voxel] = own = tuple(-b for b in backwards)
        d2[voxel], offset[voxel] = reach, own
        for reach, further, step in onwards(own, max_distance):
            other = (voxel[0] + step[0], voxel[1] + step[1], voxel[2] + step[2])
            if other in free and other not in settled:
                heapq.heappush(queue, (reach, further, other))
    return d2, offset


@functools.cache
def onwards(own: tuple[int, int, int], max_distance: float) -> list:
    """Squared distance, negated offset and step of all neighbours to which an offset may be handed on."""
    found = []
    for step in itertools.product((-1, 0, 1), repeat=3):
        further = tuple(o + s for o, s in zip(own, step, strict=True))
        back = any(o * s < 0 for o, s in zip(own, step, strict=True))
        if any(step) and not back and (reach := sum(f * f for f in further)) <= max_distance**2:
            found.append((reach, tuple(-f for f in further), step))
    return found


def observed(grid: VoxelGrid) -> np.ndarray:
    return np.concatenate((grid.voxels_with(FREE), grid.voxels_with(OCCUPIED)))


def everywhere(grid: VoxelGrid) -> np.ndarray:
    low, high = grid.bounds
    return np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)


def random_world(seed: int, density: float, unobserved: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    draw = rng.random((34, 30, 26))
    label = np.where(draw < density, OCCUPIED, np.where(draw < density + unobserved, UNOBSERVED, FREE)).astype(np.uint8)
    solid = np.zeros(label.shape, bool)
    solid[distance.RIM : -distance.RIM, distance.RIM : -distance.RIM, distance.RIM : -distance.RIM] = True
    return np.where(solid, label, UNOBSERVED).astype(np.uint8)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("density", [0.0005, 0.005, 0.05])
def test_distances_of_an_observed_world_are_euclidean(seed, density):
    label = random_world(seed, density)
    d2, offset = field_of(label, 15.0)
    exact, nearest = ndimage.distance_transform_edt(label != OCCUPIED, return_indices=True)
    exact2 = ((nearest - np.indices(label.shape)) ** 2).sum(axis=0)
    reached = (label == FREE) & (exact <= 15.0)
    assert (d2[reached] >= exact2[reached]).all()
    assert (d2[reached] == exact2[reached]).mean() > 0.999  # a wave front may miss a sliver of a Voronoi cell ...
    assert (np.sqrt(d2[reached]) - exact[reached]).max() < 0.2  # ... and is then wrong by a fraction of a voxel
    assert (d2[(label == FREE) & (exact > 15.0)] == FAR_D2).all()
    sites = np.argwhere(reached) - offset[reached]
    assert (label[tuple(sites.T)] == OCCUPIED).all()
    assert ((offset[reached].astype(int) ** 2).sum(axis=1) == d2[reached]).all()


@pytest.mark.parametrize("seed", range(6))
def test_waves_stay_in_observed_space(seed):
    label = random_world(seed, 0.003, unobserved=0.6)
    d2, offset = field_of(label, 15.0)
    part, _ = ndimage.label(label != UNOBSERVED, np.ones((3, 3, 3)))
    reached = np.argwhere((label == FREE) & (d2 != FAR_D2))
    assert len(reached) > 50
    sites = reached - offset[tuple(reached.T)]
    assert (part[tuple(reached.T)] == part[tuple(sites.T)]).all()
    assert (d2[label == UNOBSERVED] == UNKNOWN_D2).all()


def test_no_wave_behind_an_unobserved_wall():
    label = np.full((24, 12, 12), FREE, np.uint8)
    label[4] = OCCUPIED
    label[10] = UNOBSERVED
    label[:2] = label[-2:] = label[:, :2] = label[:, -2:] = label[:, :, :2] = label[:, :, -2:] = UNOBSERVED
    d2, _ = field_of(label, 20.0)
    inner = slice(distance.RIM, -distance.RIM)
    assert (d2[9, inner, inner] == 25).all()
    assert (d2[11:-2, inner, inner] == FAR_D2).all()


def grid_of(label: np.ndarray) -> VoxelGrid:
    grid = VoxelGrid()
    for index in np.ndindex(*(n // BLOCK for n in label.shape)):
        part = tuple(slice(i * BLOCK, (i + 1) * BLOCK) for i in index)
        grid.insert(index, Block(label=label[part].copy()))
    return grid


FIELD = distance.FieldRules(max_distance=7.0, voronoi_min_distance=1.0, parent_l1=20.0, parent_cos=0.2)


def fields_of(grid: VoxelGrid) -> dict[str, np.ndarray]:
    return {name: grid.gather(name, grid.bounds) for name in ("d2", "offset", "basis")}


@pytest.mark.parametrize("seed", range(4))
def test_repairing_a_change_equals_the_definition_and_a_fresh_start(seed):
    rng = np.random.default_rng(seed)
    label = np.where(rng.random((32, 32, 32)) < 0.01, OCCUPIED, FREE).astype(np.uint8)
    label[rng.random(label.shape) < 0.2] = UNOBSERVED
    rim = np.ones(label.shape, bool)
    rim[2:-2, 2:-2, 2:-2] = False
    label[rim] = UNOBSERVED
    local = grid_of(label)
    distance.refresh(local, everywhere(local), FIELD)
    for _ in range(4):
        low = rng.integers(3, (22, 22, 22))
        changed = Box(low, low + rng.integers(1, 7, 3))
        part = tuple(slice(a, b) for a, b in zip(changed.low, changed.high, strict=True))
        before = label[part].copy()
        label[part] = rng.choice((UNOBSERVED, FREE, OCCUPIED), before.shape).astype(np.uint8)
        local.scatter({"label": label[part]}, changed)
        distance.refresh(local, np.argwhere(label[part] != before) + low, FIELD)
    whole = grid_of(label)
    distance.refresh(whole, everywhere(whole), FIELD)
    for name, values in fields_of(whole).items():
        np.testing.assert_array_equal(fields_of(local)[name], values)
    d2, offset = by_definition(label, FIELD.max_distance)
    np.testing.assert_array_equal(fields_of(local)["d2"], d2)
    np.testing.assert_array_equal(fields_of(local)["offset"], offset)


def test_diagram_of_two_walls_is_the_plane_between_them():
    label = np.full((16, 32, 32), FREE, np.uint8)
    label[2] = label[12] = OCCUPIED
    label[:2] = label[13:] = UNOBSERVED
    grid = grid_of(np.concatenate((label, np.zeros_like(label))))
    distance.refresh(grid, everywhere(grid), FIELD)
    basis = grid.gather("basis", grid.bounds)[:, 8:24, 8:24]
    assert (basis[7] == 2).all()
    assert not basis[3:6].any() and not basis[9:12].any()


# Map.


@pytest.mark.parametrize("shape", [(5, 7, 3), (1, 4, 2)])
def test_a_mask_grows_by_one_voxel_in_all_directions(shape):
    mask = np.random.default_rng(0).random(shape) < 0.1
    before = mask.copy()
    np.testing.assert_array_equal(dilated(mask), ndimage.maximum_filter(mask, size=3))
    np.testing.assert_array_equal(mask, before)


@pytest.mark.parametrize("cfg", [CFG, preset("outdoor", max_range_m=60.0)], ids=["indoor", "far"])
def test_blocks_that_are_left_out_are_those_of_which_a_view_says_nothing(cfg):
    views_of = [
        tsdf.View(images.depth_of(frame, 0.5), CAMERA, frame.world_from_camera) for frame in TWO_ROOMS_WALK[::4]
    ]
    reach = min(int(cfg.max_range_m / (BLOCK * cfg.voxel_m)) + 2, 6)  # the rooms end before
    all_around = np.array(list(itertools.product(range(-reach, reach + 1), repeat=3)))
    some, every = VoxelGrid(), VoxelGrid()
    for view in views_of:
        tsdf.integrate(some, view, cfg.fusion, tsdf.blocks_of(view, cfg.fusion))
        tsdf.integrate(every, view, cfg.fusion, all_around)
    assert list(some.blocks) == list(every.blocks)
    for key, block in some.blocks.items():
        for name in MEASURED:
            np.testing.assert_array_equal(getattr(block, name), getattr(every.blocks[key], name))
    assert max(len(tsdf.blocks_of(view, cfg.fusion)) for view in views_of) < len(all_around) / 15


def test_one_ray_frees_voxels_before_the_surface_and_leaves_those_behind_unobserved():
    camera = Intrinsics(1, 1, 10.0, 10.0, 0.0, 0.0)
    pose = pose_from_quaternion(np.array((0.0, 0.05, 0.05)), np.array(FORWARD))
    state = start()
    fusing.fuse(state, keyframe(0, pose, b"", camera), np.array([[2.05]], np.float32), CFG)
    line = Box(np.array((0, 0, 0)), np.array((32, 1, 1)))
    label = state.grid.gather("label", line).ravel()
    units = state.grid.gather("weight", line).ravel()
    tsdf_m = CFG.truncation_m * state.grid.gather("sdf", line).ravel() / np.maximum(units, 1)
    weight = units / CFG.fusion.unit
    # Centres at 0.05, 0.15, ...; truncated at 0.3 m; obstacle from 0.05 m before the surface to 0.3 m behind it.
    assert label[:2].tolist() == [UNOBSERVED] * 2
    assert (label[2:20] == FREE).all() and (label[20:23] == OCCUPIED).all() and (label[23:] == UNOBSERVED).all()
    assert tsdf_m[[5, 17, 19, 20, 22]] == pytest.approx([0.3, 0.3, 0.1, 0.0, -0.2], abs=1e-3)
    assert weight[[5, 20, 21, 22]] == pytest.approx([1 / 0.55**2, 1 / 2.05**2, 1 / 2.15**2, 0.5 / 2.25**2], rel=2e-3)


def test_voxels_of_a_room_are_free_inside_and_occupied_at_its_walls(room):
    state, _ = room
    answer = service.SERVICE.answers[VOXEL_MAP](state, MapRequest(robot="r"), CFG)
    free = (answer.free + 0.5) * answer.voxel_m
    low, high = ROOM
    assert ((free > low - 0.05) & (free < high + 0.05)).all()
    inside = np.prod(np.round((high - low) / CFG.voxel_m))
    assert len(free) > 0.85 * inside
    occupied = (answer.occupied + 0.5) * answer.voxel_m
    outside_m = np.maximum(low - occupied, occupied - high).max(axis=1)
    assert outside_m.min() > -0.1 and outside_m.max() < 0.3
    assert not {tuple(v) for v in answer.free.tolist()} & {tuple(v) for v in answer.occupied.tolist()}


# Places.


def test_places_of_a_room_are_connected_and_know_the_distance_to_its_walls(room):
    state, _ = room
    places = ask(state)
    low, high = ROOM
    positions = places.positions_m.astype(float)
    truth_m = np.minimum(positions - low, high - positions).min(axis=1)
    assert len(places.place_ids) >= 8
    assert np.abs(places.radii_m - truth_m).max() < CFG.voxel_m
    assert places.radii_m.max() == pytest.approx(1.2, abs=CFG.voxel_m)
    assert places.radii_m.min() >= CFG.min_node_distance_m
    assert (places.basis_points >= 2).all()
    assert parts(places) == 1


@pytest.mark.parametrize("policy", ["basis_points", "middle"])
def test_a_sphere_ends_at_an_obstacle_behind_a_hole_in_the_depth(policy):
    label = np.full((48, 48, 48), UNOBSERVED, np.uint8)
    label[6:42, 6:42, 6:30] = FREE
    label[6:42, 6:42, 32] = OCCUPIED  # a ceiling behind two voxels that nobody saw
    label[[6, 41], 6:42, 6:30] = label[6:42, [6, 41], 6:30] = label[6:42, 6:42, 6] = OCCUPIED
    grid = grid_of(label)
    box = distance.refresh(grid, observed(grid), CFG.field_rules)
    rules = extraction.ExtractionRules(cell=10, min_radius=4.0, merge=5.0, policy=policy)
    found = extraction.extract(grid, extraction.whole_cells(box, 10), rules)
    centers = found.voxels + found.shifts / extraction.SHIFT_UNITS
    gap2 = ((centers[:, None] - np.argwhere(label == OCCUPIED)) ** 2).sum(axis=2).min(axis=1)
    np.testing.assert_allclose(found.free_d2, np.minimum(gap2, found.d2))
    assert (found.free_d2 < found.d2 - 20).any()
    assert (found.free_d2 == found.d2).any()


@pytest.mark.parametrize("policy", ["basis_points", "middle"])
def test_places_of_a_region_are_those_that_its_whole_window_has_there(two_rooms, policy):
    grid = two_rooms[0].grid
    window = extraction.whole_cells(grid.bounds, 10)
    rules = extraction.ExtractionRules(cell=10, min_radius=4.0, merge=5.0, policy=policy)
    every = extraction.extract(grid, window, rules)
    region = Box(window.low, np.array((window.low[0] + 40, *window.high[1:])))
    some = extraction.extract(grid, window, rules, region)
    inside = region.contains(every.voxels)
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(every.voxels, some.voxels)
    np.testing.assert_array_equal(every.touching, some.touching)
    for name in ("shifts", "d2", "free_d2", "basis"):
        np.testing.assert_array_equal(getattr(every, name)[inside], getattr(some, name)[inside])
    np.testing.assert_array_equal(every.field_d2, grid.gather("d2", window, UNKNOWN_D2))


def parts(places: PlaceDelta) -> int:
    index = np.searchsorted(places.place_ids, places.edges)
    size = len(places.place_ids)
    return connected_components(csr_matrix((np.ones(len(index)), index.T), (size, size)), directed=False)[0]


def test_an_edge_leads_through_the_doorway_and_none_through_the_wall(two_rooms):
    state, _ = two_rooms
    places = ask(state)
    by_id = dict(zip(places.place_ids.tolist(), places.positions_m.astype(float), strict=True))
    crossings = []
    for a, b in places.edges.tolist():
        one, two = by_id[a], by_id[b]
        if (one[0] - 3.1) * (two[0] - 3.1) < 0:
            crossings.append(one + (two - one) * (3.1 - one[0]) / (two[0] - one[0]))
    assert crossings
    assert all(1.05 < y < 1.95 and 0 < z < 2.1 for _, y, z in crossings)
    assert parts(places) == 1


def test_clearance_is_what_every_edge_has_all_along(two_rooms):
    state, _ = two_rooms
    places = ask(state)
    by_id = dict(zip(places.place_ids.tolist(), places.positions_m.astype(float), strict=True))
    for (a, b), clearance_m in zip(places.edges.tolist(), places.clearances_m.tolist(), strict=True):
        points = np.linspace(by_id[a], by_id[b], 50)[:, None]
        gap_m = np.linalg.norm(np.maximum(np.maximum(TWO_ROOMS[:, 0] - points, points - TWO_ROOMS[:, 1]), 0), axis=-1)
        assert gap_m.min() > clearance_m - 1.5 * CFG.voxel_m
        assert clearance_m >= CFG.min_edge_distance_m - 1e-6


def test_graph_after_each_frame_equals_the_graph_of_the_finished_map(two_rooms):
    state, _ = two_rooms
    batch = start()
    for frame in TWO_ROOMS_WALK:
        fusing.fuse(batch, frame, images.depth_of(frame, 0.5), CFG)
    renewal.renew(batch, observed(batch.grid), CFG)
    assert canonical(state) == canonical(batch)


def test_readers_of_the_deltas_know_what_the_snapshot_says(two_rooms):
    state, deltas = two_rooms
    told, snapshot = read(deltas), ask(state)
    assert [d.revision for d in deltas] == list(range(len(TWO_ROOMS_WALK)))
    assert (snapshot.snapshot, snapshot.revision, snapshot.epoch) == (True, deltas[-1].revision, 7)
    assert snapshot.past_frame_ids.tolist() == [d.frame_id for d in deltas]
    np.testing.assert_allclose(snapshot.past_cameras_m, [d.camera_m for d in deltas], rtol=1e-6)
    assert (np.diff(snapshot.place_ids) > 0).all()
    known = Reader()
    known.apply(snapshot)
    assert (told.places, told.edges) == (known.places, known.edges)
    assert sum(len(d.merged_ids) + len(d.removed_ids) for d in deltas) > 0


def test_same_keyframes_give_the_same_bytes(two_rooms):
    _, deltas = two_rooms
    assert [encode(d) for d in play(start(), TWO_ROOMS_WALK)] == [encode(d) for d in deltas]


def test_nothing_changes_when_the_same_views_come_again():
    state = start()
    play(state, ROOM_WALK)
    before = ask(state)
    again = [keyframe(100 + n, f.world_from_camera, f.depth) for n, f in enumerate(ROOM_WALK)]
    deltas = play(state, again)
    assert [d.frame_id for d in deltas] == [100 + n for n in range(len(ROOM_WALK))]
    assert set(before.place_ids.tolist()) <= set(ask(state).place_ids.tolist())
    assert sum(len(d.place_ids) for d in deltas) <= len(before.place_ids) // 4


def test_places_keep_their_ids_when_an_obstacle_appears_elsewhere():
    forgetful = Config(max_weight=2.0)
    state = start(forgetful)
    play(state, TWO_ROOMS_WALK, forgetful)
    before = ask(state)
    box = np.concatenate((TWO_ROOMS, [((0.4, 1.2, 0.0), (0.9, 1.8, 1.2))]))
    away_from_the_door = views(1.9, 1.5, 1.3)[2]  # along -x
    seen = render(box, away_from_the_door)
    later = [keyframe(50 + n, away_from_the_door, seen) for n in range(12)]
    deltas = play(state, later, forgetful)
    told = {i for d in deltas for i in (*d.place_ids.tolist(), *d.removed_ids.tolist(), *d.merged_ids[:, 0].tolist())}
    near = {i for i, (x, *_) in zip(before.place_ids.tolist(), before.positions_m.tolist(), strict=True) if x < 3.1}
    assert told & near
    assert told.isdisjoint(set(before.place_ids.tolist()) - near)
    assert len(near & set(ask(state).place_ids.tolist())) >= len(near) // 2
    after = read([before, *deltas])
    known = Reader()
    known.apply(ask(state))
    assert (after.places, after.edges) == (known.places, known.edges)


def test_thinning_keeps_what_is_connected_connected():
    rng = np.random.default_rng(3)
    voxels = rng.integers(0, 40, (60, 3))
    squared = ((voxels[:, None] - voxels[None]) ** 2).sum(axis=2)
    clear = np.where((squared > 0) & (squared < 14**2) & (rng.random(squared.shape) < 0.5), 9, 0).astype(np.int32)
    clear = np.triu(clear, 1) + np.triu(clear, 1).T
    keep = links.thinned(clear, voxels, np.zeros(clear.shape, bool), 1.0)
    before = connected_components(csr_matrix(clear), directed=False)
    after = connected_components(csr_matrix(keep), directed=False)
    assert before[0] == after[0] and (before[1] == after[1]).all()
    assert keep.sum() < np.triu(clear > 0).sum()


def _edges_by_definition(d2, voxels, touching, limits):
    """All edges of places (n, 3) of a window, by their ends, with their squared clearance."""
    clear = links.clear_lines(d2, voxels, touching, *limits)
    keep = links.thinned(clear, voxels, touching, limits[0])
    return {(int(a), int(b)): int(clear[a, b]) for a, b in np.argwhere(keep)}


@pytest.mark.parametrize("seed", range(6))
def test_a_change_in_a_box_concerns_no_other_edges_and_those_it_concerns_are_found(seed):
    rng = np.random.default_rng(seed)
    shape, limits = (60, 60, 14), (4.0, 144.0, 9.0)
    free = rng.random(shape) > 0.004
    d2 = np.rint(ndimage.distance_transform_edt(free) ** 2).astype(np.int16)
    voxels = np.argwhere(free)[rng.choice(free.sum(), 130, replace=False)]
    near = ((voxels[:, None] - voxels[None]) ** 2).sum(axis=2) < 15**2
    touching = np.triu(near & (rng.random(near.shape) < 0.1), 1)
    touching |= touching.T
    before = _edges_by_definition(d2, voxels, touching, limits)
    low, high = np.array((24, 24, 2)), np.array((34, 36, 12))
    part = tuple(slice(*ends) for ends in zip(low, high, strict=True))
    d2[part] = np.rint(ndimage.distance_transform_edt(rng.random(high - low) > 0.02) ** 2)
    inside = Box(low, high).contains(voxels)
    voxels[inside] = rng.integers(low, high, (inside.sum(), 3))
    after = _edges_by_definition(d2, voxels, touching, limits)

    pairs, clearances = links.joined(d2, voxels, touching, low, high, *limits)
    found = dict(zip(map(tuple, pairs.tolist()), clearances.tolist(), strict=True))
    old = np.array(sorted(before)).reshape(-1, 2)
    gone = links.concerned(voxels, old, low, high, limits[1], 0)
    kept = {pair: before[pair] for pair in map(tuple, old[~gone].tolist())}
    assert not kept.keys() & found.keys()
    assert kept | found == after
    assert len(found) < len(after) / 2
    assert any(before.get(pair) != after.get(pair) for pair in before.keys() | after.keys())


# Frontiers.


def test_a_doorway_not_yet_passed_is_a_frontier_that_closes_once_it_is_seen_through():
    state = start()
    first = play(state, walk(TWO_ROOMS, [(0.8, 0.6, 1.3)]))  # sees little through the door, aslant
    opened = read(first).frontiers
    assert opened == read([ask(state)]).frontiers and opened
    positions = dict(zip(ask(state).place_ids.tolist(), ask(state).positions_m.tolist(), strict=True))
    widest = max(opened, key=lambda i: opened[i][3])
    assert positions[widest][0] > 2.0 and positions[widest][1] > 0.8
    assert opened[widest][3] > 0.4
    normals = np.linalg.norm([o[:3] for o in opened.values()], axis=1)
    np.testing.assert_allclose(normals, 1.0, rtol=1e-5)
    later = play(state, [keyframe(50 + n, f.world_from_camera, f.depth) for n, f in enumerate(TWO_ROOMS_WALK)])
    closed = read([*first, *later]).frontiers
    assert closed == read([ask(state)]).frontiers
    assert sum(o[3] for o in closed.values()) < 0.5 * sum(o[3] for o in opened.values())


def test_normals_of_a_hole_cancel_and_those_of_an_opening_add_up():
    label = np.full((20, 20, 20), OCCUPIED, np.uint8)
    label[2:18, 2:18, 2:18] = FREE
    label[8:11, 8:10, 8:12] = UNOBSERVED  # a hole
    label[18, 5:9, 6:12] = UNOBSERVED  # an opening of 4 by 6
    found = frontiers.summed_normals(label, np.array([(5, 9, 9), (14, 9, 9), (14, 9, 10)]), np.full(3, 12.0))
    assert found.sum(axis=0).tolist() == [24, 0, 0] and found[1:].any(axis=1).all()
    assert not frontiers.summed_normals(label, np.array([(5, 9, 9)]), np.array([1.5])).any()


def test_openings_do_not_depend_on_the_order_of_keyframes(two_rooms):
    state = start(FEARLESS)
    play(state, TWO_ROOMS_WALK[::-1], FEARLESS)

    def by_position(s):
        return {s.graph.places[i].voxel: s.openings.normals[i] for i in s.graph.places}

    assert by_position(state) == by_position(two_rooms[0])


# A field coarser than the map.


MIXED = Config(field_voxels=2)


def test_a_coarse_voxel_is_an_obstacle_if_any_of_its_voxels_is_and_free_if_half_of_them_are():
    fine, field = VoxelGrid(MEASURED), VoxelGrid(DERIVED)
    block = fine.blank()
    block.label[0:2, 0:2, 0] = FREE  # 4 of 8
    block.label[2:4, 0:2, 0:2], block.label[3, 1, 1] = FREE, OCCUPIED
    block.label[4:6, 0, 0], block.label[4, 1, 0] = FREE, FREE  # 3 of 8
    fine.insert((-1, 0, 1), block)
    changed = coarse.renew_labels(fine, field, np.array(((-16, 0, 16), (-13, 1, 17))), 2)
    assert changed.tolist() == [[-8, 0, 8], [-7, 0, 8]]
    line = Box(np.array((-8, 0, 8)), np.array((-5, 1, 9)))
    assert field.gather("label", line).ravel().tolist() == [FREE, OCCUPIED, UNOBSERVED]
    assert not len(coarse.renew_labels(fine, field, np.array(((-16, 0, 16),)), 2))


@pytest.mark.parametrize("cfg", [MIXED, preset("mixed")], ids=["parts stay", "small parts are absorbed"])
def test_a_coarser_field_after_each_frame_is_that_of_the_finished_map_in_any_order(cfg):
    state, batch, backwards = start(cfg), start(cfg), start(msgspec.structs.replace(cfg, max_speed_m_s=0.0))
    deltas = play(state, TWO_ROOMS_WALK, cfg)
    play(backwards, TWO_ROOMS_WALK[::-1], msgspec.structs.replace(cfg, max_speed_m_s=0.0))
    for frame in TWO_ROOMS_WALK:
        fusing.fuse(batch, frame, images.depth_of(frame, 0.5), cfg)
    renewal.renew(batch, observed(batch.grid), cfg)
    assert canonical(state) == canonical(batch) == canonical(backwards)
    near = msgspec.structs.replace(cfg, map_window_max_radius_m=1.5)
    compressed = start(near)
    assert [encode(d) for d in play(compressed, TWO_ROOMS_WALK, near)] == [encode(d) for d in deltas]
    assert compressed.grid.packed_bytes > 0 and compressed.field.packed_bytes > 0


@pytest.mark.parametrize("offset_m", [0.0, 0.03, 0.05, 0.1, 0.13])
def test_no_radius_of_a_coarser_field_reaches_through_a_wall_wherever_the_grid_lies(offset_m):
    state = start(MIXED)
    play(state, shifted(TWO_ROOMS_WALK, offset_m, 0), MIXED)
    places = ask(state, MIXED)
    positions = places.positions_m.astype(float) - (offset_m, 0, 0)
    gap_m = np.maximum(np.maximum(TWO_ROOMS[:, 0] - positions[:, None], positions[:, None] - TWO_ROOMS[:, 1]), 0)
    truth_m = np.linalg.norm(gap_m, axis=-1).min(axis=1)
    assert len(truth_m) >= 8 and parts(places) == 1
    assert np.abs(places.radii_m - truth_m).max() < 2 * MIXED.graph_voxel_m
    assert (places.radii_m - truth_m).max() < MIXED.graph_voxel_m


def test_memory_of_a_coarser_field_is_bounded_and_what_the_map_dropped_is_gone_from_it_too():
    small = Config(field_voxels=2, map_window_max_radius_m=6.0, map_mb=2.1, max_speed_m_s=0.0)
    state, sizes = start(small), []
    for lap in range(6):
        play(state, shifted(ROOM_WALK, 12.8 * lap, 100 * lap), small)
        sizes.append(state.map_bytes)
    assert max(sizes) <= 2.1e6 and state.graph.frozen
    assert len(state.field.voxels_with(OCCUPIED)) < 6 * len(voxels_of_one_room(small))
    told = ask(state, small)
    assert parts(told) == 6
    play(state, shifted(ROOM_WALK, 0.0, 1000), small)
    first = {i for i, x in zip(told.place_ids.tolist(), told.positions_m[:, 0].tolist(), strict=True) if x < 6}
    again = ask(state, small)
    now = {i for i, x in zip(again.place_ids.tolist(), again.positions_m[:, 0].tolist(), strict=True) if x < 6}
    assert len(first & now) >= 0.7 * len(now) and not {i for i in now if i in state.graph.frozen}


def voxels_of_one_room(cfg: Config) -> np.ndarray:
    state = start(cfg)
    play(state, ROOM_WALK, cfg)
    return state.field.voxels_with(OCCUPIED)


def test_a_pose_update_moves_a_coarser_field():
    state, true = start(MIXED), start(MIXED)
    play(true, TWO_ROOMS_WALK, MIXED)
    wrong = [*TWO_ROOMS_WALK[:10], *shifted(TWO_ROOMS_WALK[10:], 0.4, 10)]
    play(state, wrong, MIXED)
    ids = np.array([f.frame_id for f in TWO_ROOMS_WALK[10:]])
    poses = np.stack([f.world_from_camera for f in TWO_ROOMS_WALK[10:]])
    update = PoseUpdate(robot="r", epoch=1, revision=0, stamp_ns=10**12, frame_ids=ids, world_from_camera=poses)
    assert canonical(state) != canonical(true)
    play(state, [update], MIXED)
    assert canonical(state) == canonical(true)


def test_places_in_the_middle_are_found_again_on_a_shifted_grid():
    shares = {}
    for policy in ("middle", "basis_points"):
        cfg = Config(field_voxels=2, merge_policy=policy)
        maps = []
        for offset_m in (0.0, 0.06):
            state = start(cfg)
            play(state, shifted(TWO_ROOMS_WALK, offset_m, 0), cfg)
            maps.append(ask(state, cfg).positions_m - np.array((offset_m, 0, 0)))
        apart_m = np.linalg.norm(maps[0][:, None] - maps[1][None], axis=-1).min(axis=1)
        shares[policy] = np.mean(apart_m < 0.15)
    assert shares["middle"] > 0.7 and shares["middle"] > shares["basis_points"] + 0.1


def test_the_mixed_preset_absorbs_small_parts():
    def count(**settings: float) -> int:
        cfg = preset("mixed", **settings)
        state = start(cfg)
        play(state, TWO_ROOMS_WALK, cfg)
        return len(ask(state, cfg).place_ids)

    assert count() <= 0.8 * count(node_merge_distance_m=CFG.node_merge_distance_m)


def middles_of(*sheets: tuple[slice, slice, slice]) -> extraction.Extraction:
    """Places in cells of 5 voxels of a diagram that is made of these boxes, far from any obstacle."""
    grid = VoxelGrid()
    block = grid.blank()
    for sheet in sheets:
        block.basis[sheet] = 2
    block.label[:], block.d2[:] = FREE, 25
    grid.insert((0, 0, 0), block)
    rules = extraction.ExtractionRules(cell=5, min_radius=2.0, merge=4.25, policy="middle")
    return extraction.extract(grid, Box(np.zeros(3, np.int64), np.full(3, 15)), rules)


WHOLE = (slice(0, 5), slice(0, 5), slice(2, 3))  # 25 of a face of 25; a row beside it covers 5


@pytest.mark.parametrize(("rows", "thick", "places"), [(1, 1, 1), (2, 1, 2), (2, 2, 2), (3, 1, 2), (3, 2, 2)])
def test_two_fifths_of_a_face_make_a_part_a_place_however_thick_it_is(rows, thick, places):
    beside = (slice(5, 5 + rows), slice(0, 5), slice(2, 2 + thick))
    found = middles_of(WHOLE, beside)
    assert len(found.voxels) == places
    assert found.voxels[0].tolist() == [2, 2, 2] and not found.shifts[0].any()
    assert set(found.members[beside].ravel().tolist()) == {places - 1}


def test_a_line_through_cells_keeps_its_places_and_a_pocket_is_none():
    line = (slice(0, 15), slice(2, 3), slice(2, 3))
    pocket = (slice(0, 2), slice(8, 10), slice(8, 9))
    assert middles_of(line, pocket).voxels.tolist() == [[2, 2, 2], [7, 2, 2], [12, 2, 2]]


def test_a_pocket_beside_a_place_of_its_own_cell_hands_on_what_it_touches():
    between = (slice(5, 7), slice(2, 3), slice(2, 3))  # two voxels of the next cell, and what goes on behind it
    found = middles_of((slice(0, 5), slice(0, 5), slice(2, 3)), between, (slice(7, 9), slice(3, 8), slice(2, 3)))
    assert found.touching.tolist() == [[0, 1]]


# Bounded memory.


def test_compressed_blocks_change_nothing(two_rooms):
    near = Config(map_window_max_radius_m=1.5)
    state = start(near)
    deltas = play(state, TWO_ROOMS_WALK, near)
    assert [encode(d) for d in deltas] == [encode(d) for d in two_rooms[1]]
    assert state.grid.packed_bytes > 0 and state.grid.size_bytes < 0.7 * two_rooms[0].grid.size_bytes
    assert encode(publishing.voxel_map(state, CFG)) == encode(publishing.voxel_map(two_rooms[0], CFG))


def test_memory_is_bounded_and_places_of_dropped_space_stay_until_seen_again(room):
    small = Config(map_window_max_radius_m=6.0, map_mb=3.0, max_speed_m_s=0.0)
    state, sizes = start(small), []
    for lap in range(6):
        play(state, shifted(ROOM_WALK, 12.8 * lap, 100 * lap), small)
        sizes.append(state.grid.size_bytes)
    assert max(sizes) <= 3.0e6 and state.graph.frozen
    one, _ = room
    told = ask(state)
    assert len(told.place_ids) > 4 * len(one.ledger.places) and parts(told) == 6
    frozen = set(state.graph.frozen)
    assert {p for i, p in state.ledger.places.items() if i in frozen} <= set(state.ledger.places.values())
    first = {i for i, x in zip(told.place_ids.tolist(), told.positions_m[:, 0].tolist(), strict=True) if x < 6}
    assert first & frozen
    play(state, shifted(ROOM_WALK, 0.0, 1000), small)  # back at the first room: the same places under the same ids
    again = ask(state)
    now = {i for i, x in zip(again.place_ids.tolist(), again.positions_m[:, 0].tolist(), strict=True) if x < 6}
    assert len(first & now) >= 0.7 * len(now) and len(now) == len(one.ledger.places)
    assert not {i for i in now if i in state.graph.frozen}


def test_lenses_of_overlapping_spheres_by_hand():
    d2 = np.full((40, 9, 9), 50, np.int16)
    voxels = np.array([(5, 4, 4), (11, 4, 4), (12, 4, 4), (30, 4, 4)])
    lens = np.sqrt(links.lenses(d2, voxels, np.array((5.0, 5.0, 1.0, 4.0)), 0.5, 100.0))
    assert lens[0, 1] == pytest.approx(4.0)  # two spheres of 5 at distance 6 meet in a circle of 4
    assert lens[1, 2] == pytest.approx(1.0)  # one lies in the other
    assert lens[0, 3] == 0.0 == lens[0, 2]
    d2[8] = UNKNOWN_D2
    assert not links.lenses(d2, voxels, np.array((5.0, 5.0, 1.0, 4.0)), 0.5, 100.0)[0].any()


def test_hydras_limits_and_overlap_edges_change_edges_only(two_rooms):
    few = Config(freespace_num_nodes_to_check=10, freespace_num_neighbors_to_find=2, add_overlap_edges=True)
    bare = Config(add_freespace_edges=False)
    counts = {}
    for name, cfg in (("few", few), ("bare", bare)):
        state = start(cfg)
        play(state, TWO_ROOMS_WALK, cfg)
        assert canonical(state)[0] == canonical(two_rooms[0])[0]
        counts[name] = sum(map(len, state.graph.edges.values()))
        batch = start(cfg)
        for frame in TWO_ROOMS_WALK:
            fusing.fuse(batch, frame, images.depth_of(frame, 0.5), cfg)
        renewal.renew(batch, observed(batch.grid), cfg)
        assert canonical(state) == canonical(batch)
    assert counts["bare"] < counts["few"]


# Inputs that must do no harm.


def bad_frames() -> dict[str, tuple[Keyframe, str]]:
    good = ROOM_WALK[0]
    size = (CAMERA.height_px, CAMERA.width_px)
    png = {
        "holds no measurement": np.zeros(size, np.uint16),
        "60 x 50 pixels, the intrinsics are for 120 x 120": np.full((50, 60), 1000, np.uint16),
        "8 bits per pixel instead of 16": np.full(size, 100, np.uint8),
        "3 channels instead of one": np.full((*size, 3), 100, np.uint16),
    }
    images_ = {name: cv2.imencode(".png", image)[1].tobytes() for name, image in png.items()}
    made = {n: (keyframe(1000 + i, good.world_from_camera, d), n) for i, (n, d) in enumerate(images_.items())}
    for name, data in (("not an image", b"hello"), ("empty", b"")):
        made[name] = keyframe(1100, good.world_from_camera, data), "cannot be decoded"
    far, leap, double = np.eye(4), np.array(good.world_from_camera), Intrinsics(120, 120, 120.0, 120.0, 119.5, 119.5)
    far[0, 3] = 1e7
    leap[0, 3] += 10.0
    made["beyond the index range"] = keyframe(2000, far, good.depth), "farther than voxel indices reach"
    made["a jump"] = keyframe(7, leap, good.depth), "pose jumps by 10.00 m"
    made["another camera"] = keyframe(3000, good.world_from_camera, good.depth, double), "belong to another image size"
    return made


@pytest.mark.parametrize("name", list(bad_frames()))
def test_unusable_keyframes_leave_the_map_alone_and_the_delta_says_why(name):
    state = start()
    play(state, ROOM_WALK[:6])
    before = canonical(state), encode(publishing.voxel_map(state, CFG))
    frame, reason = bad_frames()[name]
    (delta,) = play(state, [frame])
    assert (delta.frame_id, delta.revision, delta.camera_m) == (frame.frame_id, 6, None)
    assert delta.event.startswith(f"keyframe {frame.frame_id} refused: ") and reason in delta.event
    assert not any(
        len(a) for a in (delta.place_ids, delta.removed_ids, delta.merged_ids, delta.edges, delta.removed_edges)
    )
    assert len(state.refused) == 1
    (loss,) = state.losses()
    assert (loss.what, loss.count) == ("keyframes not mapped", 1) and reason in loss.example
    assert (canonical(state), encode(publishing.voxel_map(state, CFG))) == before
    assert not any(d.event for d in play(state, ROOM_WALK[6:]))


def shifted(frames: list[Keyframe], by_m: float, first: int, turn: float = 0.0) -> list[Keyframe]:
    motion = pose_from_quaternion(np.array((by_m, 0.0, 0.0)), np.array((0.0, 0.0, turn, 1.0)))
    return [keyframe(first + n, motion @ frame.world_from_camera, frame.depth) for n, frame in enumerate(frames)]


def test_a_pose_that_stays_where_it_jumped_to_is_believed_unless_it_contradicts_the_map():
    state = start()
    play(state, TWO_ROOMS_WALK)
    before = canonical(state)
    wrong = play(state, shifted(TWO_ROOMS_WALK[:12], 1.6, 18, 0.3), CFG_STRICT)
    assert all("its pose jumps" in d.event for d in wrong) and "contradicts the map" in wrong[-1].event
    assert canonical(state) == before
    elsewhere = play(state, shifted(ROOM_WALK, 120.0, 30))
    assert [d.frame_id for d in elsewhere if d.event] == [30, 31, 32, 33, 34]
    assert {d.frame_id for d in elsewhere if not d.event} == set(range(34, 42))  # 34 brings those before it, in slices
    assert "believed again" in elsewhere[4].event
    once = start()
    play(once, [*TWO_ROOMS_WALK, *shifted(ROOM_WALK, 120.0, 30)], FEARLESS)
    assert canonical(state) == canonical(once)


def test_keyframes_out_of_order_are_fused_and_named():
    state, late = start(), start()
    play(state, ROOM_WALK)
    deltas = play(late, [*ROOM_WALK[:4], *ROOM_WALK[5:], ROOM_WALK[4]])
    assert [d.event for d in deltas[:-1]] == [""] * (len(ROOM_WALK) - 1)
    assert deltas[-1].event == "keyframe 4 is out of order by 7.000 s; fused all the same"
    assert canonical(late) == canonical(state)


def test_what_the_mask_covers_stays_out_of_the_map():
    box = np.concatenate((ROOM_SOLIDS, [((2.2, 1.0, 0.0), (2.6, 1.6, 1.5))]))
    pose = views(0.6, 1.4, 1.2)[0]
    bare, seen = (images.depth_of(keyframe(0, pose, render(solids, pose)), 0.5) for solids in (ROOM_SOLIDS, box))
    mask = cv2.imencode(".png", (bare != seen).astype(np.uint8) * 255)[1].tobytes()
    state = start()
    play(state, [msgspec.structs.replace(keyframe(0, pose, render(box, pose)), mask=mask)])
    occupied = (publishing.voxel_map(state, CFG).occupied + 0.5) * CFG.voxel_m
    assert (bare != seen).any() and len(occupied)
    assert not ((occupied > (2.1, 0.9, 0.2)) & (occupied < (2.7, 1.7, 1.6))).all(axis=1).any()
    assert "mask image" in play(state, [msgspec.structs.replace(ROOM_WALK[1], mask=b"no")])[0].event


# Corrected poses.


def disturbed(frames: list[Keyframe], numbers: list[int]) -> list[Keyframe]:
    """The same frames, some of them from elsewhere: a little off, askew, and so far off that they are refused."""
    changed = list(frames)
    offsets = [(0.3, 0.1, 0.0), (0.0, -0.4, 0.1), (9.0, 0.0, 0.0)]
    for n, offset in zip(numbers, itertools.cycle(offsets), strict=False):
        turn = pose_from_quaternion(np.array(offset), np.array((0.0, 0.0, 0.1 * (n % 3), 1.0)))
        changed[n] = msgspec.structs.replace(frames[n], world_from_camera=turn @ frames[n].world_from_camera)
    return changed


def truth(frames: list[Keyframe], numbers: list[int], revision: int = 0) -> PoseUpdate:
    return PoseUpdate(
        robot="r",
        epoch=3,
        revision=revision,
        stamp_ns=99,
        frame_ids=np.array([frames[n].frame_id for n in numbers], np.int64),
        world_from_camera=np.stack([frames[n].world_from_camera for n in numbers]),
    )


WRONG = [1, 4, 6, 9, 13, 16]


def test_after_a_pose_update_the_map_is_what_the_corrected_poses_make(two_rooms):
    clean, _ = two_rooms
    state = start()
    deltas = play(state, disturbed(TWO_ROOMS_WALK, WRONG))
    assert sum("pose jumps" in d.event for d in deltas) == 2
    assert canonical(state) != canonical(clean)
    ids = set(ask(state).place_ids.tolist())
    (update,) = play(state, [truth(TWO_ROOMS_WALK, WRONG)])
    assert canonical(state) == canonical(clean)
    assert encode(publishing.voxel_map(state, CFG)) == encode(publishing.voxel_map(clean, CFG))
    assert (update.revision, update.stamp_ns, update.event) == (len(TWO_ROOMS_WALK), 99, "")
    assert update.past_frame_ids.tolist() == WRONG
    np.testing.assert_allclose(ask(state).past_cameras_m, ask(clean).past_cameras_m)
    told, known = read([*deltas, update]), Reader()
    known.apply(ask(state))
    assert (told.places, told.edges) == (known.places, known.edges)
    assert len(ids & set(told.places)) >= 0.7 * len(told.places)
    assert play(state, [truth(TWO_ROOMS_WALK, WRONG)]) == []  # a repeat


def test_keyframes_refused_beside_a_wrong_pose_are_fused_once_it_is_corrected():
    clean, state = start(), start()
    play(clean, ROOM_WALK[:3])
    away = np.array(ROOM_WALK[0].world_from_camera)
    away[0, 3] += 9.0
    wrong = [msgspec.structs.replace(ROOM_WALK[0], world_from_camera=away), *ROOM_WALK[1:3]]
    assert [bool(d.event) for d in play(state, wrong)] == [False, True, True]
    assert [loss.count for loss in state.losses()] == [2]
    play(state, [truth(ROOM_WALK, [0])])
    assert canonical(state) == canonical(clean)
    assert state.losses() == [], "what is fused later was not lost"


def test_a_correction_may_come_before_its_keyframe(two_rooms):
    state = start()
    frames = disturbed(TWO_ROOMS_WALK, WRONG)
    deltas = play(state, [truth(TWO_ROOMS_WALK, WRONG), *frames])
    assert not any(d.event for d in deltas)
    assert canonical(state) == canonical(two_rooms[0])


def test_the_archive_does_not_hold_the_colour_it_received():
    state, frame = start(), ROOM_WALK[0]
    play(state, [copied(msgspec.structs.replace(frame, color=bytes(10**6)))])
    kept = state.archive.get(frame.frame_id).keyframe
    assert kept.depth == frame.depth and len(kept.color) == 0
    assert len(kept.depth.obj) < len(frame.depth) + 1000


def test_keyframes_that_left_the_archive_keep_their_poses_and_are_counted(two_rooms):
    frames = disturbed(TWO_ROOMS_WALK, WRONG)
    small = Config(archive_mb=sum(len(f.depth) for f in frames[8:]) / 1e6)
    state = start(small)
    play(state, frames, small)
    assert state.archive.size_bytes <= small.archive_mb * 1e6
    (update,) = play(state, [truth(TWO_ROOMS_WALK, WRONG)], small)
    assert update.event == "2 of 6 keyframes are no longer archived and keep their poses"
    assert update.past_frame_ids.tolist() == [9, 13, 16]
    half = start()
    play(half, [*frames[:8], *TWO_ROOMS_WALK[8:]])
    assert canonical(state) == canonical(half)


@pytest.mark.parametrize("seed", range(2))
def test_any_order_of_the_same_keyframes_gives_the_same_graph(two_rooms, seed):
    state = start(FEARLESS)
    play(state, [TWO_ROOMS_WALK[n] for n in np.random.default_rng(seed).permutation(len(TWO_ROOMS_WALK))], FEARLESS)
    assert canonical(state) == canonical(two_rooms[0])


def test_a_repeated_keyframe_is_ignored(room):
    state, _ = room
    before = encode(ask(state))
    assert play(state, [ROOM_WALK[3]]) == []
    assert encode(ask(state)) == before


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_are_defaults_that_other_settings_change(name):
    cfg = resolve(Config, "place_graph", {"place_graph": {"preset": name, "min_node_distance_m": "0.35"}})
    assert cfg == preset(name, min_node_distance_m=0.35)
    assert cfg.max_distance_m == {"outdoor": 6.0, "hydra": 2.0, "habitat": 4.5, "uhumans2": 4.5}.get(name, 3.0)


def test_config_refuses_what_cannot_work():
    bads = ({"voxel_m": 0.0}, {"voxel_m": 0.5}, {"field_voxels": 3}, {"max_distance_m": 13.0}, {"min_range_m": 6.0})
    for bad in bads:
        with pytest.raises(ValueError):
            Config(**bad)


# A home with exact floor polygons.


@pytest.mark.skipif(not (DATA / "infinigen_home_a").is_dir(), reason="shared data is not here")
def test_rooms_of_a_home_are_joined_by_their_doorways_only():
    folder = DATA / "infinigen_home_a"
    lens = json.loads((folder / "camera.json").read_text())
    camera = Intrinsics(lens["width"], lens["height"], lens["fx"], lens["fy"], lens["cx"], lens["cy"])
    state, deltas = start(), []
    with (folder / "trajectory.csv").open() as rows:
        for row in csv.DictReader(rows):
            values = {key: float(value) for key, value in row.items()}
            position = np.array([values[k] for k in ("x_m", "y_m", "z_m")])
            pose = pose_from_quaternion(position, np.array([values[k] for k in ("qx", "qy", "qz", "qw")]))
            depth = (folder / "depth" / f"{int(row['frame']):06d}.png").read_bytes()
            deltas += play(state, [keyframe(int(row["frame"]), pose, depth, camera)])
    places = ask(state)
    rooms = {r["label"]: np.array(r["polygon_m"]) for r in json.loads((folder / "regions.json").read_text())["regions"]}
    positions = places.positions_m.astype(float)
    ends = positions[np.searchsorted(places.place_ids, places.edges)]
    along = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * np.linspace(0, 1, 41)[None, :, None]
    in_room = np.array(
        [inside_polygon(along.reshape(-1, 3)[:, :2], p).reshape(along.shape[:2]) for p in rooms.values()]
    )
    assert in_room.any(axis=0).mean() > 0.999  # polygons reach into the doorways; between them lies a millimetre or so
    names = np.array(list(rooms))
    joined = {
        frozenset((str(names[a]), str(names[b])))
        for a, b in zip(in_room[:, :, 0].argmax(axis=0), in_room[:, :, -1].argmax(axis=0), strict=True)
        if a != b
    }
    assert joined == {
        frozenset(pair)
        for pair in (
            ("bathroom", "living room"),
            ("bedroom", "living room"),
            ("dining room", "kitchen"),
            ("dining room", "living room"),
        )
    }
    assert 100 <= len(places.place_ids) <= 600
    told = read(deltas)
    assert sorted(told.places) == places.place_ids.tolist() and len(told.edges) == len(places.edges)


def test_a_process_that_joins_in_mid_stream_fetches_the_missed_keyframes_page_by_page():
    frames = ROOM_WALK
    archive, asked = {frame.frame_id: frame for frame in frames}, []

    def page_of(request):
        asked.append((request.first_frame_id, request.end_frame_id))
        wanted = range(request.first_frame_id, request.end_frame_id)
        page = [archive[number] for number in sorted(archive) if number in wanted][:2]
        return ArchiveReply(robot="r", oldest_frame_id=0, keyframes=page)

    runner = Runner(service.SERVICE, CFG, Identity("r", "p", 2), {ARCHIVE: page_of})
    runner.feed(*frames[4:])
    last = frames[4].frame_id
    assert asked[0] == (0, last) and [end for _, end in asked] == [last] * len(asked) and len(asked) == 3
    assert sorted(runner.state.seen) == sorted(archive)


def test_a_successor_tells_nothing_until_it_has_caught_up_and_then_everything():
    archive = {frame.frame_id: frame for frame in ROOM_WALK}

    def page_of(request):
        wanted = range(request.first_frame_id, request.end_frame_id)
        page = [archive[number] for number in sorted(archive) if number in wanted][:2]
        return ArchiveReply(robot="r", oldest_frame_id=0, keyframes=page)

    first = Runner(service.SERVICE, CFG, Identity("r", "p", 1))
    told = read([delta for _, delta in first.feed(*ROOM_WALK[:6])])
    runner = Runner(service.SERVICE, CFG, Identity("r", "p", 2))
    assert runner.feed(*ROOM_WALK[4:6]) == [] and runner.asks[0].request.first_frame_id == 0
    with pytest.raises(NotYet):
        runner.answer(PLACE_SNAPSHOT, SnapshotRequest(robot="r"))
    runner.answers[ARCHIVE] = page_of
    [(topic, delta)] = runner.feed(page_of(runner.asks[0].request))
    assert topic is PLACE_DELTA and delta.snapshot and delta.epoch == 2
    assert delta.frame_id == ROOM_WALK[5].frame_id  # the newest, though an older one came last
    assert sorted(delta.past_frame_ids.tolist()) == [frame.frame_id for frame in ROOM_WALK[:6]]
    assert len(delta.place_ids) >= 0.8 * len(told.places)
    assert len(runner.feed(*ROOM_WALK[6:7])) == 1


def test_a_successor_waits_for_a_silent_archive_within_a_bound():
    cfg = msgspec.structs.replace(CFG, archive_patience=3)
    runner = Runner(service.SERVICE, cfg, Identity("r", "p", 2))
    assert runner.feed(*ROOM_WALK[4:6]) == []
    [(_, delta)] = runner.feed(*ROOM_WALK[6:7])
    assert delta.snapshot and len(delta.past_frame_ids) == 3
    assert len(runner.feed(*ROOM_WALK[7:8])) == 1


def archive_of(frames):
    archive = {frame.frame_id: frame for frame in frames}

    def page_of(request):
        wanted = range(request.first_frame_id, request.end_frame_id)
        page = [archive[number] for number in sorted(archive) if number in wanted][:2]
        return ArchiveReply(robot="r", oldest_frame_id=0, keyframes=page)

    return page_of


def test_a_successor_that_stands_by_gives_places_the_ids_they_had():
    first = Runner(service.SERVICE, CFG, Identity("r", "p", 1))
    first.state.graph._next_id = 500  # as after many places that are gone
    deltas = [delta for _, delta in first.feed(*ROOM_WALK[:6])]
    second = Runner(service.SERVICE, CFG, Identity("r", "q", 2), {ARCHIVE: archive_of(ROOM_WALK[:6])})
    second.answers[PLACE_SNAPSHOT] = first
    assert service.lacks(second.state, CFG) == "" and second.feed(Succession(predecessor="p")) == []
    assert second.feed(ROOM_WALK[5], ROOM_WALK[4]) == [] and service.lacks(second.state, CFG) == ""
    assert sorted(second.state.seen) == [frame.frame_id for frame in ROOM_WALK[:6]]
    with pytest.raises(NotYet):
        second.answer(PLACE_SNAPSHOT, SnapshotRequest(robot="r"))
    told = read(deltas + [delta for _, delta in first.feed(ROOM_WALK[6])])
    last_word = service.bequest(first.state, first.identity, CFG)
    assert second.feed(TakesOver(bequest=last_word)) == []  # the newest keyframe has not come yet
    [(_, delta), *_] = second.feed(ROOM_WALK[6])
    assert delta.snapshot and delta.epoch == 2
    there = dict(zip(delta.place_ids.tolist(), delta.positions_m.tolist(), strict=True))
    same = [number for number in there if number in told.places]
    assert len(same) >= 0.9 * len(told.places)
    apart_m = [np.linalg.norm(np.subtract(there[number], told.places[number][:3])) for number in same]
    assert max(apart_m) <= CFG.graph_rules.merge * CFG.voxel_m
    assert second.state.graph.next_id >= first.state.graph.next_id
    assert len(second.feed(ROOM_WALK[7])) == 1


def test_a_successor_says_which_keyframes_it_lacks():
    first = Runner(service.SERVICE, CFG, Identity("r", "p", 1))
    first.feed(*ROOM_WALK[:6])
    second = Runner(service.SERVICE, CFG, Identity("r", "q", 2), {ARCHIVE: archive_of(ROOM_WALK[3:6])})
    second.answers[PLACE_SNAPSHOT] = first
    second.feed(Succession(predecessor="p"), ROOM_WALK[5])
    assert "3 keyframes of its predecessor's map" in service.lacks(second.state, CFG)


def test_a_successor_of_a_dead_one_needs_no_new_keyframe():
    first = Runner(service.SERVICE, CFG, Identity("r", "p", 1))
    store = Runner(BY_NAME["scene_store"], BY_NAME["scene_store"].config(path=":memory:"))
    store.feed(*[delta for _, delta in first.feed(*ROOM_WALK[:6])])
    former = store.answer(SCENE, SceneRequest(robot="r"))
    second = Runner(service.SERVICE, CFG, Identity("r", "q", 2), {ARCHIVE: archive_of(ROOM_WALK[:6]), SCENE: store})
    [(_, delta)] = second.feed(Succession())
    assert delta.snapshot and sorted(delta.past_frame_ids.tolist()) == [frame.frame_id for frame in ROOM_WALK[:6]]
    assert len(former.place_ids) and np.isin(former.place_ids, delta.place_ids).mean() >= 0.9
    assert len(second.feed(ROOM_WALK[6])) == 1


def test_a_pose_update_from_before_the_first_keyframe_empties_no_readers_map():
    runner = Runner(service.SERVICE, CFG, Identity("r", "p", 2))
    poses = ROOM_WALK[0].world_from_camera[None]
    early = PoseUpdate(robot="r", epoch=1, revision=0, stamp_ns=1, frame_ids=np.array([0]), world_from_camera=poses)
    assert runner.feed(early) == []
    [(_, delta)] = runner.feed(ROOM_WALK[0])
    assert (delta.epoch, delta.revision) == (2, 0)


def test_the_offset_of_the_world_travels_with_the_places():
    origin_m = (512_345.0, 5_403_210.0, 312.0)
    state = core.empty("r", 1, CFG)
    deltas = play(state, [msgspec.structs.replace(frame, origin_m=origin_m) for frame in ROOM_WALK[:2]])
    assert {delta.origin_m for delta in deltas} == {publishing.snapshot(state, CFG).origin_m} == {origin_m}
