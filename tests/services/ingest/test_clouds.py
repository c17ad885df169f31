"""Clouds of a lidar: files, times of points, upsampling along edges, folders of them and recordings of ROS."""

import functools
import json
import shutil
import struct

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.topics import ENCODE, KEYFRAME, PLACE_DELTA
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.ingest.core import selection
from prior_sg.services.ingest.core.clouds.files import columns_of
from prior_sg.services.ingest.core.clouds.sweep import CloudError, in_world, sweep_of
from prior_sg.services.ingest.core.clouds.upsampling import upsampled
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.clouds import LIVOX_TEXTS, columns_of_message
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from tests.help.bags import Maker
from tests.services.ingest.test_sources import ROBOT, cast, off_wall, shade

CAMERA = Intrinsics(width_px=120, height_px=90, fx_px=80.0, fy_px=80.0, cx_px=59.5, cy_px=44.5)
MATRIX = {"width": 120, "height": 90, "fx": 80.0, "fy": 80.0, "cx": 59.5, "cy": 44.5}
CAMERA_FROM_LIDAR = np.eye(4)
CAMERA_FROM_LIDAR[:3, :3] = ROBOT.as_matrix().T
CAMERA_FROM_LIDAR[:3, 3] = 0.02, 0.12, -0.05
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000


def moving(stamp_ns):
    """world_from_lidar of a robot that drives and turns: 1 m/s and 60 degrees/s."""
    seconds = (stamp_ns - START_NS) / 1e9
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 20 + 60 * seconds, degrees=True).as_matrix()
    pose[:3, 3] = 1.2 + seconds, 0.4, 1.2
    return pose


@functools.cache
def spin(stamp_ns, rings=32, columns=360):
    """Points (n, 3) in the lidar's frame of one turn, and ns after the stamp at which each was measured."""
    offsets = np.repeat((np.arange(columns) * PERIOD_NS) // columns, rings)
    azimuth = np.repeat(np.pi - 2 * np.pi * np.arange(columns) / columns, rings)
    elevation = np.tile(np.radians(np.linspace(-25, 25, rings)), columns)
    level = np.cos(elevation)
    directions = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=1)
    points = np.empty_like(directions)
    for offset in np.unique(offsets):
        at, pose = offsets == offset, moving(stamp_ns + int(offset))
        points[at] = directions[at] * cast(pose[:3, 3], directions[at] @ pose[:3, :3].T)[:, None]
    return points, offsets


def structured(points, **times):
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), *((name, values.dtype) for name, values in times.items())]
    rows = np.zeros(len(points), fields)
    for i, name in enumerate("xyz"):
        rows[name] = points[:, i]
    for name, values in times.items():
        rows[name] = values
    return rows


def pcd(rows, form="binary"):
    kinds = {"f": "F", "u": "U", "i": "I"}
    names = rows.dtype.names
    head = [
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {' '.join(names)}",
        "SIZE " + " ".join(str(rows.dtype[n].itemsize) for n in names),
        "TYPE " + " ".join(kinds[rows.dtype[n].kind] for n in names),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {len(rows)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(rows)}", f"DATA {form}", "",
    ]  # fmt: skip
    text = "\n".join(" ".join(repr(float(row[n])) for n in names) for row in rows).encode()
    return "\n".join(head).encode() + (rows.tobytes() if form == "binary" else text)


def npy(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, rows)


@pytest.mark.parametrize("form", ["binary", "ascii"])
def test_a_pcd_file_has_the_points_that_were_written(form):
    rows = structured(np.random.default_rng(0).normal(size=(50, 3)), t=np.arange(50, dtype=np.uint32))
    columns = columns_of(pcd(rows, form), ".pcd")
    assert np.allclose(columns["y"], rows["y"])
    assert columns["t"].tolist() == list(range(50))


