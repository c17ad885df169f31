"""What apps and programs for mapping export comes out as the walk that was written in their form, or is told."""

import json
import shutil
import struct
import sys
import zipfile
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prior_sg.deploy.inspecting.check import check
from prior_sg.services.geometry import back_project, transform
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.ingest.sources.base import FrameError
from prior_sg.services.ingest.sources.exports.film import Film
from prior_sg.services.runtime.extras import ExtraMissing
from tests.services.ingest.test_pose_lists import bare, redwood
from tests.services.ingest.test_sources import off_wall
from tests.services.ingest.test_sources_reading import FRAMES, OPENGL, WALK, assert_the_walk, decoded, jpg, png

ARKIT = np.array(((1.0, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)))  # y up, from z up
MATRIX = np.array(((60.0, 0, 39.5), (0, 60.0, 29.5), (0, 0, 1)))
FINE = np.array(((240.0, 0, 159.5), (0, 240.0, 119.5), (0, 0, 1)))  # the same view with four times as many pixels


def fine(color):
    return cv2.resize(color, (320, 240), interpolation=cv2.INTER_NEAREST)


def seven(matrix, first="position"):
    position, turn = matrix[:3, 3].tolist(), Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    return position + turn if first == "position" else turn + position


def assert_a_phone_s_walk(source):
    """Poses to the last digits, every point on a wall, and pictures finer than the depth that was measured."""
    frames = list(source)
    assert [type(frame) for frame in frames] == [RawFrame] * FRAMES, frames
    assert source.intrinsics.width_px == 240
    for frame, (pose, color, _) in zip(frames, WALK, strict=True):
        np.testing.assert_allclose(frame.world_from_camera, pose, atol=1e-6)
        depth_m = decoded(frame.depth) * frame.depth_scale_m
        points = transform(pose, back_project(depth_m, source.intrinsics)[1::3, 1::3][:, 10:].reshape(-1, 3))
        assert off_wall(points).max() < 0.005
        assert not depth_m[:, :24].any()  # low confidence
        picture = decoded(frame.color)[1::3, 1::3].astype(int)
        assert np.median(np.abs(picture - color)) < 12


def unsure():
    """Confidence of a depth image: low at the left."""
    confidence = np.full((60, 80), 2, np.uint8)
    confidence[:, :8] = 0
    return confidence


