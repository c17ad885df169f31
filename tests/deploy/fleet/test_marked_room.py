"""From pictures to one map: two robots in a bare room, in frames of their own, find together by a paper on the wall."""

import cv2
import numpy as np
import pytest

from prior_sg.deploy.evaluation.printed import painted
from prior_sg.deploy.fleet.core.finding.frames import apart, level
from prior_sg.deploy.fleet.core.finding.marking import pose_of
from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.queries import MarkersOf, RouteBetween, SceneQuery, Spot
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import KEYFRAME, SCENE_QUERY
from prior_sg.services.feature_pyramid import service as pyramids
from prior_sg.services.feature_pyramid.core.config import Config as PyramidConfig
from prior_sg.services.feature_pyramid.core.markers import MarkersConfig
from prior_sg.services.feature_pyramid.detectors.load import load_detector
from prior_sg.services.geometry import inverse
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core.config import Config as SegmenterConfig
from tests.deploy.fleet.test_bridge import Fleet
from tests.help import room
from tests.help.markers import DICTIONARY, SIZE_M, keyframe, on_wall
from tests.services.feature_pyramid.test_detectors import Colours

CAMERA = Intrinsics(480, 360, 380.0, 380.0, 239.5, 179.5)
PAPER = on_wall((room.ROOM_M[1][0], 1.2, 1.3), np.pi)
MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))
TICK = Tick(stamp_ns=10**18)
MARKERS = MarkersConfig(dictionary=DICTIONARY, size_m=SIZE_M)


class Robot:
    """Map, worker and segmenter of one robot, whose outputs the fleet's bridge and store read."""

    def __init__(self, name, own_from_world, fleet, markers):
        self.name, self.own_from_world = name, own_from_world
        places, segmenter = BY_NAME["place_graph"], BY_NAME["segmenter"]
        cfg = PyramidConfig(detector="none", markers=markers)
        worker = pyramids.Worker("w", Colours(), load_detector(cfg))
        self.places = Runner(places, places.config(), Identity(name, "p", 1), wire=True)
        self.worker = Runner(pyramids.SERVICE, cfg, state=worker, wire=True)
        self.segmenter = Runner(segmenter, SegmenterConfig(space="colours"), Identity(name, "s", 1), wire=True)
        self.pipeline = Pipeline((self.places, self.segmenter, fleet.bridge, fleet.store))

    def walk(self, poses, seed):
        rng = np.random.default_rng(seed)
        for frame_id, pose in enumerate(poses):
            depth_m = room.depth_of(pose, CAMERA)
            gray = cv2.cvtColor(room.color_of(pose, CAMERA), cv2.COLOR_RGB2GRAY)
            gray, _ = painted(gray, depth_m, CAMERA, [(7, inverse(pose) @ PAPER)], SIZE_M)
            depth_m = depth_m + 0.003 * depth_m**2 * rng.normal(size=depth_m.shape)
            color = np.repeat(gray[:, :, None], 3, axis=2)
            frame = keyframe(frame_id, self.own_from_world @ pose, color, depth_m, robot=self.name, camera=CAMERA)
            self.pipeline.publish(KEYFRAME, frame)
            for topic, message in self.worker.feed(frame):
                self.pipeline.publish(topic, message)
        self.worker.state.reader.shutdown()
        self.pipeline.feed(self.segmenter, TICK)


def around(start_deg, stop_deg, at_m):
    """A robot that stands near a spot and turns."""
    turns_deg = np.linspace(start_deg, stop_deg, 16)
    return [room.pose(*(np.array(at_m) + 0.02 * n), 1.2, turn_deg, 10) for n, turn_deg in enumerate(turns_deg)]


def fleet_of(markers):
    fleet = Fleet()
    for name, own_from_world, poses in (
        ("r1", np.eye(4), around(-70, 150, (1.2, -0.4))),
        ("r2", MOVED, around(130, -100, (0.9, 1.4))),
    ):
        Robot(name, own_from_world, fleet, markers).walk(poses, seed=len(name))
        told = fleet.tick()
    return fleet, next((m.event for m in told if isinstance(m, PlaceDelta)), "")


def test_two_robots_in_a_bare_room_find_together_by_a_paper_on_the_wall():
    fleet, event = fleet_of(MARKERS)
    assert "r2 has been found in the map of home by markers" in event
    relation = fleet.bridge.state.followed["r2"].member.relation
    gap_m, gap_rad = apart(relation.fleet_from_own, inverse(MOVED), MOVED[:3, 3])
    assert gap_m < 0.15 and gap_rad < np.radians(4)
    (marker,) = fleet.scene().markers
    assert (marker.id, marker.doubt) == (7, "") and pose_of(marker) == pytest.approx(PAPER, abs=0.08)
    assert marker.frames == sum(fleet.scene(robot).markers[0].frames for robot in ("r1", "r2"))
    assert len(fleet.scene().place_ids) > len(fleet.scene("r1").place_ids)
    questions = [MarkersOf(id=7), RouteBetween(start=Spot(here=True), goal=Spot(what="marker", id=7))]
    where, way = fleet.store.answer(SCENE_QUERY, SceneQuery(robot="home", questions=questions)).answers
    assert [one.marker for one in where.markers] == [marker] and way.found and way.goal_gap_m < 1.5


def test_without_looking_for_markers_they_stay_apart():
    fleet, event = fleet_of(MarkersConfig())
    assert not event.count("found") and fleet.bridge.state.followed["r2"].member.relation is None
    assert fleet.scene().markers == []
