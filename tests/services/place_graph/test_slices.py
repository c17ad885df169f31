"""Large keyframes in slices: what is done, in which parts, and that the map, the graph and its readers end the same."""

import dataclasses

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.deploy.evaluation.worlds import views_of, world_of
from prior_sg.schemas.codec import encode
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.succession import Succession, TakesOver
from prior_sg.schemas.topics import ARCHIVE, PLACE_DELTA, PLACE_SNAPSHOT, SCENE
from prior_sg.services.geometry import inverse
from prior_sg.services.place_graph.core import renewal
from prior_sg.services.place_graph.core.config import AT_ONCE, Config, preset
from prior_sg.services.place_graph.core.fusing import expected_voxels
from prior_sg.services.place_graph.core.ground import GroundGraph
from prior_sg.services.place_graph.core.volume import tsdf
from prior_sg.services.place_graph.core.volume.grid import FAR_D2, FREE, OCCUPIED, UNKNOWN_D2, VoxelGrid
from prior_sg.services.place_graph.core.volume.slicing import slices
from prior_sg.services.place_graph.service import SERVICE
from prior_sg.services.refusals import NotYet
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity, Pause
from tests.services.place_graph.test_place_graph import CAMERA, ROOM_WALK, Reader, archive_of, keyframe

SCALE_M = 0.001


def state_of(cfg: Config):
    return SERVICE.init(cfg, Identity("r", "test", 7))


def walk(kind: str, seed: int, views: int, range_m: float = 0.0) -> list[Keyframe]:
    world = world_of(kind, seed)
    if range_m:
        world = dataclasses.replace(world, range_m=range_m)
    found = []
    for number, view in enumerate(views_of(world)):
        if len(found) == views:
            break
        if number % 5 == 0:
            depth = np.clip(view.depth_m / SCALE_M, 0, 65535).astype(np.uint16)
            png = cv2.imencode(".png", depth)[1].tobytes()
            found.append(keyframe(number, view.world_from_camera, png, world.intrinsics))
    return found


def graph_of(state) -> tuple[dict, dict]:
    """Places and edges by position instead of id."""
    places = state.graph.places
    edges = {(places[a].voxel, places[b].voxel): c for a, near in state.graph.edges.items() for b, c in near.items()}
    return {place.voxel: place[1:] for place in places.values()}, edges


def ground_of(state) -> list:
    return sorted((piece.middle, piece.hull.tolist()) for piece in state.graph.pieces.values())


CASES = {
    "indoor": (preset("indoor"), ("home", 3), 6),
    "mixed": (preset("mixed"), ("office", 1), 2),
    "outdoor": (preset("outdoor", max_range_m=40.0), ("campus", 2), 12),
    "ground": (preset("outdoor", max_range_m=40.0, places="2d"), ("campus", 2), 12),
}


@pytest.mark.parametrize("case", CASES)
def test_after_its_last_slice_a_keyframe_has_made_the_same_map_and_graph_as_at_once(case):
    cfg, (kind, seed), most = CASES[case]
    whole, sliced = (msgspec.structs.replace(cfg, slice_blocks=number) for number in (AT_ONCE, most))
    one, other = state_of(whole), state_of(sliced)
    reader, pauses = Reader(), 0
    for frame in walk(kind, seed, 6, range_m=40.0 if kind == "campus" else 0.0):
        list(SERVICE.step(one, frame, whole))
        told = []
        for output in SERVICE.step(other, frame, sliced):
            if isinstance(output, Pause):
                pauses += 1
                # Readers know the graph as it is between slices; the keyframe is not among those worked off.
                snapshot = SERVICE.answers[PLACE_SNAPSHOT](other, SnapshotRequest(robot="r"), sliced)
                known = Reader()
                known.apply(snapshot)
                assert (reader.places, reader.edges) == (known.places, known.edges)
                assert snapshot.revision == other.revision and snapshot.frame_id < frame.frame_id
                assert frame.frame_id not in other.seen
            else:
                topic, delta = output
                assert topic is PLACE_DELTA and delta.frame_id == frame.frame_id
                reader.apply(delta)
                told.append(delta)
        assert [delta.revision for delta in told] == list(range(told[0].revision, other.revision + 1))
        assert [delta.camera_m is None for delta in told] == [False] + [True] * (len(told) - 1)
        assert frame.frame_id in other.seen
        for label in (FREE, OCCUPIED):
            np.testing.assert_array_equal(one.grid.voxels_with(label), other.grid.voxels_with(label))
        assert graph_of(one) == graph_of(other)
        if isinstance(one.graph, GroundGraph):
            assert ground_of(one) == ground_of(other)
    assert pauses > 6


def test_the_graph_between_slices_is_that_of_the_map_between_them():
    cfg = preset("indoor", slice_blocks=6)
    state, compared = state_of(cfg), 0
    for frame in walk("home", 5, 3):
        for output in SERVICE.step(state, frame, cfg):
            if isinstance(output, Pause):
                anew = state_of(cfg)
                for key, block in state.grid.blocks.items():
                    kept = anew.grid.blank()
                    kept.label = block.label.copy()
                    anew.grid.insert(key, kept)
                voxels = [state.grid.voxels_with(label) for label in (FREE, OCCUPIED)]
                renewal.renew(anew, np.concatenate(voxels), cfg)
                assert graph_of(anew) == graph_of(state)
                compared += 1
    assert compared >= 6


