"""Source layouts: folders generated as their publishers document them, from a room whose walls are known.

A room with a pillar is drawn by casting rays, and written with each publisher's axes, units and file names. What the
loader gives must put every depth pixel back onto the room's walls, and its colour must be that of the point it hits:
this fails for a wrong axis, sign, unit, pixel convention or mirror image (neither room nor pillar is symmetric about
any axis of the world).
"""

import functools
import hashlib
import json
import re

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import back_project, transform
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.ingest.core.lidar import depth_image
from prior_sg.services.ingest.core.pairing import associate
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.ingest.sources.scannet import resampled

ROOM = np.array(((0.5, -1.0, 0.0), (5.5, 3.0, 2.6)))  # lower and upper corner, metres, z up
PILLAR = np.array(((3.2, 1.6, 0.0), (3.9, 2.0, 1.9)))
ROBOT = Rotation.from_matrix(((0, 0, 1), (-1, 0, 0), (0, -1, 0)))  # x forward, y left, z up, from camera axes


def view(x, y, z, yaw_deg, pitch_deg, roll_deg):  # noqa: PLR0917
    """world_from_camera, camera x right, y down, z forward."""
    pose = np.eye(4)
    turn = Rotation.from_euler("ZYX", (yaw_deg, pitch_deg, roll_deg), degrees=True) * ROBOT
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), (x, y, z)
    return pose


VIEWS = [view(1.2, 0.3, 1.4, 20, 10, 4), view(1.3, 0.2, 1.5, 33, -7, -6), view(2.0, 2.4, 1.1, -35, 5, 12)]


def once(function):
    """A function of arrays that computes each result once; nobody may write into it."""
    known = {}

    @functools.wraps(function)
    def kept(*arrays):
        key = hashlib.sha1(b"".join(array.tobytes() for array in arrays)).digest()
        if key not in known:
            known[key] = function(*arrays)
            known[key].flags.writeable = False
        return known[key]

    return kept


@once
def cast(origin, directions):
    """How far, in lengths of the direction, each ray (..., 3) gets."""
    with np.errstate(divide="ignore", invalid="ignore"):
        room_exit = np.where(directions > 0, (ROOM[1] - origin) / directions, (ROOM[0] - origin) / directions)
        slabs = (PILLAR - origin)[:, None, :] / directions.reshape(1, -1, 3)
    enter, leave = slabs.min(axis=0).max(axis=1), slabs.max(axis=0).min(axis=1)
    pillar = np.where((enter > 0) & (enter < leave), enter, np.inf).reshape(directions.shape[:-1])
    return np.minimum(room_exit.min(axis=-1), pillar)


def rays(fx, fy, cx, cy, width, height, first=0.0):  # noqa: PLR0917
    """Directions (h, w, 3) with z = 1; `first` is the coordinate of the first pixel's centre."""
    v, u = np.indices((height, width)) + first
    return np.stack(((u - cx) / fx, (v - cy) / fy, np.ones((height, width))), axis=-1)


def shade(points):
    """Colour (blue, green, red) of points of the room: their place in it."""
    return np.clip(40 + 180 * (points - ROOM[0]) / (ROOM[1] - ROOM[0]), 0, 255).astype(np.uint8)


def render(pose, directions):
    """Depth along the optical axis, metres, and colour."""
    turned = directions @ pose[:3, :3].T
    depth = cast(pose[:3, 3], turned)
    return depth, shade(pose[:3, 3] + depth[..., None] * turned)


def off_wall(points):
    """Distance of points to the nearest wall of room or pillar."""
    walls = np.abs(points[:, None, :] - ROOM).min(axis=(1, 2))
    outside = np.abs(points - PILLAR.mean(axis=0)) - (PILLAR[1] - PILLAR[0]) / 2
    pillar = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)
    return np.minimum(walls, np.abs(pillar))


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else [])


def integers(depth, scale):
    return np.rint(depth * scale).astype(np.uint16)


def words(numbers):
    return " ".join(f"{number:.9f}" for number in numbers)


def quaternion(matrix):
    return Rotation.from_matrix(matrix).as_quat()


# Publishers' folders: each writes VIEWS and returns its folder and the files of the second frame.


