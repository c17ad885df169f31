"""What users' folders hold besides a recording, or instead of one: read as it is meant, or one true sentence."""

import json
import re

import numpy as np
import pytest

from prior_sg.services.ingest.sources import SourceError, open_source
from tests.services.ingest.test_sources_reading import (
    WALK,
    assert_the_walk,
    dataset,
    npy,
    own,
    png,
    rows_of,
)

ROWS = rows_of([pose for pose, _, _ in WALK])


def renamed(path, name):
    for i in range(len(WALK)):
        for folder in ("color", "depth"):
            (path / folder / f"{i:06d}.png").rename(path / folder / name.format(i))
    return path


@pytest.mark.parametrize("name", ["{:06d}.PNG", "{}.png", "{:04d}.Png", "{:09d}.png"])
def test_numbers_and_endings_of_images_may_be_written_in_any_way(tmp_path, name):
    assert_the_walk(open_source(renamed(dataset(tmp_path), name)))


@pytest.mark.parametrize("name", ["._000001.png", ".000001.png", ".DS_Store", "Thumbs.db"])
def test_files_of_the_system_are_no_images(tmp_path, name):
    dataset(tmp_path / "a")
    own(tmp_path / "b")
    for folder in ("a/color", "a/depth", "b/rgb", "b/depth", "b/pose"):
        (tmp_path / folder / name).write_bytes(b"\0\5\x16\7")
    assert_the_walk(open_source(tmp_path / "a"))
    assert_the_walk(open_source(tmp_path / "b"), stamps=False)


def test_a_row_may_name_its_image_instead_of_its_number(tmp_path):
    assert_the_walk(open_source(dataset(tmp_path, rows=["color/00000" + row.replace(",", ".PNG,", 1) for row in ROWS])))


def test_of_a_trajectory_faster_than_the_camera_the_rows_with_images_are_taken(tmp_path):
    others = [f"{i},{i * 1_000_000},0,0,0,0,0,0,1" for i in range(100, 1000)]
    source = open_source(dataset(tmp_path, rows=[*ROWS, *others]))
    assert_the_walk(source)
    assert "900 of 908 rows of trajectory.csv have no image: they are left out" in source.notes


def test_a_few_rows_without_images_are_counted_as_lost(tmp_path):
    dataset(tmp_path, rows=[*ROWS, "100,4000000000,0,0,0,0,0,0,1"])
    assert open_source(tmp_path).total == len(WALK) + 1


def test_half_precision_depth_has_no_warning(tmp_path, recwarn):
    dataset(tmp_path)
    for i, (_, _, depth) in enumerate(WALK):
        (tmp_path / f"depth/{i:06d}.png").unlink()
        (tmp_path / f"depth/{i:06d}.npy").write_bytes(npy((depth / 1000).astype(np.float16)))
    assert_the_walk(open_source(tmp_path), depth=False)
    assert not recwarn.list


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ([1, 2], "must be an object with width"),
        (None, "must be an object with width"),
        ({"camera": {}}, "it lacks width, height, fx, fy, cx, cy; it holds camera"),
        ({"width": 80, "height": 60, "K": []}, "it lacks fx, fy, cx, cy; it holds width, height, K"),
        ({"width": 80, "height": 60, "fx": 60, "fy": 60, "cx": 39.5, "cy": 29.5}, "lacks depth_scale_m: add it"),
    ],
)
def test_a_camera_that_is_none_is_told_without_the_programs_words(tmp_path, content, reason):
    (dataset(tmp_path) / "camera.json").write_text(json.dumps(content))
    with pytest.raises(SourceError, match=reason) as refused:
        open_source(tmp_path)
    assert not re.search(r"Error\(|subscriptable|indices", str(refused.value))


def test_columns_that_are_lacking_are_told_with_those_there_are(tmp_path):
    dataset(tmp_path)
    table = tmp_path / "trajectory.csv"
    table.write_text(table.read_text().replace("frame,stamp_ns", "id,timestamp"))
    with pytest.raises(SourceError, match="lacks the columns frame, stamp_ns; its first line is id, timestamp, x_m"):
        open_source(tmp_path)


def test_a_row_that_is_cut_off_says_which_number_is_lacking(tmp_path):
    dataset(tmp_path, rows=[row.rsplit(",", 1)[0] for row in ROWS])
    with pytest.raises(SourceError, match=r"its row of trajectory.csv is malformed: qw is ''"):
        open_source(tmp_path)


@pytest.mark.parametrize("content", ['"abc"', '{"K": "abc"}', "null", '{"K": {"data": [[1], [2, 3]]}}', "[1, 2]"])
def test_an_own_camera_that_is_none_is_one_sentence(tmp_path, content):
    own(tmp_path, intrinsics=False)
    (tmp_path / "camera.json").write_text(content)
    with pytest.raises(SourceError, match=r"camera.json is not a camera"):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda pose: np.diag((1.0, 1, -1, 1)) @ pose, "it mirrors"),
        (lambda pose: pose @ np.diag((2.0, 2, 2, 1)), "its axes are off by 100%"),
        (lambda pose: pose * np.nan, "not finite"),
    ],
)
def test_an_own_layout_whose_poses_are_none_is_refused_with_their_reason(tmp_path, change, reason):
    own(tmp_path, [(change(pose), color, depth) for pose, color, depth in WALK])
    with pytest.raises(SourceError, match=f"none of the poses of .* can be used: .*{reason}"):
        open_source(tmp_path)