def test_places_that_stand_keep_their_ids_through_slices():
    cfg = Config(slice_blocks=4)
    state = state_of(cfg)
    runner = Runner(SERVICE, cfg, state=state)
    runner.feed(*ROOM_WALK)
    before = {i: place.voxel for i, place in state.graph.places.items()}
    again = [keyframe(100 + n, f.world_from_camera, f.depth) for n, f in enumerate(ROOM_WALK)]
    runner.feed(*again)
    assert before and set(before) <= set(state.graph.places)


def test_a_small_keyframe_is_one_delta_without_a_pause_and_slices_give_the_same_bytes_each_time():
    small = [list(SERVICE.step(state_of(Config()), frame, Config())) for frame in ROOM_WALK[:2]]
    assert [len(outputs) for outputs in small] == [1, 1]
    cfg = Config(slice_blocks=5)
    one, other = (
        [encode(delta) for _, delta in Runner(SERVICE, cfg, state=state_of(cfg)).feed(*ROOM_WALK)] for _ in range(2)
    )
    assert one == other and len(one) > 2 * len(ROOM_WALK)


def test_a_slice_ends_early_where_much_follows_from_it_but_not_in_what_is_known():
    cfg = Config(slice_blocks=8)
    state = state_of(cfg)
    twice = [keyframe(n, ROOM_WALK[0].world_from_camera, ROOM_WALK[0].depth) for n in (0, 1)]
    first, again = ([isinstance(output, Pause) for output in SERVICE.step(state, frame, cfg)] for frame in twice)
    assert sum(first) > sum(again) >= 1


def test_more_is_expected_to_follow_from_obstacles_that_come_and_go_than_from_a_first_look():
    grid = VoxelGrid()
    block = grid.blank()
    block.d2[0, 0, :4] = (0, 9, FAR_D2, UNKNOWN_D2)
    grid.insert((0, 0, 0), block)
    changed = np.array([(0, 0, k) for k in range(4)])
    expected = [expected_voxels(grid, changed[[k]], Config()) for k in range(4)]
    assert expected == [75.0, 1.0 + 2 * 9.0, 1.0 + 2 * 30.0**2, 1.0]
    assert expected_voxels(grid, changed, Config()) == sum(expected)
    assert expected_voxels(grid, changed[:0], Config()) == 0.0
    assert expected_voxels(grid, 2 * changed[[1]], preset("mixed")) == (1.0 + 2 * 9.0) / 8


def test_keyframes_of_a_jump_that_is_believed_again_are_worked_off_in_slices_too():
    cfg = Config(jump_slack_m=0.1, max_speed_m_s=0.01, relocalised_after=3, slice_blocks=5)
    state = state_of(cfg)
    pose = ROOM_WALK[0].world_from_camera
    away = np.array(pose)
    away[:3, 3] += (30.0, 0.0, 0.0)
    frames = [keyframe(0, pose, ROOM_WALK[0].depth)]
    frames += [keyframe(n, away, ROOM_WALK[0].depth) for n in (1, 2, 3)]
    outputs = [list(SERVICE.step(state, frame, cfg)) for frame in frames]
    deltas = [[one[1] for one in some if not isinstance(one, Pause)] for some in outputs]
    assert [bool(some[0].event) for some in deltas] == [False, True, True, True]
    assert "believed again" in deltas[3][0].event and not any(delta.event for delta in deltas[3][1:])
    assert sorted(state.cameras_m) == [0, 1, 2, 3]
    at_once = state_of(Config())
    runner = Runner(SERVICE, Config(max_speed_m_s=0.0), state=at_once)
    runner.feed(*frames)
    assert graph_of(at_once) == graph_of(state)


def test_who_follows_one_that_died_amid_a_keyframe_ends_with_its_whole_map_under_the_ids_told():
    cfg = Config(slice_blocks=5)
    first, store = state_of(cfg), Runner(BY_NAME["scene_store"], BY_NAME["scene_store"].config(path=":memory:"))
    told = Runner(SERVICE, cfg, state=first).feed(*ROOM_WALK[:5])
    for output in SERVICE.step(first, ROOM_WALK[5], cfg):
        if isinstance(output, Pause):
            break  # killed
        told.append(output)
    store.feed(*[delta for _, delta in told])
    assert told[-1][1].frame_id == ROOM_WALK[5].frame_id and ROOM_WALK[5].frame_id not in first.seen
    former = store.answer(SCENE, SceneRequest(robot="r"))
    answers = {ARCHIVE: archive_of(ROOM_WALK[:6]), SCENE: store}
    second = Runner(SERVICE, cfg, Identity("r", "q", 8), answers)
    [(_, delta)] = second.feed(Succession())
    assert delta.snapshot and sorted(delta.past_frame_ids.tolist()) == [frame.frame_id for frame in ROOM_WALK[:6]]
    at_once = Runner(SERVICE, Config())
    at_once.feed(*ROOM_WALK[:6])
    assert graph_of(second.state) == graph_of(at_once.state)
    assert np.isin(former.place_ids, delta.place_ids).mean() >= 0.85  # some stand between two slices only
    store.feed(delta)
    assert sorted(store.answer(SCENE, SceneRequest(robot="r")).place_ids.tolist()) == sorted(delta.place_ids.tolist())