@pytest.mark.parametrize("form", ["binary", "ascii"])
def test_a_field_of_several_numbers_moves_no_other(form):
    kind = [("normal", "f4", 3), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")]
    rows = np.array([((9, 8, 7), 1, 2, 3, 0), ((9, 8, 7), 4, 5, 6, 50_000_000)], kind)
    head = "FIELDS normal x y z t\nSIZE 4 4 4 4 4\nTYPE F F F F U\nCOUNT 3 1 1 1 1\nPOINTS 2\nDATA "
    text = b"9 8 7 1 2 3 0\n9 8 7 4 5 6 50000000\n"
    data = f"{head}{form}\n".encode() + (rows.tobytes() if form == "binary" else text)
    sweep = sweep_of(columns_of(data, ".pcd"), START_NS)
    assert sweep.points_lidar.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert sweep.offsets_ns.tolist() == [0, 50_000_000]  # whole numbers are nanoseconds, in a text too
    assert "normal" not in columns_of(data, ".pcd")


def test_a_cloud_of_no_points_and_whole_numbers_that_are_none_are_told():
    head = "FIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F U\nPOINTS {}\nDATA ascii\n{}"
    with pytest.raises(CloudError, match="it has 0 points"):
        columns_of(head.format(0, "").encode(), ".pcd")
    with pytest.raises(CloudError, match="its t is a whole number by its header"):
        columns_of(head.format(1, "1 2 3 nan\n").encode(), ".pcd")


def lzf(data):
    """LibLZF's form: what was seen in the last 8192 bytes as a reference, else as it is; each of up to 32 bytes."""
    out, literal, at = bytearray(), bytearray(), 0

    def flush():
        for start in range(0, len(literal), 32):
            part = literal[start : start + 32]
            out.extend((len(part) - 1, *part))
        literal.clear()

    while at < len(data):
        best, begin = 0, 0
        for start in range(max(0, at - 300), at):
            length = 0
            while at + length < len(data) and length < 264 and data[start + length] == data[at + length]:
                length += 1
            best, begin = max((best, begin), (length, start))
        if best < 3:
            literal.append(data[at])
            at += 1
            continue
        flush()
        back, more = at - begin - 1, best - 2
        out.extend(((min(more, 7) << 5) | back >> 8, *([more - 7] if more >= 7 else []), back & 255))
        at += best
    flush()
    return bytes(out)


def test_a_compressed_pcd_file_has_the_points_that_were_written():
    rows = structured(np.repeat(np.random.default_rng(4).normal(size=(6, 3)), 9, 0), t=np.arange(54, dtype=np.uint32))
    body = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
    held = lzf(body)
    head = pcd(rows[:0], "binary_compressed").replace(b"POINTS 0", b"POINTS 54").split(b"DATA")[0]
    whole = head + b"DATA binary_compressed\n" + struct.pack("<II", len(held), len(body)) + held
    columns = columns_of(whole, ".pcd")
    assert len(held) < 0.7 * len(body)
    assert all(np.array_equal(columns[name], rows[name]) for name in rows.dtype.names)
    random = np.random.default_rng(3)
    for _ in range(100):
        with pytest.raises(CloudError):
            columns_of(whole[: random.integers(0, len(whole))], ".pcd")


def test_rows_of_nuscenes_have_a_ring_and_those_of_kitti_none():
    random = np.random.default_rng(6)
    rows = random.normal(size=(40, 5)).astype("<f4")
    rows[:, 4] = np.arange(40) % 32
    nuscenes = columns_of(rows.tobytes(), ".bin")
    assert np.array_equal(nuscenes["z"], rows[:, 2]) and np.array_equal(nuscenes["ring"], rows[:, 4])
    kitti = columns_of(random.normal(size=(40, 4)).astype("<f4").tobytes(), ".bin")
    assert list(kitti) == ["x", "y", "z", "intensity"] and len(kitti["x"]) == 40
    assert len(columns_of(bytes(320), ".bin")["x"]) == 20


@pytest.mark.parametrize("form", ["binary", "ascii"])
def test_a_ply_file_of_trimesh_has_the_points_that_were_written(form):
    trimesh = pytest.importorskip("trimesh")
    points = np.random.default_rng(1).normal(size=(40, 3))
    data = trimesh.PointCloud(points).export(file_type="ply", encoding=form)
    columns = columns_of(data if isinstance(data, bytes) else data.encode(), ".ply")
    assert np.allclose(np.stack([columns[name] for name in "xyz"], axis=1), points, atol=1e-5)


@pytest.mark.parametrize("ending", [".npy", ".pcd", ".ply", ".bin"])
def test_damaged_clouds_are_told_in_a_sentence(ending, rounds=60):
    rows = structured(np.random.default_rng(2).normal(size=(20, 3)), t=np.arange(20, dtype=np.uint32))
    whole = {
        ".npy": b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f4', 'fortran_order': False, 'shape': (20, 3), }".ljust(117)
        + b"\n" + np.zeros(60, "<f4").tobytes(),
        ".pcd": pcd(rows),
        ".ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 20\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n" + bytes(240),
        ".bin": bytes(320),
    }[ending]  # fmt: skip
    columns_of(whole, ending)
    random = np.random.default_rng(3)
    for _ in range(rounds):
        data = bytearray(whole[: random.integers(0, len(whole) + 1)])
        for _ in range(int(random.integers(0, 4))):
            if data:
                data[random.integers(len(data))] = random.integers(256)
        try:
            sweep_of(columns_of(bytes(data), ending), START_NS)
        except CloudError as error:
            assert len(str(error)) > 10
    with pytest.raises(CloudError):
        columns_of(whole[:100], ".pcd" if ending == ".bin" else ending)


@pytest.mark.parametrize(
    "times",
    [
        lambda offsets: ("t", offsets.astype(np.uint32)),  # Ouster: ns after the stamp
        lambda offsets: ("time", (offsets / 1e9).astype(np.float32)),  # Velodyne: s after the stamp
        lambda offsets: ("timestamp", START_NS / 1e9 + offsets / 1e9),  # RoboSense, Hesai: s since 1970
        lambda offsets: ("timestamp", (START_NS + offsets).astype(np.float64)),  # Livox: ns since 1970
        lambda offsets: ("offset_time", offsets.astype(np.uint32)),  # Livox' own message
    ],
)
def test_points_are_put_where_the_lidar_was_when_it_measured_them(times):
    points, offsets = spin(START_NS)
    name, values = times(offsets)
    sweep = sweep_of(structured_columns(points, name, values), START_NS)
    assert off_wall(in_world(sweep, START_NS, moving)).max() < 0.01
    still = sweep_of(structured_columns(points), START_NS)
    assert off_wall(in_world(still, START_NS, moving)).max() > 0.1


def structured_columns(points, name="", values=None):
    columns = {axis: points[:, i] for i, axis in enumerate("xyz")}
    return columns | ({name: values} if name else {})


def test_times_that_are_no_times_are_told():
    columns = structured_columns(np.ones((4, 3)))
    with pytest.raises(CloudError, match="measured up to"):
        sweep_of(columns | {"time": np.array((0.0, 1.0, 2.0, 30.0))}, START_NS)
    with pytest.raises(CloudError, match="no numbers"):
        sweep_of(columns | {"time": np.array((0.0, np.nan, 2.0, 1.0))}, START_NS)
    with pytest.raises(CloudError, match="lack z"):
        sweep_of({"x": np.ones(3), "y": np.ones(3)}, START_NS)


def test_a_plane_between_rings_comes_out_as_a_plane():
    """A floor 1 m below the camera, seen along five lines: a plain average makes stairs of it."""
    v, u = np.indices((CAMERA.height_px, CAMERA.width_px))
    floor_m = np.where(v > 50, CAMERA.fy_px / np.maximum(v - CAMERA.cy_px, 1e-9), 0)
    lines = np.isin(v, (52, 60, 68, 76, 84))
    points = np.stack(((u - 59.5) / 80 * floor_m, (v - 44.5) / 80 * floor_m, floor_m), axis=-1)[lines]
    depth_m = upsampled(points, CAMERA, np.zeros((90, 120, 3), np.uint8))
    between = (v > 54) & (v < 84)
    assert (depth_m[between] > 0).mean() > 0.98
    assert np.abs(depth_m - floor_m)[between & (depth_m > 0)].max() < 0.02
    assert not depth_m[:40].any()


def test_depth_between_two_surfaces_follows_the_edge_of_the_picture():
    v, u = np.indices((CAMERA.height_px, CAMERA.width_px))
    left = u < 63
    surface_m = np.where(left, 2.0, 4.0)
    picture = np.where(left, 40, 200).astype(np.uint8)
    seen = (v % 8 == 3) & (u % 10 == 0)
    points = np.stack(((u - 59.5) / 80 * surface_m, (v - 44.5) / 80 * surface_m, surface_m), axis=-1)[seen]
    depth_m = upsampled(points, CAMERA, picture)
    inner = (slice(8, 80), slice(12, 108))
    kept = depth_m[inner] > 0
    assert kept.mean() > 0.97
    assert (np.abs(depth_m - surface_m)[inner][kept] > 0.1).mean() < 0.01


def test_points_behind_a_nearer_surface_do_not_shine_through():
    v, u = np.indices((CAMERA.height_px, CAMERA.width_px))
    near, far = (v % 6 == 0) & (u % 3 == 0), (v % 6 == 3) & (u % 9 == 4) & (u > 30) & (u < 90)
    depths = np.where(near, 2.0, np.where(far, 5.0, 0.0))
    points = np.stack(((u - 59.5) / 80 * depths, (v - 44.5) / 80 * depths, depths), axis=-1)[near | far]
    depth_m = upsampled(points, CAMERA, np.zeros((90, 120), np.uint8))
    assert depth_m.max() < 2.5


# Folders.


def folder(path, pictures=True, sweeps=4, ending=".npy", fov_deg=360.0):
    """A robot that drives and turns: a turn of the lidar every 100 ms, poses at 50 Hz, pictures at 20 Hz."""
    for index in range(sweeps):
        stamp = START_NS + index * PERIOD_NS
        points, offsets = spin(stamp)
        ahead = np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))) <= fov_deg / 2
        rows = structured(points[ahead], t=offsets[ahead].astype(np.uint32))
        file = path / "lidar" / f"{stamp / 1e9:.6f}{ending}"
        npy(file, rows) if ending == ".npy" else (
            file.parent.mkdir(parents=True, exist_ok=True),
            file.write_bytes(pcd(rows)),
        )
    stamps = range(START_NS - PERIOD_NS, START_NS + (sweeps + 1) * PERIOD_NS, PERIOD_NS // 5)
    rows = [
        f"{stamp / 1e9:.6f} "
        + " ".join(f"{v:.9f}" for v in (*moving(stamp)[:3, 3], *Rotation.from_matrix(moving(stamp)[:3, :3]).as_quat()))
        for stamp in stamps
    ]
    (path / "poses.txt").write_text("\n".join(rows) + "\n")
    if pictures:
        (path / "color").mkdir()
        said = {"camera": MATRIX, "camera_from_lidar": CAMERA_FROM_LIDAR.tolist()}
        (path / "lidar.json").write_text(json.dumps(said))
        for stamp in range(START_NS + 30_000_000, START_NS + (sweeps - 1) * PERIOD_NS, PERIOD_NS // 2):
            pose = moving(stamp) @ inverse(CAMERA_FROM_LIDAR)
            v, u = np.indices((90, 120))
            rays = np.stack(((u - 59.5) / 80, (v - 44.5) / 80, np.ones((90, 120))), axis=-1) @ pose[:3, :3].T
            picture = shade(pose[:3, 3] + cast(pose[:3, 3], rays)[..., None] * rays)
            cv2.imwrite(str(path / "color" / f"{stamp / 1e9:.6f}.png"), picture)
    return path


def points_world(frame):
    """Points of a frame's depth image, in the world."""
    depth_m = cv2.imdecode(np.frombuffer(frame.depth, np.uint8), cv2.IMREAD_UNCHANGED) * frame.depth_scale_m
    v, u = np.nonzero(depth_m)
    of, z = frame.intrinsics, depth_m[v, u]
    points = np.stack(((u - of.cx_px) / of.fx_px * z, (v - of.cy_px) / of.fy_px * z, z), axis=1)
    return transform(frame.world_from_camera, points), len(z) / depth_m.size


@pytest.mark.parametrize("ending", [".npy", ".pcd"])
def test_a_spinning_lidar_on_a_turning_robot_gives_depth_on_the_walls(tmp_path, ending):
    source = open_source(folder(tmp_path / "d", ending=ending))
    frames = [frame for frame in source if isinstance(frame, RawFrame)]
    assert source.layout == "lidar"
    assert len(frames) == 4
    for frame in frames:
        points, share = points_world(frame)
        off_m = off_wall(points)
        assert share > 0.6  # the lidar sees 50 of the camera's 59 degrees
        assert (off_m < 0.05).mean() > 0.97
        assert len(frame.color) > 100


def test_without_the_times_of_points_the_walls_bend(tmp_path, kept):
    path = shutil.copytree(kept, tmp_path / "d")
    for file in (path / "lidar").iterdir():
        rows = np.load(file)
        np.save(file, np.stack([rows[name] for name in "xyz"], axis=1))
    frames = [frame for frame in open_source(path) if isinstance(frame, RawFrame)]
    assert max((off_wall(points_world(frame)[0]) > 0.05).mean() for frame in frames) > 0.1


@pytest.mark.parametrize(("fov_deg", "views"), [(360.0, 4), (80.0, 1)])  # spinning and solid-state
def test_a_lidar_without_a_camera_is_seen_from_where_it_was(tmp_path, fov_deg, views):
    source = open_source(folder(tmp_path / "d", pictures=False, fov_deg=fov_deg))
    frames = [frame for frame in source if isinstance(frame, RawFrame)]
    assert any(f"in {views} views" in note for note in source.notes), source.notes
    assert len(frames) == views * 2  # it turns 18 degrees in 300 ms, and moves 0.3 m
    for frame in frames:
        points, share = points_world(frame)
        assert frame.color == b""
        assert share > 0.4
        assert (off_wall(points) < 0.05).mean() > 0.95


def test_a_lidar_without_a_camera_gives_places_and_nothing_to_encode(tmp_path):
    frames = list(open_source(folder(tmp_path / "d", pictures=False)))
    place_graph, ingest = Runner(BY_NAME["place_graph"]), selection.State(robot="robot1")
    told = [one for frame in frames for one in selection.accept(ingest, frame, Config())]
    keyframes = [message for topic, message in told if topic is KEYFRAME]
    assert len(keyframes) == len(frames)
    assert not [topic for topic, _ in told if topic is ENCODE]
    assert not ingest.encoding
    deltas = [
        message for keyframe in keyframes for topic, message in place_graph.feed(keyframe) if topic is PLACE_DELTA
    ]
    ids = {place for delta in deltas for place in delta.place_ids.tolist()}
    assert len(ids) > 20


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return folder(tmp_path_factory.mktemp("clouds") / "d")


def damage_json(path):
    (path / "lidar.json").write_text('{"camera": {}}')


def damage_motion(path):
    said = json.loads((path / "lidar.json").read_text())
    (path / "lidar.json").write_text(json.dumps(said | {"camera_from_lidar": [[1, 2], [3, 4]]}))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (damage_json, "camera_from_lidar"),
        (damage_motion, "is not a motion"),
        (lambda path: (path / "lidar.json").unlink(), "put camera and camera_from_lidar"),
        (lambda path: (path / "poses.txt").unlink(), "no list of poses with stamps"),
        (lambda path: (path / "poses.txt").write_text("1 2 3\n"), "no list of poses"),
        (lambda path: [f.write_bytes(b"\x93NUMPY") for f in (path / "lidar").iterdir()], "damaged"),
        (lambda path: [f.unlink() for f in (path / "color").iterdir()], "holds none of"),
    ],
)
def test_what_is_missing_in_a_folder_of_clouds_is_told(tmp_path, kept, damage, said):
    path = shutil.copytree(kept, tmp_path / "d")
    damage(path)
    with pytest.raises(SourceError, match=said):
        list(open_source(path))


