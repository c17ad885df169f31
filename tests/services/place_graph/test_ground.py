"""2D places: ground, pieces and edges on worlds by hand, against the definition, and in any order of keyframes."""

import dataclasses

import numpy as np
import pytest

from prior_sg.services.place_graph import service
from prior_sg.services.place_graph.core import ground, publishing, terrain
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.volume.grid import BLOCK, FREE, OCCUPIED, UNOBSERVED, Block, Box, VoxelGrid
from prior_sg.services.runtime.service import Identity
from tests.services.place_graph.test_place_graph import ROOM_WALK, TWO_ROOMS_WALK, grid_of, play, read

CFG = Config(places="2d", max_speed_m_s=0.0)
RULES = ground.GroundRules(clearance=10, step=2, slope=0.6, piece=10.0, points=10, cluster=20, overlap=0.5, rise=5.0)


def hall(width: int = 48, depth: int = 48, floor: int = 3, height: int = 32) -> np.ndarray:
    label = np.full((width, depth, height), FREE, np.uint8)
    label[:, :, : floor + 1] = OCCUPIED
    label[:, :, :floor] = UNOBSERVED
    return label


def ground_of(label: np.ndarray) -> np.ndarray:
    return terrain.ground_voxels(label, RULES.clearance, RULES.step, RULES.slope)