def tum(tmp_path, name="rgbd_dataset_freiburg1_room"):
    """Colour, depth and motion capture have stamps of their own: 30 Hz, 30 Hz, 100 Hz."""
    folder = tmp_path / name
    colors, depths, poses = (["# made for a test", "# file: 'room.bag'", "# timestamp"] for _ in range(3))
    for index, pose in enumerate(VIEWS):
        stamp, depth_stamp = 1305031102.175304 + index / 30, 1305031102.160407 + index / 30
        depth, color = render(pose, rays(517.3, 516.5, 318.6, 255.3, 640, 480))
        write(folder / f"rgb/{stamp:.6f}.png", color)
        write(folder / f"depth/{depth_stamp:.6f}.png", integers(depth, 5000))
        colors.append(f"{stamp:.6f} rgb/{stamp:.6f}.png")
        depths.append(f"{depth_stamp:.6f} depth/{depth_stamp:.6f}.png")
        for late in (-0.013, -0.003, 0.007):  # the middle one is the closest and the true one
            shifted = pose.copy()
            shifted[:3, 3] += 10 * (late + 0.003)
            poses.append(f"{stamp + late:.4f} {words(shifted[:3, 3])} {words(quaternion(shifted[:3, :3]))}")
    for file, lines in (("rgb.txt", colors), ("depth.txt", depths), ("groundtruth.txt", poses)):
        (folder / file).write_text("\n".join(lines) + "\n")
    second = 1 / 30
    return folder, {
        "color": folder / f"rgb/{1305031102.175304 + second:.6f}.png",
        "depth": folder / f"depth/{1305031102.160407 + second:.6f}.png",
        "pose": (folder / "groundtruth.txt", 7),
    }


def icl_nuim(tmp_path):
    """World x right, y up, z forward (left-handed: our y and z exchanged); camera x right, y up, z forward, fy < 0."""
    folder = tmp_path / "living_room_traj2_frei_png"
    pairs, poses = [], []
    exchange = np.eye(3)[[0, 2, 1]]
    directions = rays(481.2, -480.0, 319.5, 239.5, 640, 480)  # in the camera's own axes, as the publisher's K says
    for index, pose in enumerate(VIEWS):
        right, down, forward = pose[:3, :3].T
        axes, position = exchange @ np.stack((right, -down, forward), axis=1), exchange @ pose[:3, 3]
        turned = directions @ axes.T @ exchange  # from their world to ours
        depth = cast(pose[:3, 3], turned)
        write(folder / f"rgb/{index}.png", shade(pose[:3, 3] + depth[..., None] * turned))
        write(folder / f"depth/{index}.png", integers(depth, 5000))
        pairs.append(f"{index} depth/{index}.png {index} rgb/{index}.png")
        poses.append(f"{index} {words(position)} {words(quaternion(axes))}")
    (folder / "associations.txt").write_text("\n".join(pairs) + "\n")
    (folder / "livingRoom2.gt.freiburg").write_text("\n".join(poses) + "\n")
    files = {"color": folder / "rgb/1.png", "depth": folder / "depth/1.png"}
    return folder, files | {"pose": (folder / "livingRoom2.gt.freiburg", 1)}