# Recordings of ROS.


def cloud(maker, stamp_ns, rows, frame="lidar"):
    """A PointCloud2 of a structured array."""
    kinds = {"f4": 7, "f8": 8, "u4": 6, "u2": 4}
    field = maker.types["sensor_msgs/msg/PointField"]
    fields = [field(n, rows.dtype.fields[n][1], kinds[rows.dtype[n].str[1:]], 1) for n in rows.dtype.names]
    size = rows.dtype.itemsize
    data = np.frombuffer(rows.tobytes(), np.uint8)
    header = maker.header(stamp_ns, frame)
    return maker.types["sensor_msgs/msg/PointCloud2"](
        header, 1, len(rows), fields, False, size, size * len(rows), data, True
    )


def livox(maker, stamp_ns, rows, frame="lidar"):
    """Livox' own message of a structured array."""
    package = "livox_ros_driver" if maker.kind == "bag" else "livox_ros_driver2"
    for name in ("CustomPoint", "CustomMsg"):
        if f"{package}/msg/{name}" not in maker.types:
            maker.store.register(get_types_from_msg(LIVOX_TEXTS[name], f"{package}/msg/{name}"))
    point = maker.types[f"{package}/msg/CustomPoint"]
    points = [point(int(r["t"]), float(r["x"]), float(r["y"]), float(r["z"]), 9, 16, 1) for r in rows]
    made, reserved = maker.types[f"{package}/msg/CustomMsg"], np.zeros(3, np.uint8)
    return made(maker.header(stamp_ns, frame), stamp_ns, len(points), 1, reserved, points)