def test_ground_needs_free_height_and_gentle_slopes():
    label = hall()
    label[10:20, 10:20, 9] = OCCUPIED  # a table: too little height below it, and itself ground of its own
    ramp = np.arange(20)
    for i in ramp:
        label[25 + i, 30:40, 3 : 3 + i // 4 + 1] = OCCUPIED  # one in four
        label[25 + i, 2:12, 3 : min(31, 3 + i) + 1] = OCCUPIED  # one in one
    found = ground_of(label)
    assert found[2:8, 2:8, 3].all() and not found[:, :, :3].any()
    assert not found[10:20, 10:20, 3].any() and found[12:18, 12:18, 9].all()
    assert all(found[25 + i, 34, 3 + i // 4] for i in ramp)
    assert not any(found[25 + i, 6, 3 + i] for i in ramp[3:17])


def test_parts_are_joined_by_small_steps_only():
    label = hall()
    label[24:36, :, 4:6] = OCCUPIED  # a step of 2
    label[36:, :, 4:12] = OCCUPIED  # a step of 6
    found = ground_of(label) | (label == OCCUPIED) & (np.roll(label, -1, axis=2) == FREE)
    parts, count = terrain.connected(found, RULES.step)
    assert count == 2
    assert parts[5, 5, 3] == parts[30, 5, 5] != parts[40, 5, 11]


def test_pieces_cover_the_ground_once_and_are_small():
    label = hall(64, 64)
    label[20:22, :40, 4:20] = OCCUPIED  # a wall with a way round
    grid = grid_of(label)
    corners = [np.array((x, y, 0)) for x in (0, 40) for y in (0, 40)]
    tiles = [Box(corner, corner + np.array((40, 40, 32))) for corner in corners]
    pieces = [piece for tile in tiles for piece in ground.divide(grid, tile, RULES)]
    voxels = np.concatenate([piece.voxels for piece in pieces])
    assert len(np.unique(voxels, axis=0)) == len(voxels)
    expected = np.argwhere(ground_of(label)[:, :, 3])
    assert {tuple(v) for v in voxels[voxels[:, 2] == 3][:, :2].tolist()} == {tuple(v) for v in expected.tolist()}
    assert all(
        len(piece.voxels) <= RULES.points or np.ptp(piece.voxels[:, :2], axis=0).max() <= 10.0 for piece in pieces
    )
    for piece in pieces:  # the ellipse holds the rectangle, hence the voxels
        turn = np.array(
            ((np.cos(piece.angle_rad), np.sin(piece.angle_rad)), (-np.sin(piece.angle_rad), np.cos(piece.angle_rad)))
        )
        local = (piece.voxels[:, :2] - piece.center) @ turn.T / piece.half_axes
        assert (np.linalg.norm(local, axis=1) <= 1.0).all()


def test_outlier_clusters_are_left_out():
    label = hall(48, 48)
    label[:, :, :4] = UNOBSERVED
    label[4:20, 4:20, 3] = OCCUPIED
    label[30:34, 30:34, 3] = OCCUPIED  # 16 voxels
    pieces = ground.divide(grid_of(label), Box(np.zeros(3, np.int64), np.array((40, 40, 32))), RULES)
    assert pieces and max(piece.voxels[:, 0].max() for piece in pieces) < 20


FURNISHED = dataclasses.replace(RULES, furniture=400)


def heights_of_pieces(label, rules=FURNISHED):
    """The heights at which a hall has pieces of ground."""
    whole = Box(np.zeros(3, np.int64), np.array((40, 40, 32)))
    return sorted(
        {int(z) for piece in ground.divide(grid_of(label), whole, rules) for z in np.unique(piece.voxels[:, 2])}
    )


def furnished(*, floor: int = 3, wall: int = 0) -> np.ndarray:
    """A hall with a bed of 12 by 18 voxels, 5 above the floor, `wall` voxels from a wall of the hall."""
    label = hall(floor=floor)
    label[10:12, :, floor + 1 :] = OCCUPIED
    label[12 + wall : 24 + wall, 12:30, floor + 1 : floor + 6] = OCCUPIED
    return label


@pytest.mark.parametrize("wall", [0, 8])
def test_beds_and_table_tops_are_no_ground(wall):
    label = furnished(wall=wall)
    assert heights_of_pieces(label, RULES) == [3, 8] and heights_of_pieces(label) == [3]
    label[12 + wall : 24 + wall, 12:30, 4:8] = FREE  # a table, on nothing
    assert heights_of_pieces(label, RULES) == [3, 8] and heights_of_pieces(label) == [3]


def test_what_one_can_reach_stays_ground_however_high():
    label = furnished(wall=8)
    for step in range(4):
        label[32 + 2 * step : 34 + 2 * step, 14:22, 4 : 8 - step] = OCCUPIED  # a ramp of one in two up to it
    assert 8 in heights_of_pieces(label)
    kerb = hall()
    kerb[20:32, 12:30, 4:6] = OCCUPIED
    assert heights_of_pieces(kerb) == [3, 5]


def test_large_platforms_and_floors_that_end_unseen_stay_ground():
    large = hall()
    large[12:, 12:40, 4:9] = OCCUPIED  # a stage
    assert heights_of_pieces(large) == [3, 8]
    island = hall()
    island[:, :, :4] = UNOBSERVED
    island[12:24, 12:30, 8] = OCCUPIED  # all that was seen of a floor, through a door
    island[:, :, 4:8] = UNOBSERVED
    assert heights_of_pieces(island) == [8]


def test_no_edge_where_the_straight_line_leaves_the_ground():
    label = hall()
    label[12:36, 12:36, 4:20] = OCCUPIED  # ground goes around a block
    pieces = ground.divide(grid_of(label), Box(np.zeros(3, np.int64), np.array((48, 48, 32))), RULES)
    low = [piece for piece in pieces if piece.middle[2] == 3]
    joined = ground.touching_pieces(low, RULES.step)
    assert len(joined) >= len(low) - 1
    for a, b in joined:
        line = np.linspace(low[a].middle, low[b].middle, 60)[:, :2]
        assert not ((line > 13.5) & (line < 33.5)).all(axis=1).any()
    corner = [  # two arms of an L: they touch at the corner, the line between their middles cuts it
        ground._piece(np.argwhere(np.ones((30, 2, 1), bool))),
        ground._piece(np.argwhere(np.ones((2, 30, 1), bool)) + np.array((0, 2, 0))),
    ]
    assert ground.touching_pieces(corner, RULES.step) == []


def test_ellipses_overlap_by_hand():
    def piece(x: float, y: float, long: float, short: float, angle: float) -> ground.Piece:
        return ground.Piece(
            np.zeros((1, 3)), (0, 0, 0), np.array((x, y)), np.array((long, short)), angle, np.zeros((1, 2))
        )

    one = piece(0, 0, 5, 2, 0.0)
    assert ground.overlap_of(one, piece(6, 0, 3, 1, 0.0)) == pytest.approx(2.0)
    assert ground.overlap_of(one, piece(0, 6, 3, 1, 0.0)) == pytest.approx(-3.0)
    assert ground.overlap_of(one, piece(0, 6, 5, 1, np.pi / 2)) == pytest.approx(1.0)


def run(frames):
    state = service.init(CFG, Identity("r", "test", 7))
    return state, play(state, frames, CFG)


def canonical(state):
    graph = state.graph
    places = {graph.places[i].voxel: tuple(piece.half_axes) for i, piece in graph.pieces.items()}
    edges = {(graph.places[a].voxel, graph.places[b].voxel): w for a, n in graph.edges.items() for b, w in n.items()}
    return places, edges


@pytest.fixture(scope="module")
def two_rooms():
    return run(TWO_ROOMS_WALK)


def test_a_doorway_joins_the_ground_of_two_rooms_and_the_wall_does_not(two_rooms):
    state, deltas = two_rooms
    told = publishing.snapshot(state, CFG)
    assert len(told.place_ids) >= 12 and (np.abs(told.positions_m[:, 2] + 0.05) < 0.11).all()
    assert told.surface_ids.tolist() == told.place_ids.tolist()
    index = np.searchsorted(told.place_ids, told.edges)
    ends = told.positions_m[index].astype(float)
    crossing = ends[(ends[:, 0, 0] - 3.1) * (ends[:, 1, 0] - 3.1) < 0]
    share = (3.1 - crossing[:, 0, 0]) / (crossing[:, 1, 0] - crossing[:, 0, 0])
    y = crossing[:, 0, 1] + share * (crossing[:, 1, 1] - crossing[:, 0, 1])
    assert len(y) and ((y > 1.0) & (y < 2.0)).all()
    known = {}
    for delta in deltas:
        for n, place in enumerate(delta.surface_ids.tolist()):
            known[place] = (delta.ellipses[n].tolist(), int(delta.hull_counts[n]))
    expected = {
        i: (told.ellipses[n].tolist(), int(told.hull_counts[n])) for n, i in enumerate(told.surface_ids.tolist())
    }
    assert {i: known[i] for i in expected} == expected


@pytest.mark.parametrize("seed", range(2))
def test_any_order_of_the_same_keyframes_gives_the_same_pieces(two_rooms, seed):
    order = np.random.default_rng(seed).permutation(len(TWO_ROOMS_WALK))
    assert canonical(run([TWO_ROOMS_WALK[n] for n in order])[0]) == canonical(two_rooms[0])


def test_pieces_keep_their_ids_when_the_map_grows():
    state, deltas = run(ROOM_WALK[:6])
    before = publishing.snapshot(state, CFG)
    deltas += play(state, ROOM_WALK[6:], CFG)
    after = publishing.snapshot(state, CFG)
    kept = set(before.place_ids.tolist()) & set(after.place_ids.tolist())
    assert len(before.place_ids) >= 4 and len(kept) >= 0.7 * len(before.place_ids)
    told = read(deltas)
    assert sorted(told.places) == after.place_ids.tolist()
    assert sorted(told.edges) == sorted(map(tuple, after.edges.tolist()))


def test_an_empty_map_has_no_ground():
    assert ground.divide(VoxelGrid(), Box(np.zeros(3, np.int64), np.full(3, 40)), RULES) == []
    grid = VoxelGrid()
    grid.insert((0, 0, 0), Block())
    assert ground.divide(grid, Box(np.zeros(3, np.int64), np.full(3, BLOCK)), RULES) == []