def replica(tmp_path):
    """The camera's file lies above the scenes."""
    folder = tmp_path / "Replica" / "room0"
    for index, pose in enumerate(VIEWS):
        depth, color = render(pose, rays(150.0, 150.0, 149.5, 84.5, 300, 170))
        write(folder / f"results/frame{index:06d}.jpg", color)
        write(folder / f"results/depth{index:06d}.png", integers(depth, 6553.5))
    lines = [" ".join(f"{v:.18e}" for v in pose.ravel()) for pose in VIEWS]
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")
    camera = {"w": 300, "h": 170, "fx": 150.0, "fy": 150.0, "cx": 149.5, "cy": 84.5, "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    files = {"color": folder / "results/frame000001.jpg", "depth": folder / "results/depth000001.png"}
    return folder, files | {"pose": (folder / "traj.txt", 1)}


def scannet(tmp_path):
    """Colour has twice the pixels of depth, and a camera of its own."""
    folder = tmp_path / "scene0000_00"
    depth_camera, color_camera = (290.0, 291.0, 161.0, 118.0), (584.0, 586.0, 326.0, 241.0)
    for index, pose in enumerate(VIEWS):
        depth, _ = render(pose, rays(*depth_camera, 320, 240))
        _, color = render(pose, rays(*color_camera, 648, 484))
        write(folder / f"color/{index}.jpg", color)
        write(folder / f"depth/{index}.png", integers(depth, 1000))
        (folder / "pose").mkdir(exist_ok=True)
        (folder / f"pose/{index}.txt").write_text("".join(words(row) + "\n" for row in pose))
    (folder / "intrinsic").mkdir()
    for name, (fx, fy, cx, cy) in (("depth", depth_camera), ("color", color_camera)):
        rows = ((fx, 0, cx, 0), (0, fy, cy, 0), (0, 0, 1, 0), (0, 0, 0, 1))
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text("".join(words(row) + "\n" for row in rows))
        (folder / f"intrinsic/extrinsic_{name}.txt").write_text("".join(words(row) + "\n" for row in np.eye(4)))
    files = {"color": folder / "color/1.jpg", "depth": folder / "depth/1.png"}
    return folder, files | {"pose": (folder / "pose/1.txt", None)}


def hm3d(tmp_path):
    """World x right, y up, z backward; camera likewise; pixels as OpenGL draws them, 90 degrees wide."""
    folder = tmp_path / "00824-Dd4bFSTQ8gi"
    width, height = 270, 180
    directions = rays(width / 2, width / 2, width / 2, height / 2, width, height, first=0.5)
    habitat_from_world = np.array(((1, 0, 0), (0, 0, 1), (0, -1, 0)))
    for index, pose in enumerate(VIEWS):
        depth, color = render(pose, directions)
        write(folder / f"rgb/Dd4bFSTQ8gi_{index:06d}.png", color)
        write(folder / f"depth/Dd4bFSTQ8gi_{index:06d}.png", integers(depth, 1000))
        right, down, forward = pose[:3, :3].T
        matrix = np.eye(4)
        matrix[:3, :3] = habitat_from_world @ np.stack((right, -down, -forward), axis=1)
        matrix[:3, 3] = habitat_from_world @ pose[:3, 3]
        (folder / "pose").mkdir(exist_ok=True)
        (folder / f"pose/Dd4bFSTQ8gi_{index:06d}.txt").write_text("\t".join(map(str, matrix.ravel())) + "\n")
    stem = "Dd4bFSTQ8gi_000001"
    files = {"color": folder / f"rgb/{stem}.png", "depth": folder / f"depth/{stem}.png"}
    return folder, files | {"pose": (folder / f"pose/{stem}.txt", 0)}


def tartanground(tmp_path):
    """World north, east, down; camera forward, right, down; depth as float bytes; the axis at the image's middle."""
    folder = tmp_path / "Office" / "Data_omni" / "P0000"
    directions = rays(100.0, 100.0, 100.0, 100.0, 200, 200, first=0.5)
    ned_from_world = np.diag((1, -1, -1))
    lines = []
    for index, pose in enumerate(VIEWS):
        depth, color = render(pose, directions)
        write(folder / f"image_lcam_front/{index:06d}_lcam_front.png", color)
        packed = np.ascontiguousarray(depth.astype("<f4")).view(np.uint8).reshape(200, 200, 4)
        write(folder / f"depth_lcam_front/{index:06d}_lcam_front_depth.png", packed)
        right, down, forward = pose[:3, :3].T
        axes = ned_from_world @ np.stack((forward, right, down), axis=1)
        lines.append(f"{words(ned_from_world @ pose[:3, 3])} {words(quaternion(axes))}")
    (folder / "pose_lcam_front.txt").write_text("\n".join(lines) + "\n")
    return folder, {
        "color": folder / "image_lcam_front/000001_lcam_front.png",
        "depth": folder / "depth_lcam_front/000001_lcam_front_depth.png",
        "pose": (folder / "pose_lcam_front.txt", 0),
    }


CODA_LENS = (-0.0559502131995934, 0.123761456061624, 0.00114530935813615, -0.00367111451580028, -0.0636070725936968)
CODA_MATRIX = np.array(((365.1, 0, 305.5), (0, 364.9, 268.9), (0, 0, 1)))  # half of the published size, for speed
CODA_TURN = Rotation.from_euler("xyz", (1.2, -0.8, 0.5), degrees=True).as_matrix()
CODA_PROJECTION = np.array(((365.5, 0, 303.3, 0), (0, 365.5, 265.8, 0), (0, 0, 1, 0)))
CODA_EXTRINSIC = np.array(  # the example of the publisher's report
    (
        (-0.0050614, -0.9999872, 0.0000000, 0.03),
        (-0.1556502, 0.0007878, -0.9878119, -0.05),
        (0.9877993, -0.0049997, -0.1556522, 0),
        (0, 0, 0, 1),
    )
)


def listed(matrix):
    return ", ".join(f"{number}" for number in np.ravel(matrix))


def coda(tmp_path, kind="2d_rect", poses="dense_global"):
    """The lidar's poses; images raw (with lens distortion) or rectified; 128 x 1024 points a scan."""
    root = tmp_path / "CODa"
    size = {"2d_raw": ".png", "2d_rect": ".jpg"}
    angles = np.deg2rad(np.linspace(360, 0, 1024, endpoint=False)), np.deg2rad(np.linspace(22.5, -22.5, 128))
    azimuth, elevation = np.meshgrid(*angles)
    beams = np.stack(
        (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), axis=-1
    )
    pixels = np.stack(np.indices((512, 612))[::-1], axis=-1).reshape(-1, 1, 2).astype(float)
    if kind == "2d_raw":
        plane = cv2.undistortPoints(pixels, CODA_MATRIX, np.array(CODA_LENS)).reshape(512, 612, 2)
        turn = np.eye(3)
    else:
        plane = (pixels.reshape(512, 612, 2) - CODA_PROJECTION[:2, 2]) / CODA_PROJECTION[0, 0]
        turn = CODA_TURN
    directions = np.concatenate((plane, np.ones((512, 612, 1))), axis=-1) @ turn  # from rectified to camera axes
    (root / "timestamps").mkdir(parents=True)
    (root / f"poses/{poses}").mkdir(parents=True)
    stamps, lines = [f"{1673884185.589118 + 0.1 * i:.6f}" for i in range(3)], []
    for index, pose in enumerate(VIEWS):
        _, color = render(pose, directions)
        write(root / f"{kind}/cam0/7/{kind}_cam0_7_{index}{size[kind]}", color)
        world_from_lidar = pose @ CODA_EXTRINSIC
        ranges = cast(world_from_lidar[:3, 3], beams @ world_from_lidar[:3, :3].T)
        scan = np.concatenate((beams * ranges[..., None], np.full((128, 1024, 1), 9.0)), axis=-1)
        scan[40:44, 500:520] = 0  # nothing came back
        (root / "3d_comp/os1/7").mkdir(parents=True, exist_ok=True)
        scan.astype("<f4").tofile(root / f"3d_comp/os1/7/3d_comp_os1_7_{index}.bin")
        x, y, z, w = quaternion(world_from_lidar[:3, :3])
        lines.append(f"{stamps[index]} {words(world_from_lidar[:3, 3])} {words((w, x, y, z))}")
    (root / "timestamps/7.txt").write_text("\n".join(stamps) + "\n")
    (root / f"poses/{poses}/7.txt").write_text("\n".join(lines) + "\n")
    (root / "calibrations/7").mkdir(parents=True)
    (root / "calibrations/7/calib_os1_to_cam0.yaml").write_text(
        f"extrinsic_matrix:\n  rows: 4\n  cols: 4\n  data: [\n    {listed(CODA_EXTRINSIC)} ]\n"
    )
    dashes = "".join(f"\n  - {number}" for number in CODA_LENS)  # as a YAML writer may put it
    (root / "calibrations/7/calib_cam0_intrinsics.yaml").write_text(
        "image_width: 612\nimage_height: 512\ncamera_name: narrow_stereo/left\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{listed(CODA_MATRIX)}]\n"
        f"distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data:{dashes}\n"
        f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [{listed(CODA_TURN)}]\n"
        f"projection_matrix:\n  rows: 3\n  cols: 4\n  data: [{listed(CODA_PROJECTION)}]\n"
    )
    return root / kind / "cam0" / "7", {
        "color": root / f"{kind}/cam0/7/{kind}_cam0_7_1{size[kind]}",
        "depth": root / "3d_comp/os1/7/3d_comp_os1_7_1.bin",
        "pose": (root / f"poses/{poses}/7.txt", 1),
    }


def coda_raw(tmp_path):
    return coda(tmp_path, "2d_raw", "dense")


# layout: writer, and the camera it must come out with
LAYOUTS = {
    "tum": (tum, Intrinsics(640, 480, 517.3, 516.5, 318.6, 255.3)),
    "icl-nuim": (icl_nuim, Intrinsics(640, 480, 481.2, 480.0, 319.5, 239.5)),
    "replica": (replica, Intrinsics(300, 170, 150.0, 150.0, 149.5, 84.5)),
    "scannet": (scannet, Intrinsics(320, 240, 290.0, 291.0, 161.0, 118.0)),
    "hm3d": (hm3d, Intrinsics(270, 180, 135.0, 135.0, 134.5, 89.5)),
    "tartanground": (tartanground, Intrinsics(200, 200, 100.0, 100.0, 99.5, 99.5)),
    "coda": (coda, Intrinsics(612, 512, 365.5, 365.5, 303.3, 265.8)),
    "coda raw": (coda_raw, Intrinsics(612, 512, 365.1, 364.9, 305.5, 268.9)),
}


def decoded(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_depth_lies_on_the_walls_and_colour_on_the_points(tmp_path, layout):
    writer, camera = LAYOUTS[layout]
    folder, _ = writer(tmp_path)
    source = open_source(folder)
    frames = list(source)
    assert (source.layout, source.total, source.intrinsics) == (layout.split()[0], 3, camera)
    assert all(isinstance(frame, RawFrame) for frame in frames), frames
    assert [(frame.index, frame.frame_id, frame.total) for frame in frames] == [(i, i, 3) for i in range(3)]
    assert frames[0].stamp_ns < frames[1].stamp_ns < frames[2].stamp_ns
    for frame, pose in zip(frames, VIEWS, strict=True):
        depth = decoded(frame.depth)
        assert depth.dtype == np.uint16
        depth_m = depth * frame.depth_scale_m
        seen = depth_m > 0
        points = transform(frame.world_from_camera, back_project(depth_m, camera)[seen])
        distances = off_wall(points)
        color = decoded(frame.color)[seen].astype(int)
        wrong = np.abs(color - shade(points)).max(axis=1)
        if layout.startswith("coda"):
            assert 0.5 < seen.mean() < 1  # the lidar does not see what lies above and below its beams
        else:
            assert seen.all()
            np.testing.assert_allclose(frame.world_from_camera, pose, atol=1e-6)
        assert np.quantile(distances, 0.98) < 0.004
        assert np.quantile(wrong, 0.95) <= 5


def test_a_wrong_mirror_axis_or_unit_would_be_noticed(tmp_path):
    """The check above has teeth: each of these errors takes points off the walls."""
    folder, _ = replica(tmp_path)
    frame = next(iter(open_source(folder)))
    depth_m = decoded(frame.depth) * frame.depth_scale_m
    pose = np.array(frame.world_from_camera)
    camera = LAYOUTS["replica"][1]
    for changed in (pose * (1, -1, 1, 1), pose * (-1, 1, 1, 1), np.diag((1, -1, 1, 1)) @ pose, pose[[0, 2, 1, 3]]):
        assert np.quantile(off_wall(transform(changed, back_project(depth_m, camera).reshape(-1, 3))), 0.98) > 0.1
    assert np.quantile(off_wall(transform(pose, back_project(depth_m * 1.03, camera).reshape(-1, 3))), 0.98) > 0.02


# Broken frames


def replace_line(path, index, change):
    """Change one line of data (comments are not counted), or the whole file."""
    if index is None:
        path.write_text(change(path.read_text()))
        return
    lines = path.read_text().splitlines()
    data = [i for i, line in enumerate(lines) if not line.startswith("#")]
    lines[data[index]] = change(lines[data[index]])
    path.write_text("\n".join(lines) + "\n")


def infinite(layout):
    """The pose with infinite or missing numbers, as far as its format has them."""
    stamped = layout in ("tum", "icl-nuim", "coda", "coda raw")

    def change(line):
        old = line.split()
        return " ".join(old[:1] + ["nan"] * (len(old) - 1) if stamped else ["-inf"] * len(old))

    return change


@pytest.mark.parametrize("damage", ["no colour", "no depth", "cut colour", "other size", "infinite pose"])
@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "coda raw"])
def test_a_broken_frame_is_bad_and_the_others_come(tmp_path, layout, damage):
    folder, files = LAYOUTS[layout][0](tmp_path)
    reasons = {
        "no colour": ("cannot be read|has no colour file", files["color"].unlink),
        "no depth": ("cannot be read|has no (depth|lidar) file", files["depth"].unlink),
        "cut colour": ("colour image", lambda: files["color"].write_bytes(files["color"].read_bytes()[:-200])),
        "other size": ("has 90 x 70 pixels", lambda: write(files["color"], np.zeros((70, 90, 3), np.uint8))),
        "infinite pose": ("its pose is not finite", lambda: replace_line(*pose_line(layout, files), infinite(layout))),
    }
    reason, harm = reasons[damage]
    harm()
    source = open_source(folder)
    first, broken, last = source
    assert (type(first), type(broken), type(last)) == (RawFrame, BadFrame, RawFrame), (first, broken, last)
    assert (broken.frame_id, broken.index, broken.total, source.total) == (1, 1, 3, 3)
    assert re.search(reason, broken.reason), broken.reason