def bag(path, kind="sqlite3", **how):
    return driven(kind, **how).write(path)


def driven(kind="sqlite3", pictures=True, depth=False, change=lambda rows: rows, message=cloud):
    """The robot of the folder, as its drivers publish it."""
    maker = Maker(kind)
    for index in range(4):
        stamp = START_NS + index * PERIOD_NS
        points, offsets = spin(stamp)
        rows = change(structured(points, t=offsets.astype(np.uint32)))
        maker.add("/points", stamp, message(maker, stamp, rows), 10**8)
    for stamp in range(START_NS - PERIOD_NS, START_NS + 5 * PERIOD_NS, PERIOD_NS // 5):
        maker.add("/tf", stamp, maker.tf(maker.transform(stamp, "map", "lidar", moving(stamp))))
    lidar_from_camera = maker.transform(START_NS, "lidar", "camera", inverse(CAMERA_FROM_LIDAR))
    maker.add("/tf_static", START_NS, maker.tf(lidar_from_camera))
    for stamp in range(START_NS + 30_000_000, START_NS + 3 * PERIOD_NS, PERIOD_NS // 2) if pictures else ():
        pose = moving(stamp) @ inverse(CAMERA_FROM_LIDAR)
        v, u = np.indices((90, 120))
        rays = np.stack(((u - 59.5) / 80, (v - 44.5) / 80, np.ones((90, 120))), axis=-1) @ pose[:3, :3].T
        depth_m = cast(pose[:3, 3], rays)
        picture = shade(pose[:3, 3] + depth_m[..., None] * rays)
        maker.add("/camera/image_raw", stamp, maker.image(stamp, picture, "bgr8", "camera"))
        maker.add("/camera/camera_info", stamp, maker.info(stamp, CAMERA, "camera"))
        if depth:
            units = np.rint(depth_m * 1000).astype(np.uint16)
            maker.add("/camera/depth", stamp, maker.image(stamp, units, "16UC1", "camera"))
    return maker


@pytest.mark.parametrize(
    ("kind", "pictures", "message"),
    [
        ("sqlite3", True, cloud),
        ("bag", True, cloud),
        ("mcap", False, cloud),
        ("bag", False, livox),
        ("sqlite3", True, livox),
    ],
)
def test_clouds_of_a_recording_are_depth_on_the_walls(tmp_path, kind, pictures, message):
    source = open_source(bag(tmp_path, kind, pictures=pictures, message=message))
    frames = [frame for frame in source if isinstance(frame, RawFrame)]
    assert source.layout == "ros"
    assert any("depth of /points" in note for note in source.notes), source.notes
    assert len(frames) == (4 if pictures else 8)
    for frame in frames:
        points, share = points_world(frame)
        assert bool(frame.color) is pictures
        assert share > 0.4
        assert (off_wall(points) < 0.05).mean() > 0.95


def test_depth_images_go_before_clouds_unless_these_are_named(tmp_path):
    path = bag(tmp_path, depth=True)
    assert len([frame for frame in open_source(path) if isinstance(frame, RawFrame)]) == 6
    source = open_source(path, options=ReadOptions(depth_topic="/points"))
    assert any("depth of /points" in note for note in source.notes)


def test_clouds_without_stamps_say_which_option_reads_them(tmp_path, monkeypatch):
    header = Maker.header
    monkeypatch.setattr(Maker, "header", lambda maker, stamp_ns, frame: header(maker, 0, frame))
    with pytest.raises(SourceError, match="headers of /points have no stamps; give --clock received"):
        open_source(bag(tmp_path, pictures=False))


def swapped(rows):
    """Bytes of points that end in the middle of a field."""
    return rows[["x", "y"]]


@pytest.mark.parametrize(("change", "said"), [(swapped, "lack z"), (lambda rows: rows[:0], "0 x 1|1 x 0|points")])
def test_damaged_clouds_of_a_recording_are_told(tmp_path, change, said):
    with pytest.raises(SourceError, match=said):
        list(open_source(bag(tmp_path, change=lambda rows: np.ascontiguousarray(change(rows)))))


def test_mutated_cloud_messages_are_read_or_refused(rounds=300):
    maker, random = Maker("sqlite3"), np.random.default_rng(5)
    points, offsets = spin(START_NS)
    message = cloud(maker, START_NS, structured(points[:50], t=offsets[:50].astype(np.uint32)))
    whole = bytes(maker.store.serialize_cdr(message, message.__msgtype__))
    for _ in range(rounds):
        data = bytearray(whole[: random.integers(20, len(whole) + 1)] if random.random() < 0.3 else whole)
        for _ in range(int(random.integers(1, 6))):
            data[random.integers(4, len(data))] = random.integers(256)
        try:
            mutated = maker.store.deserialize_cdr(bytes(data), message.__msgtype__)
        except Exception:
            continue  # rosbags raises nearly everything; the bag tells it
        try:
            sweep_of(columns_of_message(mutated), START_NS)
        except CloudError as error:
            assert len(str(error)) > 10


def test_views_are_level_and_look_around():
    from prior_sg.services.ingest.core.clouds.views import lidar_from_views

    ahead = [view[:3, 2].round().tolist() for view in lidar_from_views()]
    assert ahead == [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    assert all(view[:3, 1].round().tolist() == [0, 0, -1] for view in lidar_from_views())
