"""Poses in one file of a folder of one's own come out as the walk, and what is said of them is true."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.sources import SourceError, open_source
from tests.services.ingest.test_sources_reading import CAMERA, FRAMES, OPENGL, WALK, assert_the_walk, own, png

POSES = [pose for pose, _, _ in WALK]


def bare(path, images="rgb"):
    """The walk without poses and without a camera."""
    own(path, intrinsics=False)
    for file in (path / "pose").iterdir():
        file.unlink()
    (path / "pose").rmdir()
    (path / "rgb").rename(path / images) if images != "rgb" else None
    return path


def with_camera(path):
    np.savetxt(path / "intrinsics.txt", [[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
    return path


def quaternions(order="xyzw"):
    rows = [[*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in POSES]
    return np.array(rows)[:, [0, 1, 2, 3, 4, 5, 6] if order == "xyzw" else [0, 1, 2, 6, 3, 4, 5]]


def numbered(rows):
    return np.column_stack((np.arange(len(rows)), rows))


def redwood(path):
    lines = []
    for i, pose in enumerate(POSES):
        lines += [f"{i} {i} {i + 1}", *(" ".join(f"{v:.9f}" for v in row) for row in pose)]
    path.write_text("\n".join(lines) + "\n")


LISTS = {
    "poses.npy": lambda path: np.save(path, np.array(POSES)),
    "trajectory.npy": lambda path: np.save(path, np.array(POSES)[:, :3]),
    "pose.npy": lambda path: np.save(path, np.array(POSES).reshape(FRAMES, 16)),
    "poses.txt": lambda path: np.savetxt(path, np.array(POSES).reshape(FRAMES, 16)),
    "traj.txt": lambda path: np.savetxt(path, np.array(POSES)[:, :3].reshape(FRAMES, 12)),  # KITTI
    "camera_poses.csv": lambda path: np.savetxt(path, np.array(POSES)[:, :3].reshape(FRAMES, 12), delimiter=","),
    "trajectory.txt": lambda path: np.savetxt(path, np.array(POSES).reshape(-1, 4)),  # below each other
    "groundtruth.txt": lambda path: np.savetxt(path, numbered(quaternions())[::-1]),  # in any order
    "pose.txt": lambda path: np.savetxt(path, quaternions("wxyz")),
    "scene.log": redwood,
    "trajectory.log": redwood,
}


@pytest.mark.parametrize("name", LISTS)
def test_a_list_of_poses_is_the_walk(tmp_path, name):
    LISTS[name](with_camera(bare(tmp_path / "d")) / name)
    source = open_source(tmp_path / "d")
    assert source.layout == "generic"
    assert name in source.why[0]
    assert any("world_from_camera with opencv" in note for note in source.notes), source.notes
    assert_the_walk(source, stamps=False)


def transforms(path, *, images="rgb", depth=False, angle=False, suffix=".png", **fields):
    frames = [
        {
            "file_path": f"./{images}/{i:06d}{suffix}",
            "transform_matrix": (pose @ OPENGL).tolist(),
            **({"depth_file_path": f"measured/{i:06d}.png"} if depth else {}),
        }
        for i, pose in enumerate(POSES)
    ]
    size = {"w": CAMERA.width_px, "h": CAMERA.height_px}
    camera = {"fl_x": 60.0, "fl_y": 60.0, "cx": 39.5, "cy": 29.5}
    camera = {"camera_angle_x": 2 * np.arctan(40 / 60)} if angle else camera
    content = size | camera | {"scale": 0.33, "aabb_scale": 16, "frames": frames[::-1]} | fields
    (path / "transforms.json").write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("kind", ["plain", "other folders", "without endings"])
def test_transforms_of_nerfstudio_are_the_walk_with_axes_that_are_named(tmp_path, kind):
    path = bare(tmp_path / "d", images="left" if kind == "other folders" else "images")
    if kind == "other folders":
        (path / "depth").rename(path / "measured")
        transforms(path, images="left", depth=True)
    else:
        transforms(path, images="images", suffix="" if kind == "without endings" else ".png")
    source = open_source(path)
    assert any("opengl camera axes (as transforms.json has them)" in note for note in source.notes), source.notes
    assert_the_walk(source, stamps=False)


def test_transforms_may_tell_the_angle_of_view(tmp_path):
    source = open_source(transforms(bare(tmp_path / "d"), angle=True))
    assert source.intrinsics.fx_px == pytest.approx(60)
    assert source.intrinsics.cx_px == 40


def test_a_convention_that_is_told_goes_before_that_of_the_file(tmp_path):
    path = transforms(bare(tmp_path / "d"))
    content = json.loads((path / "transforms.json").read_text())
    for frame, pose in zip(content["frames"], POSES[::-1], strict=True):
        frame["transform_matrix"] = pose.tolist()
    (path / "transforms.json").write_text(json.dumps(content))
    source = open_source(path, options=ReadOptions(camera_axes="opencv"))
    assert any("opencv camera axes (as told)" in note for note in source.notes)
    assert_the_walk(source, stamps=False)


def colmap(path, model="PINHOLE 80 60 60 60 39.5 29.5"):
    path.mkdir(parents=True, exist_ok=True)
    (path / "cameras.txt").write_text(f"# Camera list\n1 {model}\n2 PINHOLE 10 10 5 5 5 5\n")
    lines = ["# Image list"]
    for i, pose in enumerate(POSES):
        camera_from_world = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(camera_from_world[:3, :3]).as_quat()
        numbers = " ".join(f"{v:.9f}" for v in (w, x, y, z, *camera_from_world[:3, 3]))
        lines += [f"{i + 1} {numbers} 1 {i:06d}.png", "1.5 2.5 -1 3.5 4.5 7 8.5 9.5 1 10.5 11.5 -1" if i % 2 else ""]
    (path / "images.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("folder", [".", "sparse/0"])
def test_a_model_of_colmap_is_the_walk(tmp_path, folder):
    path = bare(tmp_path / "d", images="images")
    colmap(path / folder)
    source = open_source(path)
    assert any("camera_from_world with opencv camera axes (as images.txt has them)" in n for n in source.notes)
    assert (source.intrinsics.fx_px, source.intrinsics.width_px) == (60, 80)
    assert_the_walk(source, stamps=False)


def test_a_camera_of_colmap_that_is_not_read_is_named(tmp_path):
    path = bare(tmp_path / "d", images="images")
    colmap(path, model="FOV 80 60 60 60 39.5 29.5 0.9")
    with pytest.raises(SourceError, match=r"cameras.txt has a camera that is not read \('FOV'\): SIMPLE_PINHOLE"):
        open_source(path)


def test_a_model_of_colmap_without_images_is_told(tmp_path):
    path = bare(tmp_path / "d", images="images")
    colmap(path)
    (path / "images.txt").write_text("# Image list\n1 1 0 0 0 0 0 0 7 000000.png\n\n")
    with pytest.raises(SourceError, match=r"images\.txt has no image with a pose and a camera of cameras\.txt"):
        open_source(path)


ROS_1 = """header:
  seq: 12
  frame_id: camera
