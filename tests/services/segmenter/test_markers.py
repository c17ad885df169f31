"""Printed markers over time: one spot from many sightings, doubt where there are two, corrections, deltas."""

import numpy as np
import pytest

from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.markers import MarkerKey
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.status import Tick
from prior_sg.schemas.succession import EvidenceRequest
from prior_sg.schemas.topics import EVIDENCE, OBJECT_SNAPSHOT
from prior_sg.services.geometry import inverse, pose_from_quaternion
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.scene_store.core import graph as scenes
from prior_sg.services.scene_store.core import telling
from prior_sg.services.scene_store.core.image import graph_of, image_of
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.objects.markers import MarkerConfig, MarkerMap, located
from prior_sg.services.segmenter.service import SERVICE
from tests.help.markers import DICTIONARY, SIZE_M, facing, on_wall
from tests.help.world import ROBOT
from tests.services.segmenter.test_objects import sight

CFG = MarkerConfig()
HUNG, ELSEWHERE = on_wall((4.0, 2.0, 1.5), 0.7), on_wall((1.0, -3.0, 1.2), -2.0)
KEY = MarkerKey(DICTIONARY, 7)
TICK = Tick(stamp_ns=10**18)


def sighting(frame_id, *markers, number=7, shift_m=(0.0, 0.0, 0.0), said_shift_m=(0.0, 0.0, 0.0), **changes):
    """A keyframe that shows `markers` (world_from_marker), each moved by `shift_m`, from a pose told astray."""
    world_from_camera = facing(HUNG, 1.5 + 0.1 * frame_id, (0.2 * frame_id - 0.5, 0.1, 0))
    seen = [inverse(world_from_camera) @ marker for marker in markers]
    for pose in seen:
        pose[:3, 3] += world_from_camera[:3, :3].T @ np.array(shift_m)
    told = world_from_camera.copy()
    told[:3, 3] += said_shift_m
    fields = {
        "marker_dictionary": DICTIONARY if seen else "",
        "marker_size_m": SIZE_M,
        "marker_ids": np.full(len(seen), number, np.int32),
        "marker_sides_px": np.full(len(seen), 70.0 - frame_id, np.float32),
        "camera_from_marker": np.array(seen).reshape(-1, 4, 4),
    }
    return sight(frame_id, world_from_camera, [], said=told, **(fields | changes))


def held(*frames, cfg=CFG):
    markers = MarkerMap()
    for frame in frames:
        markers.observe(frame, frame.world_from_camera, cfg)
    return markers


def pose_of(marker):
    return pose_from_quaternion(np.array(marker.position_m), np.array(marker.quaternion_xyzw))


def test_several_keyframes_give_one_spot_and_a_stray_one_is_left_out():
    shifts = [(0.02, 0, 0), (-0.02, 0, 0), (0, 0.02, 0), (0, -0.02, 0), (0.3, 0, 0)]
    (found,) = held(*(sighting(n, HUNG, shift_m=s) for n, s in enumerate(shifts))).news({}, CFG)
    assert (found.key, found.size_m, found.frames, found.doubt) == (KEY, SIZE_M, 5, "")
    assert pose_of(found) == pytest.approx(HUNG, abs=0.01)


def test_two_keyframes_are_not_enough():
    assert held(sighting(0, HUNG), sighting(1, HUNG)).news({}, CFG) == []


def test_one_number_at_two_spots_is_doubted_and_not_averaged():
    frames = [sighting(n, HUNG if n < 4 else ELSEWHERE) for n in range(7)]
    (found,) = held(*frames).news({}, CFG)
    assert found.doubt == "it has been seen at 2 spots, up to 5.8 m from each other"
    assert pose_of(found) == pytest.approx(HUNG, abs=1e-6) and found.frames == 4


def test_a_marker_seen_elsewhere_once_is_no_second():
    (found,) = held(*(sighting(n, HUNG if n < 4 else ELSEWHERE) for n in range(5))).news({}, CFG)
    assert not found.doubt


def test_two_close_by_in_one_keyframe_are_doubted():
    beside = HUNG.copy()
    beside[:3, 3] += 0.3 * HUNG[:3, 0]
    (found,) = held(*(sighting(n, HUNG, beside) for n in range(3))).news({}, CFG)
    assert found.doubt == "it has been seen twice in one keyframe"