def pose_line(layout, files):
    """File and line of the second frame's pose."""
    path, index = files["pose"]
    return path, {"tum": 4, "tartanground": 1}.get(layout, index)


# One layout each


def published_association(first, second, max_difference):
    """The rule of the TUM benchmark's associate.py, word by word: all pairs, best first, each stamp once."""
    pairs = sorted((abs(a - b), a, b) for a in first for b in second if abs(a - b) < max_difference)
    first, second, matches = list(first), list(second), []
    for _, a, b in pairs:
        if a in first and b in second:
            first.remove(a)
            second.remove(b)
            matches.append((a, b))
    return sorted(matches)


@pytest.mark.parametrize("seed", range(20))
def test_tum_association_is_the_publishers(seed):
    random = np.random.default_rng(seed)
    first = sorted(set(random.integers(0, 1000, 60).tolist()))
    second = sorted(set(random.integers(0, 1000, 90).tolist()))
    ours = associate(first, second, 20)
    assert sorted((first[i], second[j]) for i, j in ours.items()) == published_association(first, second, 20)


def test_tum_takes_a_pose_of_the_benchmark_as_z_up(tmp_path):
    """First line of freiburg1_xyz's groundtruth.txt: a hand-held camera, head height, looking down at a desk."""
    folder, _ = tum(tmp_path)
    line = "1.3563 0.6305 1.6380 0.6132 0.5962 -0.3311 -0.3986"
    (folder / "groundtruth.txt").write_text(f"1305031102.1753 {line}\n")
    first, *others = open_source(folder)
    right, down, forward = first.world_from_camera[:3, :3].T
    assert abs(right[2]) < 0.1
    assert -0.7 < forward[2] < -0.2
    assert down[2] < -0.7
    assert [other.reason for other in others] == ["no pose lies within 20 ms of it"] * 2


