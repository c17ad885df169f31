"""An inspection names what is wrong with a recording, and finds nothing wrong with a good one."""

import itertools
from collections import Counter
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import pose_from_quaternion, quaternion_of
from prior_sg.services.ingest.core.inspection import Picker, Reading, Recording, Shot, conventions, gravity, inspect
from prior_sg.services.ingest.core.inspection.conventions import rotations
from prior_sg.services.ingest.core.inspection.sample import pairs_of
from tests.help import room

POSES = room.walk(16)
DEPTHS = [np.rint(room.depth_of(pose) * 1000).astype(np.uint16) for pose in POSES]
GREYS = [room.color_of(pose).mean(axis=-1).astype(np.uint8) for pose in POSES]
SPACING_NS = 300_000_000


def recording(
    poses=POSES, depths=DEPTHS, *, scale_m=0.001, camera=room.CAMERA, greys=None, stamps_ns=None
) -> Recording:
    greys = greys or [None] * len(poses)
    shots = [
        Shot(index, camera, pose, depth, scale_m, grey)
        for index, (pose, depth, grey) in enumerate(zip(poses, depths, greys, strict=True))
    ]
    return Recording(
        total=len(poses),
        read=len(poses),
        frame_ids=list(range(len(poses))),
        cameras=[""] * len(poses),
        stamps_ns=stamps_ns or [index * SPACING_NS for index in range(len(poses))],
        world_from_camera=list(poses),
        keyframes=len(poses),
        shots=shots,
    )


def verdicts(found) -> dict[str, str]:
    return {finding.topic: finding.verdict for finding in found}


def mends(found) -> list[str]:
    return [finding.mend for finding in found if finding.verdict == "problem"]


def lifted(rotation) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose


def turned(axis: int, degrees: float) -> np.ndarray:
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    one, two = [i for i in range(3) if i != axis]
    rotation = np.eye(3)
    rotation[[one, one, two, two], [one, two, one, two]] = cosine, -sine, sine, cosine
    return lifted(rotation)


def swapped(pose: np.ndarray) -> np.ndarray:
    """The pose whose numbers x y z w are the right one's w x y z."""
    return pose_from_quaternion(pose[:3, 3], np.roll(quaternion_of(pose), 1))


GOOD = inspect(recording(greys=GREYS), Reading())


def test_a_good_recording_has_no_problem():
    assert set(verdicts(GOOD).values()) == {"ok"}, GOOD


@pytest.mark.parametrize("yaw", [17, 90, 135, 180, -60, 271])
def test_the_heading_of_the_world_changes_no_verdict(yaw):
    found = inspect(recording([turned(2, yaw) @ pose for pose in POSES], greys=GREYS), Reading())
    assert verdicts(found) == verdicts(GOOD)


@pytest.mark.parametrize("roll", [7, 50, 90, 130, 180, 200, 270, 310])
def test_a_sensor_mounted_at_any_roll_is_noted_but_no_problem(roll):
    poses = [pose @ turned(2, roll) for pose in POSES]
    depths = [np.rint(room.depth_of(pose) * 1000).astype(np.uint16) for pose in poses]
    found = inspect(recording(poses, depths), Reading())
    others = {topic: verdict for topic, verdict in verdicts(found).items() if topic not in {"mounting", "registration"}}
    assert others == {topic: verdict for topic, verdict in verdicts(GOOD).items() if topic != "registration"}
    rolled = next((finding.text for finding in found if finding.topic == "mounting"), "")
    assert bool(rolled) == (min(roll, 360 - roll) >= 44)


@pytest.mark.parametrize("index", range(24))
def test_every_convention_of_camera_axes_is_seen_through(index):
    axes = list(rotations())[index]
    written = recording([pose @ lifted(axes).T for pose in POSES])
    judged = conventions.judge(written.shots, Reading())
    assert all(np.allclose(one, other) for one, other in zip(judged.poses, POSES, strict=True))
    if np.allclose(axes, np.eye(3)):
        assert judged.findings[0].verdict == "ok"
        return
    named = next((name for name, known in conventions.FROM_CAMERA.items() if np.allclose(known, axes)), "")
    assert judged.findings[0].verdict == "problem"
    assert judged.findings[0].mend == (f"--axes {named}" if named else conventions.CONVERT)