height: 60
width: 80
distortion_model: plumb_bob
D: [0.0, 0.0, 0.0, 0.0, 0.0]
K: [60.0, 0.0, 39.5, 0.0, 60.0, 29.5, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [50.0, 0.0, 30.0, 0.0, 0.0, 50.0, 20.0, 0.0, 0.0, 0.0, 1.0, 0.0]
roi:
  height: 0
  width: 0
"""
ROS_2 = """height: 60
width: 80
distortion_model: plumb_bob
d:
- 0.0
- 0.0
- 0.0
- 0.0
- 0.0
k:
- 60.0
- 0.0
- 39.5
- 0.0
- 60.0
- 29.5
- 0.0
- 0.0
- 1.0
p:
- 50.0
- 0.0
"""
CALIBRATOR = """image_width: 80
image_height: 60
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [60., 0., 39.5, 0., 60., 29.5, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.0, 0.0, 0.0, 0.0, 0.0]
"""


@pytest.mark.parametrize("text", [ROS_1, ROS_2, CALIBRATOR])
def test_a_camera_of_ros_is_read(tmp_path, text):
    path = own(tmp_path / "d", intrinsics=False)
    (path / "camera_info.yaml").write_text(text)
    source = open_source(path)
    assert (source.intrinsics.fx_px, source.intrinsics.cx_px, source.intrinsics.width_px) == (60, 39.5, 80)
    assert_the_walk(source, stamps=False)


def test_the_lens_of_a_camera_of_ros_is_straightened(tmp_path):
    path = own(tmp_path / "d", intrinsics=False)
    bent = ROS_1.replace("D: [0.0, 0.0,", "D: [-0.05, 0.01,")
    (path / "camera_info.yaml").write_text(bent)
    assert any("undistorted (opencv lens, 5" in note for note in open_source(path).notes)


def test_poses_that_are_none_are_told_with_what_lies_there(tmp_path):
    path = with_camera(bare(tmp_path / "d"))
    (path / "odometry.bin").write_bytes(b"?")
    with pytest.raises(SourceError, match=r"no folder of poses .*poses\.npy.*transforms\.json.*odometry\.bin") as error:
        open_source(path)
    assert "images.txt with cameras.txt" in str(error.value)


@pytest.mark.parametrize(
    ("name", "write", "reason"),
    [
        ("poses.npy", lambda p: np.save(p, np.zeros((FRAMES, 5))), "instead of \\(n, 4, 4\\)"),
        ("poses.npy", lambda p: p.write_bytes(b"none"), "holds no poses: it is no saved array"),
        ("poses.npy", lambda p: np.save(p, np.array(POSES[:-2])), "6 poses for 8 images"),
        ("poses.txt", lambda p: np.savetxt(p, np.zeros((FRAMES, 9))), "rows have 9 numbers instead of 16, 12, 8 or 7"),
        ("poses.txt", lambda p: p.write_text("a b c\n" * 9), "no list of poses"),
        ("groundtruth.txt", lambda p: np.savetxt(p, numbered(quaternions()) + 900), "belongs to an image"),
        ("transforms.json", lambda p: p.write_text("{}"), "lacks 'frames'"),
        (
            "transforms.json",
            lambda p: p.write_text('{"frames": [{"file_path": "rgb/000000.png"}]}'),
            "transform_matrix",
        ),
        ("transforms.json", lambda p: p.write_text("[1]"), "is not a transforms.json"),
    ],
)
def test_lists_that_are_none_are_one_sentence(tmp_path, name, write, reason):
    write(with_camera(bare(tmp_path / "d")) / name)
    with pytest.raises(SourceError, match=reason):
        open_source(tmp_path / "d")


def test_images_of_a_list_without_depth_are_asked_for_it(tmp_path):
    path = transforms(bare(tmp_path / "d"))
    for file in (path / "depth").iterdir():
        file.unlink()
    (path / "depth").rmdir()
    with pytest.raises(SourceError, match="lacks depth images"):
        open_source(path)


def test_a_frame_without_a_line_is_one_bad_frame(tmp_path):
    path = with_camera(bare(tmp_path / "d"))
    np.savetxt(path / "groundtruth.txt", numbered(quaternions())[[0, 1, 2, 4, 5, 6, 7]])
    frames = list(open_source(path))
    assert [index for index, frame in enumerate(frames) if hasattr(frame, "reason")] == [3]


def test_images_are_not_changed(tmp_path):
    path = with_camera(bare(tmp_path / "d"))
    np.save(path / "poses.npy", np.array(POSES))
    assert next(iter(open_source(path))).color == png(WALK[0][1])