def test_tum_stamps_are_exact_and_a_camera_file_goes_first(tmp_path):
    folder, _ = tum(tmp_path)
    (folder / "depth.txt").write_text("\n".join((folder / "depth.txt").read_text().splitlines()[:-1]) + "\n")
    camera = {"width": 640, "height": 480, "fx": 500, "fy": 501, "cx": 320, "cy": 240, "depth_scale_m": 0.001}
    (folder / "camera.json").write_text(json.dumps(camera))
    source = open_source(folder)
    first, _, last = source
    assert source.intrinsics == Intrinsics(640, 480, 500, 501, 320, 240)
    assert (first.stamp_ns, first.depth_scale_m) == (1305031102175304000, 0.001)
    assert last.reason == "no depth image lies within 20 ms of it"


def test_tum_without_a_known_camera_says_what_to_do(tmp_path):
    folder, _ = tum(tmp_path, "my_recording")
    with pytest.raises(SourceError, match=r"put freiburg1, freiburg2 or freiburg3 .* or a camera\.json"):
        open_source(folder)


def test_icl_nuim_points_are_the_publishers(tmp_path):
    """With the published K (fy < 0) and the file's pose, the renderer's world comes out: ours, y and z exchanged."""
    folder, _ = icl_nuim(tmp_path)
    frame = list(open_source(folder))[2]
    line = np.array((folder / "livingRoom2.gt.freiburg").read_text().splitlines()[2].split()[1:], float)
    depth_m = decoded(frame.depth) / 5000
    v, u = np.indices(depth_m.shape)
    points = np.stack(((u - 319.5) / 481.2 * depth_m, (v - 239.5) / -480.0 * depth_m, depth_m), axis=-1)
    renderer = Rotation.from_quat(line[3:]).apply(points.reshape(-1, 3)) + line[:3]
    ours = transform(frame.world_from_camera, back_project(depth_m, LAYOUTS["icl-nuim"][1]).reshape(-1, 3))
    np.testing.assert_allclose(ours, renderer[:, (0, 2, 1)], atol=1e-6)