@pytest.mark.parametrize(
    ("spoil", "options"),
    [
        (np.linalg.inv, "--poses camera_from_world"),
        (swapped, "--quaternion wxyz"),
        (lambda pose: np.linalg.inv(pose @ lifted(np.diag((1.0, -1, -1)))), "--poses camera_from_world --axes opengl"),
        (lambda pose: swapped(np.linalg.inv(pose)), "--poses camera_from_world --quaternion wxyz"),
    ],
)
def test_a_wrong_convention_is_named_with_its_options(spoil, options):
    found = inspect(recording([spoil(pose) for pose in POSES]), Reading())
    assert mends(found) == [options]
    assert "instead of" in next(finding.text for finding in found if finding.topic == "poses")


def test_the_options_in_force_are_named_when_they_are_what_is_wrong():
    """Poses that are world_from_camera, opencv, read as camera_from_world in another world."""
    told = Reading(poses="camera_from_world", world_from_source=turned(0, 90))
    found = inspect(recording([told.read(pose) for pose in POSES]), told)
    assert "--poses world_from_camera" in mends(found)


def test_poses_that_no_option_reads_otherwise_get_no_option():
    found = inspect(recording([np.linalg.inv(pose) for pose in POSES]), Reading(fixed=True))
    assert verdicts(found)["poses"] == "problem"
    assert "--" not in "".join(mends(found)[:1])


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, -1)])
def test_another_axis_that_points_up_is_named(up):
    side = np.array((1.0, 0, 0)) if abs(up[0]) < 0.5 else np.array((0, 1.0, 0))
    rows = np.stack((side, np.cross(up, side), up))
    found = inspect(recording([lifted(rows.T) @ pose for pose in POSES]), Reading())
    assert mends(found) == [f"--up {','.join(map(str, up))}"]


def test_up_is_named_in_the_world_of_the_source():
    levelled = turned(0, 90)  # what the loader did
    found = inspect(recording([levelled @ pose for pose in POSES]), Reading(world_from_source=levelled))
    assert mends(found) == ["--up 0,0,1"]


def test_a_tilted_world_is_noted_with_its_floor():
    found = inspect(recording([turned(0, 9) @ pose for pose in POSES]), Reading())
    tilted = next(finding for finding in found if finding.topic == "up")
    assert tilted.verdict == "note"
    x, y, z = map(float, tilted.mend.removeprefix("--up ").split(","))
    assert np.allclose((x, y, z), turned(0, 9)[:3, :3] @ (0, 0, 1), atol=0.03)


def test_a_floor_elsewhere_is_noted():
    raised = [lifted(np.eye(3)) @ pose for pose in POSES]
    for pose in raised:
        pose[2, 3] += 1.7
    found = inspect(recording(raised), Reading())
    assert next(f for f in found if f.topic == "floor").mend == "--floor 1.70"


@pytest.mark.parametrize(("scale_m", "mend"), [(1.0, "--depth-scale 0.001"), (0.005, "--depth-scale 0.001")])
def test_a_wrong_unit_is_named(scale_m, mend):
    found = inspect(recording(scale_m=scale_m), Reading())
    assert mends(found) == [mend]


def test_a_unit_wrong_by_a_thousand_is_hopeless():
    assert any(finding.hopeless for finding in inspect(recording(scale_m=1.0), Reading()))


@pytest.mark.parametrize(("unit", "scale"), [(1000.0, "0.001"), (100.0, "0.01")])
def test_the_unit_of_positions_is_named_and_not_that_of_depth(unit, scale):
    poses = [pose.copy() for pose in POSES]
    for pose in poses:
        pose[:3, 3] *= unit
    found = inspect(recording(poses), Reading())
    assert mends(found) == [f"--position-scale {scale}"], found
    told = Reading(position_scale_m=0.5)  # and it is said in whatever unit they were read before
    assert mends(inspect(recording(poses), told)) == [f"--position-scale {0.5 * float(scale):g}"]


def test_the_unit_of_depth_is_named_as_the_files_have_it():
    read = recording(scale_m=0.01)
    read.depth_unit_m = 0.1  # of the files; the shots are stored otherwise
    assert mends(inspect(read, Reading())) == ["--depth-scale 0.01"]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("axes", ["opencv", "opengl", "ros"])