def test_an_own_layout_without_one_pose_is_not_said_to_stand_still(tmp_path):
    own(tmp_path)
    for file in (tmp_path / "pose").iterdir():
        file.rename(file.with_suffix(".json"))
    with pytest.raises(SourceError, match=r"none of the poses of .* can be used: it has no pose file"):
        open_source(tmp_path)


@pytest.mark.parametrize("last", ["0 0 0", "0 0 nan", "0 1 1"])
def test_a_matrix_that_is_no_camera_of_a_scan_is_one_sentence(tmp_path, last):
    own(tmp_path, intrinsics=False)
    (tmp_path / "rgb").rename(tmp_path / "color")
    (tmp_path / "intrinsic").mkdir()
    for name in ("color", "depth"):
        (tmp_path / f"intrinsic/intrinsic_{name}.txt").write_text(f"60 0 39.5\n0 60 29.5\n{last}\n")
    with pytest.raises(SourceError, match="is not a camera matrix"):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("a.db3.zstd", "packed part of a ROS bag"),
        ("a.zip", "unpack it"),
        ("a.PLY", "geometry"),
        ("a.mp4", "film"),
        ("camera.json", "the folder"),
    ],
)
def test_a_file_that_is_no_recording_is_told_what_it_is(tmp_path, name, reason):
    (tmp_path / name).write_bytes(b"PK\3\4")
    with pytest.raises(SourceError, match=reason):
        open_source(tmp_path / name)


def test_a_folder_that_is_no_recording_is_told_what_it_lacks(tmp_path):
    for name in ("empty", "posed", "half"):
        (tmp_path / name).mkdir()
    for name in ("rgb", "depth"):
        (tmp_path / "posed" / name).mkdir()
    (tmp_path / "half/camera.json").write_text("{}")
    with pytest.raises(SourceError, match="empty folder"):
        open_source(tmp_path / "empty")
    with pytest.raises(SourceError, match=r"no folder of poses .*for each frame"):
        open_source(tmp_path / "posed")
    with pytest.raises(SourceError, match=r"it has camera.json but no trajectory.csv"):
        open_source(tmp_path / "half")
    dataset(tmp_path / "walk_b")
    with pytest.raises(SourceError, match="in it are sources, give one of them: walk_b"):
        open_source(tmp_path)


@pytest.mark.parametrize("number", [lambda i: i, lambda i: i + 1, lambda i: 10 * i])
def test_lines_of_a_replica_trajectory_belong_to_the_images_in_order(tmp_path, number):
    (tmp_path / "results").mkdir()
    np.savetxt(tmp_path / "traj.txt", [pose.ravel() for pose, _, _ in WALK])
    camera = {"w": 80, "h": 60, "fx": 60, "fy": 60, "cx": 39.5, "cy": 29.5, "scale": 1000}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    for i, (_, color, depth) in enumerate(WALK):
        (tmp_path / f"results/frame{number(i):06d}.png").write_bytes(png(color))
        (tmp_path / f"results/depth{number(i):06d}.png").write_bytes(png(depth))
    for frame, (pose, _, _) in zip(open_source(tmp_path), WALK, strict=True):
        np.testing.assert_allclose(frame.world_from_camera, pose, atol=1e-6)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("end", ["", ", .inf]", ", fy]"])
def test_a_list_in_brackets_that_is_none_is_one_sentence_at_once(tmp_path, end):
    own(tmp_path, intrinsics=False)
    numbers = "525.000000, 0.000000, 319.500000, 0.000000, 525.000000, 239.500000, 0.000000, 0.000000"
    (tmp_path / "camera.yaml").write_text(f"width: 80\nheight: 60\nK: [{numbers}{end}\n")
    with pytest.raises(SourceError, match=r"camera.yaml is not a camera: it has 10 numbers instead of a matrix"):
        open_source(tmp_path)


@pytest.mark.timeout(20)
def test_a_distortion_that_is_cut_off_is_not_left_out_in_silence(tmp_path):
    own(tmp_path, intrinsics=False)
    numbers = "fx: 60\nfy: 60\ncx: 39.5\ncy: 29.5\ndistortion_coefficients: [-0.28340811, 0.07395907, 0.0001"
    (tmp_path / "camera.yaml").write_text(f"width: 80\nheight: 60\n{numbers}")
    with pytest.raises(SourceError, match=r"camera.yaml is not a camera: its distortion is no list of numbers"):
        open_source(tmp_path)


def test_a_recording_that_lists_no_frame_and_has_no_stamps_has_none(tmp_path):
    (tmp_path / "associations.txt").touch()
    (tmp_path / "traj.gt.freiburg").write_text("1 0 0 0 0 0 0 1\n")
    assert open_source(tmp_path).total == 0