def test_icl_nuim_trajectories_may_lack_the_first_frame_but_must_be_one(tmp_path):
    folder, _ = icl_nuim(tmp_path)
    poses = folder / "livingRoom2.gt.freiburg"
    poses.write_text("\n".join(poses.read_text().splitlines()[1:]))
    first, second, _ = open_source(folder)
    assert (first.frame_id, first.reason) == (0, "the trajectory has no pose for it")
    assert (second.frame_id, second.stamp_ns) == (1, 33_333_333)
    (folder / "traj0.gt.freiburg").write_text(poses.read_text())
    with pytest.raises(SourceError, match=r"keep one of livingRoom2\.gt\.freiburg, traj0\.gt\.freiburg"):
        open_source(folder)


def test_hm3d_takes_a_walk_of_hov_sg_as_level_and_counts_from_the_floor(tmp_path):
    """First pose of 00824-Dd4bFSTQ8gi: a camera 1.57 m above the scene's origin, level."""
    folder, files = hm3d(tmp_path)
    published = "1.0 0.0 0.0 0.4622022211551666 0.0 1.0 0.0 1.5688230991363525 0.0 0.0 1.0 -1.872617244720459 0 0 0 1"
    files["pose"][0].write_text("\t".join(published.split()) + "\n")
    frame = list(open_source(folder, floor_m=0.07))[1]
    right, down, forward = frame.world_from_camera[:3, :3].T
    np.testing.assert_allclose((right, down, forward), ((1, 0, 0), (0, 0, -1), (0, 1, 0)), atol=1e-12)
    np.testing.assert_allclose(frame.world_from_camera[:3, 3], (0.4622022, 1.8726172, 1.4988231), atol=1e-6)