def test_a_successor_that_lacks_a_keyframe_tells_nothing_between_its_slices():
    cfg = Config(slice_blocks=5)
    first = Runner(SERVICE, cfg, Identity("r", "p", 1))
    first.feed(*ROOM_WALK[:6])
    second = Runner(SERVICE, cfg, Identity("r", "q", 2), {ARCHIVE: archive_of(ROOM_WALK[:5])})
    second.answers[PLACE_SNAPSHOT] = first
    second.feed(Succession(predecessor="p"), TakesOver())
    assert second.state.lacking == {ROOM_WALK[5].frame_id}
    pauses, outputs = 0, []
    for output in SERVICE.step(second.state, ROOM_WALK[5], cfg):
        if isinstance(output, Pause):
            pauses += 1
            with pytest.raises(NotYet):
                second.answer(PLACE_SNAPSHOT, SnapshotRequest(robot="r"))
        else:
            outputs.append(output)
    [(_, delta)] = outputs
    assert pauses > 1 and delta.snapshot
    assert np.isin(ask_ids(first), delta.place_ids).all()


def ask_ids(runner: Runner) -> np.ndarray:
    return runner.answer(PLACE_SNAPSHOT, SnapshotRequest(robot="r")).place_ids


@given(
    cells=st.lists(st.tuples(*[st.integers(-9, 9)] * 3), min_size=1, max_size=300, unique=True),
    most=st.integers(1, 60),
)
@settings(max_examples=60)
def test_slices_part_cells_into_small_groups_of_whole_columns(cells, most):
    groups = slices(np.array(cells), most, np.zeros(2))
    assert sorted(map(tuple, np.concatenate(groups).tolist())) == sorted(cells)
    columns = [set(map(tuple, group[:, :2].tolist())) for group in groups]
    assert sum(map(len, columns)) == len(set().union(*columns))
    assert all(len(group) <= most or len(own) == 1 for group, own in zip(groups, columns, strict=True))
    apart = [np.linalg.norm(group[:, :2].mean(axis=0) + 0.5) for group in groups]
    assert apart == sorted(apart)


@pytest.mark.parametrize("seed", range(4))
def test_the_voxels_of_a_view_are_those_that_fall_into_its_image_and_range(seed):
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * np.sign(np.linalg.det(turn)), rng.uniform(-2, 2, 3)
    fusion = Config().fusion
    view = tsdf.View(np.full((CAMERA.height_px, CAMERA.width_px), 3.0, np.float32), CAMERA, pose)
    grid = VoxelGrid()
    tsdf.integrate(grid, view, fusion, tsdf.blocks_of(view, fusion))
    low, high = grid.bounds
    voxels = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)
    x, y, z = inverse(pose)[:3] @ np.concatenate(((voxels + 0.5) * fusion.voxel_m, np.ones((len(voxels), 1))), axis=1).T
    apart = np.sqrt(x * x + y * y + z * z)
    clear = np.where(z > 0, z, 1.0)
    u = np.floor(CAMERA.fx_px * x / clear + CAMERA.cx_px + 0.5)
    v = np.floor(CAMERA.fy_px * y / clear + CAMERA.cy_px + 0.5)
    inside = (z >= fusion.min_range_m) & (z <= fusion.max_range_m) & (apart <= fusion.max_range_m)
    inside &= (u >= 0) & (u < CAMERA.width_px) & (v >= 0) & (v < CAMERA.height_px)
    inside &= (3.0 / clear - 1.0) * apart >= 0  # before the surface, where no weight is rounded to nothing
    weight = grid.gather("weight", grid.bounds).reshape(-1)
    assert inside.sum() > 1000
    assert (weight[inside] > 0).all()
    assert not weight[~inside & ((3.0 / clear - 1.0) * apart >= 0)].any()


@pytest.mark.parametrize("lean", [6e-17, 1e-18, 4e-33])
def test_a_row_of_voxels_that_hardly_leans_and_is_behind_the_camera_has_no_part_in_the_image(lean):
    """Such leanings are what rounding leaves of level cameras; the row would reach the image beyond all whole numbers,
    and a loop from there on would never end."""
    camera_from_world = np.array(((0, 1, 0, 0), (0, 0, -1, 0), (1, 0, lean, 0), (0, 0, 0, 1)))
    lens = np.array((CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px))
    size = (CAMERA.width_px, CAMERA.height_px)
    part = tsdf._seen_part(0.0, 0.0, -5.0, 0, camera_from_world, 0.1, lens, size, (0.1, 5.0))
    assert part == (0, 0)