def test_a_mirrored_world_is_named(axis, axes):
    mirror = np.eye(4)
    mirror[axis, axis] = -1
    poses = [mirror @ pose @ lifted(conventions.FROM_CAMERA[axes].T) @ mirror for pose in POSES]
    found = next(f for f in inspect(recording(poses), Reading()) if f.topic == "poses")
    assert found.verdict == "problem"
    assert "mirrored" in found.text, found


@pytest.mark.parametrize(
    "depths",
    [[np.full_like(DEPTHS[0], 2000)] * 16, [DEPTHS[5]] * 16, [np.full_like(DEPTHS[0], 2000 + i) for i in range(16)]],
)
def test_depth_that_shows_nothing_gets_no_hint_on_axes(depths):
    found = inspect(recording(depths=depths), Reading())
    assert verdicts(found)["depth images"] == "problem"
    assert not {"poses", "up", "depth unit", "intrinsics problem"} & set(verdicts(found))
    assert not any("--axes" in mend or "--poses" in mend for mend in mends(found))


def test_a_camera_that_rests_sees_the_same_and_that_is_no_problem():
    found = inspect(recording([POSES[3]] * 16, [DEPTHS[3]] * 16), Reading())
    assert "depth images" not in verdicts(found)


def test_a_wrong_focal_length_is_named():
    camera = msgspec.structs.replace(room.CAMERA, fx_px=49.0, fy_px=49.0)
    found = inspect(recording(camera=camera), Reading())
    assert verdicts(found)["intrinsics"] == "problem"
    assert any(mend.startswith("--intrinsics 7") for mend in mends(found))


def test_depth_along_the_ray_is_named():
    v, u = np.indices(DEPTHS[0].shape)
    camera = Intrinsics(96, 72, 40.0, 40.0, 47.5, 35.5)
    longer = np.sqrt(1 + ((u - 47.5) / 40) ** 2 + ((v - 35.5) / 40) ** 2)
    depths = [np.rint(room.depth_of(pose, camera) * longer * 1000).astype(np.uint16) for pose in POSES]
    found = inspect(recording(depths=depths, camera=camera), Reading())
    assert verdicts(found)["poses"] == "problem" or verdicts(found).get("intrinsics") == "problem"


def test_depth_that_belongs_to_other_poses_is_a_problem():
    shuffled = [POSES[i] for i in np.random.default_rng(1).permutation(len(POSES))]
    assert verdicts(inspect(recording(shuffled), Reading()))["poses"] == "problem"


@pytest.mark.parametrize("shift", [(9, 0), (-8, 4), (0, -7)])
def test_colour_beside_depth_is_a_problem(shift):
    greys = [np.roll(grey, shift, axis=(1, 0)) for grey in GREYS]
    found = next(f for f in inspect(recording(greys=greys), Reading()) if f.topic == "registration")
    assert found.verdict == "problem"
    words = found.text.split()
    assert abs(int(words[2]) - abs(shift[0])) <= 2, found.text


def test_the_largest_value_of_16_bits_is_no_depth():
    depths = [depth.copy() for depth in DEPTHS]
    for depth in depths:
        depth[20:40, 30:60] = 65535
    found = inspect(recording(depths=depths), Reading())
    assert mends(found) == ["--depth-invalid 65535"]
    assert verdicts(found)["poses"] == "ok"


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"fx_px": 600.0, "fy_px": 600.0}, "problem"),
        ({"cx_px": 130.0}, "problem"),
        ({"cx_px": 70.0}, "note"),
        ({"fy_px": 90.0}, "note"),
        ({}, "ok"),
    ],
)
def test_cameras_that_are_none(changes, verdict):
    camera = msgspec.structs.replace(room.CAMERA, **changes)
    first = next(f for f in inspect(recording(camera=camera), Reading()) if f.topic == "intrinsics")
    assert first.verdict == verdict


def stamps(*steps_s: float) -> list[int]:
    return [round(sum(steps_s[:i]) * 1e9) for i in range(len(steps_s) + 1)]


@pytest.mark.parametrize(
    ("steps_s", "verdict"),
    [
        ([0.3] * 15, "ok"),
        ([0.3] * 9 + [-3600.0] + [0.3] * 5, "note"),
        ([0.0] * 15, "problem"),
        ([3e-7] * 15, "problem"),
        ([300.0] * 15, "problem"),
        ([0.3] * 9 + [60.0] + [0.3] * 5, "note"),
    ],
)
def test_stamps(steps_s, verdict):
    assert verdicts(inspect(recording(stamps_ns=stamps(*steps_s)), Reading()))["stamps"] == verdict