def stray_scanner(path):
    for name in ("depth", "confidence"):
        (path / name).mkdir(parents=True)
    film = cv2.VideoWriter(str(path / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, (320, 240))
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, (pose, color, depth) in enumerate(WALK):
        film.write(fine(color))
        (path / f"depth/{i:06d}.png").write_bytes(png(depth))
        (path / f"confidence/{i:06d}.png").write_bytes(png(unsure()))
        lines.append(", ".join((f"{4000 + 0.4 * i:.6f}", f"{i:06d}", *(f"{v:.9f}" for v in seven(ARKIT @ pose)))))
    film.release()
    (path / "odometry.csv").write_text("\n".join(lines) + "\n")
    np.savetxt(path / "camera_matrix.csv", FINE, delimiter=", ")
    return path


def record3d(path, packed=True, compress=None):
    lzfse = sys.modules.get("lzfse")
    compress = compress or lzfse.compress
    said = {
        "w": 320, "h": 240, "dw": 80, "dh": 60, "fps": 60, "K": FINE.T.ravel().tolist(),
        "frameTimestamps": [100 + 0.4 * i for i in range(FRAMES)],
        "poses": [seven(ARKIT @ pose @ OPENGL, "turn") for pose, _, _ in WALK],
    }  # fmt: skip
    files = {"metadata": json.dumps(said).encode()}
    for i, (_, color, depth) in enumerate(WALK):
        files[f"rgbd/{i}.jpg"] = jpg(fine(color), cv2.IMWRITE_JPEG_QUALITY, 98)
        files[f"rgbd/{i}.depth"] = compress((depth / 1000).astype("<f4").tobytes())
        files[f"rgbd/{i}.conf"] = compress(unsure().tobytes())
    if packed:
        with zipfile.ZipFile(path.with_suffix(".r3d"), "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
        return path.with_suffix(".r3d")
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)
    return path


@pytest.fixture
def unpacks(monkeypatch):
    """The real package where it is installed; else one of ours that keeps what LZFSE compresses as it is."""
    try:
        import lzfse  # noqa: F401
    except ModuleNotFoundError:
        import importlib.machinery
        import types
        import zlib

        fake = types.ModuleType("lzfse")
        fake.__spec__ = importlib.machinery.ModuleSpec("lzfse", None)
        fake.compress, fake.decompress, fake.error = zlib.compress, zlib.decompress, zlib.error
        monkeypatch.setitem(sys.modules, "lzfse", fake)


def rtabmap(path, ids=False, poses="camera_poses", form=11):
    for part in ("rgb", "depth", "calib"):
        (path / f"map_{part}").mkdir(parents=True)
    body_from_camera = np.array(((0.0, 0, 1, 0.1), (-1, 0, 0, 0), (0, -1, 0, 0.3), (0, 0, 0, 1)))
    rows = ["#timestamp x y z qx qy qz qw id"] if form == 11 else []
    for i, (pose, color, depth) in enumerate(WALK):
        stamp = f"{1_700_000_000 + 0.4 * i:.6f}"
        name = str(i + 3) if ids else stamp
        (path / f"map_rgb/{name}.jpg").write_bytes(png(color))
        (path / f"map_depth/{name}.png").write_bytes(png(depth))
        storage = cv2.FileStorage(str(path / f"map_calib/{name}.yaml"), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_name", name)
        storage.write("image_width", 80)
        storage.write("image_height", 60)
        for key, values in (("camera_matrix", MATRIX), ("distortion_coefficients", np.zeros((1, 5)))):
            storage.startWriteStruct(key, cv2.FileNode_MAP)
            storage.write("rows", values.shape[0])
            storage.write("cols", values.shape[1])
            storage.startWriteStruct("data", cv2.FileNode_SEQ | cv2.FileNode_FLOW)
            for value in values.ravel():
                storage.write("", float(value))
            storage.endWriteStruct()
            storage.endWriteStruct()
        storage.release()
        local = ", ".join(f"{v:.9f}" for v in body_from_camera[:3].ravel())
        text = (path / f"map_calib/{name}.yaml").read_text()
        told = f"distortion_model: plumb_bob\nlocal_transform:\n   rows: 3\n   cols: 4\n   data: [ {local} ]\n"
        (path / f"map_calib/{name}.yaml").write_text(text + told)
        written = pose if poses == "camera_poses" else pose @ np.linalg.inv(body_from_camera)
        numbers = seven(written) if form else written[:3].ravel()
        words = [f"{v:.9f}" for v in numbers]
        rows.append(" ".join((*([stamp] if form else []), *words, *([str(i + 3)] if form == 11 else []))))
    (path / f"map_{poses}.txt").write_text("\n".join(rows) + "\n")
    return path


def colmap_binary(path):
    bare(path, images="images")
    (path / "sparse/0").mkdir(parents=True)
    cameras = struct.pack("<Q", 1) + struct.pack("<iiQQ4d", 1, 1, 80, 60, 60.0, 60.0, 39.5, 29.5)
    images = struct.pack("<Q", FRAMES)
    for i, (pose, _, _) in enumerate(WALK):
        camera_from_world = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(camera_from_world[:3, :3]).as_quat()
        images += (
            struct.pack("<i7di", i + 1, w, x, y, z, *camera_from_world[:3, 3], 1) + f"{i:06d}.png".encode() + b"\0"
        )
        images += struct.pack("<Q", i) + struct.pack("<ddq", 1.5, 2.5, -1) * i
    (path / "sparse/0/cameras.bin").write_bytes(cameras)
    (path / "sparse/0/images.bin").write_bytes(images)
    return path


def open3d(path, form="log"):
    bare(path, images="color")
    said = {"width": 80, "height": 60, "intrinsic_matrix": MATRIX.T.ravel().tolist()}
    if form == "log":
        (path / "scene").mkdir()
        redwood(path / "scene/trajectory.log")
        (path / "camera_intrinsic.json").write_text(json.dumps(said))
        return path
    parameters = [
        {
            "class_name": "PinholeCameraParameters",
            "extrinsic": np.linalg.inv(pose).T.ravel().tolist(),
            "intrinsic": said,
        }
        for pose, _, _ in WALK
    ]
    content = {"class_name": "PinholeCameraTrajectory", "parameters": parameters}
    (path / "camera_trajectory.json").write_text(json.dumps(content))
    return path


def test_a_dataset_of_stray_scanner_is_the_walk(tmp_path):
    source = open_source(stray_scanner(tmp_path / "71de12f9"))
    assert source.layout == "stray-scanner"
    assert_a_phone_s_walk(source)
    assert_a_phone_s_walk(source)  # the film is begun again


@pytest.mark.parametrize("packed", [True, False])
def test_a_recording_of_record3d_is_the_walk(tmp_path, unpacks, packed):
    source = open_source(record3d(tmp_path / "walk", packed))
    assert source.layout == "record3d"
    assert_a_phone_s_walk(source)


def test_pictures_after_a_damaged_one_are_those_that_were_asked_for(written, monkeypatch):
    film = Film(written("stray-scanner") / "rgb.mp4")
    expected = film.picture(3)
    film.picture(0)
    with monkeypatch.context() as damaged:
        damaged.setattr(film, "_film", Mock(grab=lambda: False))
        with pytest.raises(FrameError, match="before picture 2"):
            film.picture(2)
    np.testing.assert_array_equal(film.picture(3), expected)


@pytest.mark.parametrize("name", ["stray-scanner", "rtabmap"])
def test_a_rate_that_is_told_counts_in_place_of_an_export_s_stamps(written, name):
    source = open_source(written(name), options=ReadOptions(rate_hz=2.0))
    assert [frame.stamp_ns for frame in source] == [i * 500_000_000 for i in range(FRAMES)]


@pytest.mark.parametrize("stamp", ["Infinity", '"late"'])
def test_stamps_of_record3d_that_are_none_are_told(tmp_path, unpacks, stamp):
    path = record3d(tmp_path / "d", packed=False)
    said = (path / "metadata").read_text()
    (path / "metadata").write_text(said.replace('"frameTimestamps": [100.0', f'"frameTimestamps": [{stamp}'))
    assert stamp in (path / "metadata").read_text()
    with pytest.raises(SourceError, match="has no metadata of Record3D"):
        open_source(path)


def test_without_lzfse_record3d_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lzfse", None)
    monkeypatch.setattr("prior_sg.services.runtime.extras.find_spec", lambda name: None if name == "lzfse" else name)
    with pytest.raises(ExtraMissing, match=r"prior-sg\[record3d\]"):
        open_source(record3d(tmp_path / "walk", compress=bytes))


@pytest.mark.parametrize(
    "form",
    [
        {}, {"ids": True}, {"poses": "poses"}, {"poses": "poses", "ids": True}, {"form": 10}, {"form": 0, "ids": True},
    ],
)  # fmt: skip
def test_an_export_of_rtabmap_is_the_walk(tmp_path, form):
    source = open_source(rtabmap(tmp_path / "d", **form))
    assert source.layout == "rtabmap"
    assert_the_walk(source, stamps=not form.get("ids"))


@pytest.mark.parametrize("write", [colmap_binary, open3d, lambda path: open3d(path, "json")])
def test_poses_of_programs_are_the_walk(tmp_path, write):
    source = open_source(write(tmp_path / "d"))
    assert source.intrinsics.fx_px == 60
    assert_the_walk(source, stamps=False)


WRITERS = {
    "stray-scanner": stray_scanner,
    "record3d": lambda path: record3d(path, packed=False),
    "rtabmap": rtabmap,
    "colmap": colmap_binary,
    "open3d": lambda path: open3d(path, "json"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """One export of each kind, by name; made when asked for."""
    made = {}

    def of(name):
        if name not in made:
            made[name] = WRITERS[name](tmp_path_factory.mktemp(name) / "d")
        return made[name]

    return of


@pytest.mark.parametrize("name", WRITERS)
def test_exports_damaged_by_hand_give_a_result_or_a_sentence(tmp_path, unpacks, written, name, rounds=12):
    """Files cut off, emptied, mutated and gone, one at a time."""
    whole = written(name)
    random = np.random.default_rng(7)
    files = sorted(file.relative_to(whole) for file in whole.rglob("*") if file.is_file())
    few = [
        f
        for i, f in enumerate(files)
        if len(f.parts) == 1 or not i or files[i - 1].parent != f.parent or ".bin" in f.name
    ]
    for round_ in range(rounds):
        path = shutil.copytree(whole, tmp_path / str(round_))
        file = path / few[round_ % len(few)]
        data = bytearray(file.read_bytes())
        match int(random.integers(4)):
            case 0:
                file.unlink()
            case 1:
                file.write_bytes(data[: random.integers(len(data))])
            case 2:
                file.write_bytes(b"")
            case _:
                for _ in range(8):
                    data[random.integers(len(data))] = random.integers(256)
                file.write_bytes(data)
        try:
            frames = list(open_source(path))
        except SourceError as error:
            assert 15 < len(str(error).replace(str(path), "")) < 1500
            assert "\n" not in str(error)
        else:
            assert all(isinstance(frame, RawFrame | BadFrame) for frame in frames)


@pytest.mark.timeout(20)
def test_a_transform_that_is_cut_off_is_told_at_once(tmp_path, written):
    path = shutil.copytree(written("rtabmap"), tmp_path / "d")
    (path / "map_camera_poses.txt").rename(path / "map_poses.txt")
    for file in (path / "map_calib").iterdir():
        file.write_text(file.read_text().rpartition("]")[0])
    with pytest.raises(SourceError, match="has no local_transform of 3 x 4 numbers"):
        open_source(path)


@pytest.mark.parametrize("name", ["rtabmap", "stray-scanner"])
def test_check_understands_an_export(written, name):
    report = check(open_source(written(name)), Config(), brief=True)
    assert report.layout == name
    assert not [finding for finding in report.problems if finding.topic in ("poses", "depth unit")], report.findings