@pytest.mark.parametrize("changes", [{"marker_sides_px": np.zeros(1, np.float32)}, {"shift_m": (1e308, 0.0, 0.0)}])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_sightings_beyond_all_numbers_put_a_marker_nowhere(changes):
    assert held(*(sighting(n, HUNG, **changes) for n in range(3))).news({}, CFG) == []


def test_only_so_many_are_kept_of_each_spot():
    cfg = MarkerConfig(sightings=3)
    markers = held(*(sighting(n, HUNG if n % 2 else ELSEWHERE) for n in range(12)), cfg=cfg)
    assert sorted(frame for frame, _ in markers.seen[KEY]) == [0, 1, 2, 3, 4, 5]  # those that show it largest
    assert "2 spots" in located(KEY, markers.seen[KEY], cfg).doubt


def test_another_space_tells_nothing_new():
    markers = held(*(sighting(n, HUNG, space="a") for n in range(3)))
    assert markers.news({}, CFG)
    markers.observe(sighting(2, ELSEWHERE, space="b"), sighting(2).world_from_camera, CFG)
    assert len(markers.seen[KEY]) == 3 and not markers.changed


class Run:
    """One segmenter, and a graph that follows what it tells of objects."""

    def __init__(self):
        answers = {query: lambda request: None for query in SERVICE.asks}
        self.runner = Runner(SERVICE, Config(), Identity(ROBOT, "i", 1), answers, wire=True)
        self.graph = scenes.Graph(ROBOT)

    def feed(self, *messages):
        told = [m for _, m in self.runner.feed(*messages) if isinstance(m, ObjectDelta)]
        for delta in told:
            scenes.apply_objects(self.graph, delta)
        return told


def test_markers_are_told_without_any_prior_and_again_only_when_they_move():
    run = Run()
    assert run.feed(*(sighting(n, HUNG) for n in range(3)), sighting(3)) == []
    (delta,) = run.feed(TICK)
    assert [marker.key for marker in delta.markers] == [KEY] and delta.revision == 0 and not delta.objects
    assert run.feed(sighting(4, HUNG, shift_m=(0.005, 0, 0)), TICK) == []
    told = telling.scene(run.graph).markers
    assert told == delta.markers == telling.scene(graph_of(image_of(run.graph))).markers
    snapshot = run.runner.answer(OBJECT_SNAPSHOT, SnapshotRequest(robot=ROBOT))
    late = scenes.Graph(ROBOT)
    scenes.apply_objects(late, snapshot)
    assert telling.scene(late).markers == told


def test_a_corrected_pose_moves_the_marker_and_ends_the_doubt():
    """Half of the keyframes are told two metres astray, until a loop closure; one of them comes only after it."""
    astray = (2.0, 0.0, 0.0)
    frames = [sighting(n, HUNG, said_shift_m=astray if n > 3 else (0, 0, 0)) for n in range(8)]
    run = Run()
    run.feed(*frames[:7], TICK)
    assert run.graph.markers[KEY].doubt
    right = np.array([facing(HUNG, 1.5 + 0.1 * n, (0.2 * n - 0.5, 0.1, 0)) for n in range(4, 8)])
    update = PoseUpdate(
        robot=ROBOT, epoch=1, revision=0, stamp_ns=9, frame_ids=np.arange(4, 8), world_from_camera=right
    )
    run.feed(update, TICK, frames[7], TICK)
    marker = run.graph.markers[KEY]
    assert not marker.doubt and pose_of(marker) == pytest.approx(HUNG, abs=1e-6)
    assert located(KEY, run.runner.state.markers.seen[KEY], CFG).frames == 8


def test_a_successor_hears_of_them():
    first, second = Run(), MarkerMap()
    first.feed(*(sighting(n, HUNG) for n in range(3)))
    page = first.runner.answer(EVIDENCE, EvidenceRequest(robot=ROBOT))
    for frame in page.detections:
        second.observe(frame, frame.world_from_camera, CFG)
    assert [one.key for one in second.news({}, CFG)] == [KEY]


@pytest.mark.parametrize("changes", [{"marker_dictionary": ""}, {"marker_size_m": 0.0}])
def test_markers_without_dictionary_or_size_are_refused(changes):
    with pytest.raises(ValueError, match="marker_ids"):
        sighting(0, HUNG, **changes)