def test_tartanground_sky_has_no_depth(tmp_path):
    folder, files = tartanground(tmp_path)
    depth = np.full((200, 200), 65.535, "<f4")
    depth[0, :6] = 65.536, 10000, np.inf, np.nan, -1, 0.0004
    write(files["depth"], depth.view(np.uint8).reshape(200, 200, 4))
    frame = list(open_source(folder))[1]
    image = decoded(frame.depth)
    assert image[0, :7].tolist() == [0, 0, 0, 0, 0, 0, 65535]
    assert (image[1:] == 65535).all()


def test_scannet_colour_is_resampled_onto_the_depth_camera(tmp_path):
    """Depth stays byte for byte; colour is that of the depth pixel's ray, to less than three pixels."""
    folder, _ = scannet(tmp_path)
    source = open_source(folder)
    frame = next(iter(source))
    assert decoded(frame.color).shape == (240, 320, 3)
    assert frame.depth == (folder / "depth/0.png").read_bytes()
    _, expected = render(VIEWS[0], rays(290.0, 291.0, 161.0, 118.0, 320, 240))
    difference = np.abs(decoded(frame.color).astype(int) - expected).max(axis=2)
    assert np.quantile(difference, 0.95) <= 5
    shifted = np.abs(np.roll(decoded(frame.color), 3, axis=1).astype(int) - expected).max(axis=2)
    assert shifted.mean() > 1.5 * difference.mean()  # three pixels beside it would be noticed


def test_scannet_resampling_keeps_to_the_pixel():
    """On a ramp the value is the place: each depth pixel has that of its ray, to a fraction of a pixel."""
    v, u = np.indices((48, 64))
    ramp = np.stack((3 * u, 4 * v, 4 * v), axis=-1).astype(np.uint8)
    color_matrix = np.array(((62.0, 0, 31.6), (0, 63.0, 22.8), (0, 0, 1)))
    depth_matrix = np.array(((30.0, 0, 15.2), (0, 30.5, 11.9), (0, 0, 1)))
    camera = Intrinsics(32, 24, 30.0, 30.5, 15.2, 11.9)
    image = resampled(ramp, color_matrix @ np.linalg.inv(depth_matrix), camera)
    y, x = np.indices((24, 32))[:, 3:-3, 3:-3]
    column, row = (x - 15.2) / 30.0 * 62.0 + 31.6, (y - 11.9) / 30.5 * 63.0 + 22.8
    difference = image[3:-3, 3:-3].astype(float) - np.stack((3 * column, 4 * row, 4 * row), axis=-1)
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.25  # 8 bits are rounded twice; a quarter pixel is 0.75
    assert np.abs(difference).max() < 1.2


def test_coda_raw_images_lose_their_distortion(tmp_path):
    """Bright spots drawn where the lens puts some rays come out where a pinhole puts them."""
    folder, files = coda_raw(tmp_path)
    points = np.array([(x, y, 1.0) for x in (-0.6, -0.3, 0.2, 0.65) for y in (-0.55, 0.1, 0.5)])
    bent = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CODA_MATRIX, np.array(CODA_LENS))[0].reshape(-1, 2)
    straight = (points @ CODA_MATRIX.T)[:, :2]
    assert np.linalg.norm(bent - straight, axis=1).max() > 2
    v, u = np.indices((512, 612))
    spots = sum(255 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 18) for x, y in bent)
    write(files["color"], np.repeat(spots[..., None], 3, axis=-1).astype(np.uint8))
    image = decoded(list(open_source(folder))[1].color)[..., 0].astype(float)
    for x, y in straight:
        near = np.where((np.abs(u - x) < 12) & (np.abs(v - y) < 12) & (image > 20), image, 0)
        assert (near * u).sum() / near.sum() == pytest.approx(x, abs=0.3)
        assert (near * v).sum() / near.sum() == pytest.approx(y, abs=0.3)


def test_coda_root_with_one_sequence_is_that_sequence_and_with_two_asks(tmp_path):
    folder, _ = coda(tmp_path)
    root = folder.parents[2]
    assert open_source(root).path == folder.resolve()
    assert next(iter(open_source(root))).stamp_ns == 1673884185589118000
    (root / "2d_rect/cam0/8").mkdir()
    with pytest.raises(SourceError, match="holds several sequences"):
        open_source(root)
    (root / "poses/dense_global/7.txt").unlink()
    with pytest.raises(SourceError, match=r"no poses of sequence 7: looked for 7\.txt in poses/dense_global and"):
        open_source(folder)