def test_refused_and_unreadable_frames_are_told_by_reason():
    spoilt = recording()
    spoilt.refused = Counter({"its stamp goes back": 9})
    spoilt.unreadable, spoilt.read = Counter({"the colour image has … x … pixels": 11}), 27
    found = inspect(spoilt, Reading())
    texts = {finding.topic: finding.text for finding in found}
    assert "9 of 16 frames are refused: 9 × its stamp goes back" in texts["keyframes"]
    assert "11 cannot: 11 × the colour image" in texts["frames"]
    assert verdicts(found)["keyframes"] == verdicts(found)["frames"] == "problem"


def test_positions_in_another_unit_or_far_away():
    far, millimetres = [pose.copy() for pose in POSES], [pose.copy() for pose in POSES]
    for one, other in zip(far, millimetres, strict=True):
        one[:3, 3] += (512_345.6, 5_403_210.9, 312.4)
        other[:3, 3] *= 1000
    assert "--origin auto" in mends(inspect(recording(far), Reading()))
    assert verdicts(inspect(recording(millimetres), Reading()))["motion"] in {"problem", "note"}
    assert mends(inspect(recording(millimetres), Reading()))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_frames_are_no_problem_but_none_are(count):
    few = recording(POSES[:count], DEPTHS[:count])
    found = inspect(few, Reading())
    assert ("problem" in verdicts(found).values()) == (count == 0)
    assert any(finding.hopeless for finding in found) == (count == 0)


def test_a_sequence_without_any_depth_is_hopeless():
    empty = [np.zeros_like(depth) for depth in DEPTHS]
    assert any(finding.hopeless for finding in inspect(recording(depths=empty), Reading()))


def test_a_camera_that_turns_little_is_judged_by_the_image_and_the_floor():
    poses = [room.pose(0.1 * i, 0.02 * i, 1.2, 10 + i, 12) for i in range(12)]
    depths = [np.rint(room.depth_of(pose) * 1000).astype(np.uint16) for pose in poses]
    assert not mends(inspect(recording(poses, depths), Reading()))
    yup = lifted(np.array(((1.0, 0, 0), (0, 0, 1), (0, -1, 0))))
    assert mends(inspect(recording([yup @ pose for pose in poses], depths), Reading())) == ["--up 0,1,0"]


def test_pairs_are_spread_and_have_moved():
    picker = Picker(total=400, pairs=10)
    poses = [room.pose(0.05 * i, 0, 1, 0) for i in range(400)]
    chosen = [index for index, pose in enumerate(poses) if picker.wants(index, pose)]
    assert 18 <= len(chosen) <= 20
    assert chosen[-1] > 350
    shots = [Shot(i, room.CAMERA, poses[i], DEPTHS[0], 0.001) for i in chosen]
    assert len(pairs_of(shots)) == 10


def test_readings_undo_each_other():
    reading = Reading("camera_from_world", "wxyz", "ros", conventions.FROM_CAMERA["ros"], turned(1, 30) @ turned(0, 90))
    other = replace(reading, poses="world_from_camera", quaternion="xyzw")
    there = conventions.reread(POSES, reading, other)
    back = conventions.reread(there, other, reading)
    assert all(np.allclose(one, two) for one, two in zip(back, POSES, strict=True))


def test_floor_needs_next_to_nothing_below_it():
    surface = gravity.surface_of([shot.view() for shot in recording().shots])
    assert gravity.floor_of(surface, np.array((0, 0, 1.0))).height_m == pytest.approx(0, abs=0.03)
    deeper = np.concatenate((surface.points, surface.points - (0, 0, 1.5)))
    with_cellar = gravity.Surface(deeper, np.tile(surface.normals, (2, 1)), surface.cameras)
    assert gravity.floor_of(with_cellar, np.array((0, 0, 1.0))).height_m == pytest.approx(-1.5, abs=0.03)


def test_the_rotations_are_24():
    found = list(rotations())
    assert len(found) == 24
    assert all(not np.allclose(a, b) for a, b in itertools.combinations(found, 2))