def test_coda_frames_far_from_every_pose_or_with_odd_scans_are_bad(tmp_path):
    folder, files = coda(tmp_path)
    replace_line(files["pose"][0], 0, lambda line: "15" + line[2:])
    files["depth"].write_bytes(files["depth"].read_bytes()[:-4])
    first, second, last = open_source(folder)
    assert first.reason == "no pose lies within 50 ms of it"
    assert second.reason == "its scan of 2097148 bytes does not have 128 x 1024 points"
    assert isinstance(last, RawFrame)


CAMERA = Intrinsics(80, 60, 60.0, 60.0, 39.5, 29.5)


def scan_of_planes(near_m, far_m, columns=40, rows=24):
    """A grid of points as a lidar beside the camera sees them: a near board on the left half before a far wall."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, columns), np.linspace(-0.45, 0.45, rows))
    z = np.where(x < 0, near_m, far_m)
    return np.stack((x * z, y * z, z), axis=-1)


def test_lidar_depth_is_exact_on_planes_and_empty_across_a_jump():
    depth = depth_image(scan_of_planes(2.0, 5.0), CAMERA)
    np.testing.assert_allclose(depth[10:50, 5:37], 2.0, atol=1e-12)
    np.testing.assert_allclose(depth[10:50, 42:75], 5.0, atol=1e-12)
    assert set(np.unique(np.round(depth, 9))) == {0.0, 2.0, 5.0}  # nothing in between


def test_lidar_depth_is_exact_on_a_slanted_plane():
    """The plane z = 3 + 0.4 x - 0.3 y, measured at a few points."""
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 29), np.linspace(-0.5, 0.5, 21))
    z = 3 / (1 - 0.4 * x + 0.3 * y)
    depth = depth_image(np.stack((x * z, y * z, z), axis=-1), CAMERA)
    px, py = (np.indices((60, 80))[1] - 39.5) / 60, (np.indices((60, 80))[0] - 29.5) / 60
    inside = (np.abs(px) < 0.65) & (np.abs(py) < 0.45)
    np.testing.assert_allclose(depth[inside], (3 / (1 - 0.4 * px + 0.3 * py))[inside], atol=1e-9)


def test_lidar_depth_keeps_the_nearest_and_forgets_points_that_are_not_there():
    for first, second in ((5.0, 2.0), (2.0, 5.0)):
        scan = np.concatenate((scan_of_planes(first, first), scan_of_planes(second, second)), axis=0)
        np.testing.assert_allclose(depth_image(scan, CAMERA)[10:50, 5:75], 2.0, atol=1e-12)
    scan = scan_of_planes(5.0, 5.0)
    scan[10:14, 10:20] = np.nan
    scan[:, 30:] *= -1  # behind the camera
    depth = depth_image(scan, CAMERA)
    assert depth[30, 28] == 0
    assert (depth[:, 60:] == 0).all()
    assert depth[30, 50] == pytest.approx(5.0)


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "coda raw"])
def test_regions_beside_any_layout_are_ground_truth(tmp_path, layout):
    folder, _ = LAYOUTS[layout][0](tmp_path)
    assert open_source(folder).ground_truth is None
    (folder / "regions.json").write_text('{"regions": []}')
    assert open_source(folder).ground_truth == {"regions": []}


UNREADABLE = {
    "tum": ("depth.txt", "9e99 depth/1.png\n", "does not begin with a stamp in seconds: 9e99"),
    "tum, short": ("groundtruth.txt", "1 2 3\n", "has a line with 3 instead of 8 columns"),
    "icl-nuim": ("associations.txt", "one depth/1.png one rgb/1.png\n", "does not begin with a frame number: one"),
    "replica": ("../cam_params.json", '{"camera": {"w": 3}}', "is not a camera"),
    "scannet": ("intrinsic/intrinsic_depth.txt", "1 2\n3 4\n", "is not a camera matrix"),
    "tartanground": ("pose_lcam_front.txt", "1 2\n", "has a line with 2 instead of 7 columns"),
    "coda": ("../../../calibrations/7/calib_cam0_intrinsics.yaml", "image_width: 3\n", "has no projection_matrix"),
}


@pytest.mark.parametrize("layout", UNREADABLE)
def test_sources_that_cannot_be_opened_are_explained_in_one_sentence(tmp_path, layout):
    folder, _ = LAYOUTS[layout.split(",")[0]][0](tmp_path)
    file, text, reason = UNREADABLE[layout]
    (folder / file).write_text(text)
    with pytest.raises(SourceError, match=reason) as error:
        open_source(folder)
    assert "\n" not in str(error.value)


def test_what_was_looked_for_is_named(tmp_path):
    with pytest.raises(SourceError) as error:
        open_source(tmp_path)
    for name in ("dataset", "7-Scenes", "TUM RGB-D", "ICL-NUIM", "Replica", "ScanNet", "HM3D", "TartanGround", "CODa"):
        assert name in str(error.value)
