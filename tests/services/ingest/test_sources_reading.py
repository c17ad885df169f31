"""Recordings as people write them: every kind of oddity must come out as the undisturbed recording, or be refused.

The recording is a walk through a room with a box, drawn by rays, so that wrong poses, units or sizes contradict depth.
"""

import json

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from prior_sg.deploy.inspecting.beside import truth_beside
from prior_sg.deploy.inspecting.check import check
from prior_sg.deploy.sample.packed import pack_source
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.headers import ImageError, image_size, trimmed
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import PoseError, rigid
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.ingest.sources.tables import NS_PER, order_of, stamps_ns
from tests.services.ingest.test_sources import render, view

FRAMES = 8
CAMERA = Intrinsics(80, 60, 60.0, 60.0, 39.5, 29.5)
FAST = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def rays_of(camera):
    v, u = np.indices((camera.height_px, camera.width_px))
    return np.stack(((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones(u.shape)), axis=-1)


def walk(camera=CAMERA):
    """Poses, colour and depth (millimetres) of a walk, turning all the while."""
    frames = []
    for i in range(FRAMES):
        pose = view(1.2 + 0.15 * i, 0.3 + 0.1 * i, 1.4 + 0.05 * i, 20 + 9 * i, 10 - 3 * i, 4)
        depth_m, color = render(pose, rays_of(camera))
        frames.append((pose, color, np.rint(depth_m * 1000).astype(np.uint16)))
    return frames


WALK = walk()


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


def jpg(image, *settings_):
    return cv2.imencode(".jpg", image, list(settings_))[1].tobytes()


def rows_of(poses, stamps=None):
    stamps = [f"{i * 400_000_000}" for i in range(len(poses))] if stamps is None else stamps
    rows = []
    for i, pose in enumerate(poses):
        words = [f"{v:.9f}" for v in (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat())]
        rows.append(",".join((str(i), stamps[i], *words)))
    return rows


HEAD = "frame,stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw"


def dataset(path, frames=WALK, rows=None, camera=CAMERA, **fields):
    for name in ("color", "depth"):
        (path / name).mkdir(parents=True, exist_ok=True)
    described = {
        "width": camera.width_px,
        "height": camera.height_px,
        "fx": camera.fx_px,
        "fy": camera.fy_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
        "depth_scale_m": 0.001,
    }
    (path / "camera.json").write_text(json.dumps(described | fields))
    rows = rows_of([pose for pose, _, _ in frames]) if rows is None else rows
    (path / "trajectory.csv").write_bytes(("\n".join((HEAD, *rows)) + "\n").encode())
    for i, (_, color, depth) in enumerate(frames):
        (path / f"color/{i:06d}.png").write_bytes(png(color))
        (path / f"depth/{i:06d}.png").write_bytes(png(depth))
    return path


def decoded(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def assert_the_walk(source, stamps=True, depth=True, atol=1e-6):
    frames = list(source)
    assert [type(frame) for frame in frames] == [RawFrame] * FRAMES, frames
    assert [frame.frame_id for frame in frames] == list(range(FRAMES))
    if stamps:
        spacing = np.diff([frame.stamp_ns for frame in frames])
        assert np.abs(spacing - 400_000_000).max() <= 256  # what a float of nanoseconds since 1970 can hold
    for frame, (pose, color, depth_mm) in zip(frames, WALK, strict=True):
        np.testing.assert_allclose(frame.world_from_camera, pose, atol=atol)
        if depth:
            np.testing.assert_array_equal(decoded(frame.depth) * frame.depth_scale_m, depth_mm * 0.001)
            np.testing.assert_array_equal(decoded(frame.color), color)
    return frames


# Tables.


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return dataset(tmp_path_factory.mktemp("walk"))


@FAST
@given(order=st.permutations(range(FRAMES)), doubled=st.lists(st.integers(0, FRAMES - 1), max_size=3))
def test_any_order_of_rows_is_the_recording(folder, order, doubled):
    rows = rows_of([pose for pose, _, _ in WALK])
    dataset(folder, rows=[rows[i] for i in (*order, *doubled)])
    source = open_source(folder)
    assert_the_walk(source)
    assert any("sorted by stamp" in note for note in source.notes) == (list(order) != sorted(order))
    assert any("repeat a frame" in note for note in source.notes) == bool(doubled)


def written(value_ns, unit, style):
    value = value_ns / NS_PER[unit] if value_ns % NS_PER[unit] else value_ns // NS_PER[unit]
    if style == "float":
        return repr(float(value))
    if style == "decimal":
        whole, rest = divmod(value_ns, NS_PER[unit])
        return f"{whole}.{rest:0{len(str(NS_PER[unit])) - 1}d}" if unit != "ns" else f"{whole}.0"
    return str(value)


@FAST
@given(
    unit=st.sampled_from(sorted(NS_PER)),
    style=st.sampled_from(["plain", "float", "decimal"]),
    start_s=st.sampled_from([0, 1_300_000_000, 1_700_000_000, 1_900_000_000]),
    spacing_ms=st.sampled_from([10, 33, 50, 100, 400, 1000, 2000]),
)
def test_any_unit_of_stamps_is_found(folder, unit, style, start_s, spacing_ms):
    stamps = [start_s * 10**9 + i * spacing_ms * 10**6 for i in range(FRAMES)]
    words = [written(stamp, unit, style) for stamp in stamps]
    for said in ("s", "ns"):
        found, note = stamps_ns(words, folder, said)
        assert np.abs(np.array(found) - stamps).max() <= 500, (words, found)
        assert bool(note) == (unit != said)


def test_stamps_that_tell_nothing_are_asked_for(tmp_path):
    with pytest.raises(SourceError, match="give the frame rate with --rate"):
        open_source(dataset(tmp_path / "a", rows=rows_of([p for p, _, _ in WALK], ["1.7e+18"] * FRAMES)))
    frames = list(open_source(tmp_path / "a", options=ReadOptions(rate_hz=2.5)))
    assert [frame.stamp_ns for frame in frames] == [i * 400_000_000 for i in range(FRAMES)]
    with pytest.raises(SourceError, match="--stamp-unit s, ms, us or ns"):
        stamps_ns([f"{i * 1e-9}" for i in range(9)], tmp_path, "s")
    assert stamps_ns(["1", "2", "3"], tmp_path, "ns", "ms")[0] == [10**6, 2 * 10**6, 3 * 10**6]


def test_a_clock_that_was_set_back_is_not_unsorted():
    stamps = [10, 20, 30, 4, 5, 6]
    assert order_of(list(range(6)), stamps) == (list(range(6)), [])


TABLES = {
    "byte-order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "UTF-16": lambda text: text.encode("utf-16"),
    "semicolons": lambda text: text.replace(",", ";").encode(),
    "decimal commas": lambda text: text.replace(",", ";").replace(".", ",").encode(),
    "tabs": lambda text: text.replace(",", "\t").encode(),
    "blanks": lambda text: text.replace(",", "  ").encode(),
    "Windows": lambda text: text.replace("\n", "\r\n").encode(),
    "capitals": lambda text: text.replace(HEAD, " Frame , Stamp_NS,X_m , Y_m,Z_m,QX,QY,QZ,QW").encode(),
    "empty lines": lambda text: ("\n" + text.replace("\n", "\n\n") + ",,,\n").encode(),
}


@pytest.mark.parametrize("kind", TABLES)
def test_any_spreadsheet_is_the_recording(tmp_path, kind):
    folder = dataset(tmp_path / "d")
    table = folder / "trajectory.csv"
    table.write_bytes(TABLES[kind](table.read_text()))
    assert_the_walk(open_source(folder))


def test_a_camera_file_may_have_a_byte_order_mark(tmp_path):
    folder = dataset(tmp_path / "d")
    (folder / "camera.json").write_bytes(b"\xef\xbb\xbf" + (folder / "camera.json").read_bytes())
    assert_the_walk(open_source(folder))


def test_a_row_that_is_not_a_number_costs_one_frame(tmp_path):
    rows = rows_of([pose for pose, _, _ in WALK])
    rows[3] = "3,nan,nan,nan,nan,nan,nan,nan,nan"
    frames = list(open_source(dataset(tmp_path / "d", rows=rows)))
    assert [isinstance(frame, BadFrame) for frame in frames] == [i == 3 for i in range(FRAMES)]


# Poses.


@FAST
@given(
    angles=st.tuples(*[st.floats(-180, 180)] * 3),
    position=st.tuples(*[st.floats(-50, 50)] * 3),
    decimals=st.sampled_from([2, 3, 4, 6]),
)
def test_any_rounded_motion_becomes_rigid_and_stays_near(angles, position, decimals):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), position
    mended = rigid(np.round(pose, decimals))
    np.testing.assert_allclose(mended[:3, :3] @ mended[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(mended[:3, :3]) > 0
    turned = Rotation.from_matrix(mended[:3, :3].T @ pose[:3, :3]).magnitude()
    assert np.degrees(turned) < 100 * 10.0**-decimals
    RawFrame(
        frame_id=0, stamp_ns=0, intrinsics=CAMERA, world_from_camera=mended, color=b"", depth=b"", depth_scale_m=1.0,
        index=0, total=1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda p: p * np.array([1.2, 1.2, 1.2, 1])[:, None], "axes are off by 20%"),
        (lambda p: p @ np.diag([1, 1, -1, 1.0]), "mirrors"),
        (lambda p: np.where(np.eye(4) > 0, np.nan, p), "not finite"),
        (lambda p: p.T, "last row"),
    ],
)
def test_what_is_no_motion_is_refused_with_its_reason(change, reason):
    with pytest.raises(PoseError, match=reason):
        rigid(change(WALK[3][0]))


def test_conventions_are_options(tmp_path):
    inverse = [np.linalg.inv(pose) for pose, _, _ in WALK]
    opengl = [pose @ np.diag((1.0, -1, -1, 1)) for pose, _, _ in WALK]
    assert_the_walk(
        open_source(dataset(tmp_path / "a", rows=rows_of(inverse)), options=ReadOptions(poses="camera_from_world"))
    )
    assert_the_walk(
        open_source(dataset(tmp_path / "b", rows=rows_of(opengl)), options=ReadOptions(camera_axes="opengl"))
    )
    swapped = [
        ",".join((*(w := row.split(","))[:5], w[8], w[5], w[6], w[7])) for row in rows_of([p for p, _, _ in WALK])
    ]
    assert_the_walk(open_source(dataset(tmp_path / "c", rows=swapped), options=ReadOptions(quaternion="wxyz")))


@FAST
@given(east=st.floats(-8e5, 8e5), north=st.floats(2000, 6e6), height=st.sampled_from([0.0, 12.5, 312.4, 4000.0]))
def test_coordinates_of_a_map_grid_are_recentred_and_the_offset_is_kept(folder, east, north, height):
    shift = np.array([east, north, height])
    poses = [pose.copy() for pose, _, _ in WALK]
    for pose in poses:
        pose[:3, 3] += shift
    source = open_source(dataset(folder, rows=rows_of(poses)))
    frames = list(source)
    assert any("recentred" in note for note in source.notes)
    assert max(np.abs(frame.world_from_camera[:3, 3]).max() for frame in frames) < 60
    for frame, pose in zip(frames, poses, strict=True):
        np.testing.assert_allclose(frame.world_from_camera[:3, 3] + source.origin_m, pose[:3, 3], atol=1e-5)
    kept = next(iter(open_source(folder, options=ReadOptions(origin="keep"))))
    np.testing.assert_allclose(kept.world_from_camera[:3, 3], poses[0][:3, 3], atol=1e-5)


def test_ground_truth_moves_with_the_origin(tmp_path):
    folder = dataset(tmp_path / "d")
    truth = {
        "floors": [{"id": 0, "z_min_m": 0.0, "z_max_m": 3.0}],
        "regions": [{"id": 0, "label": "hall", "floor": 0, "polygon_m": [[1, 2], [3, 2], [3, 4]]}],
    }
    (folder / "regions.json").write_text(json.dumps(truth))
    moved = open_source(folder, options=ReadOptions(origin="1,2,0.5"))
    assert moved.ground_truth["regions"][0]["polygon_m"] == [[0, 0], [2, 0], [2, 2]]
    assert moved.ground_truth["floors"][0]["z_max_m"] == 2.5
    assert moved.origin_m == (1.0, 2.0, 0.5)
    box = {"label": "chair", "min_m": [1, 2, 0.5], "max_m": [2, 3, 1.5]}
    (folder / "objects.json").write_text(json.dumps({"objects": [box]}))
    (item,) = truth_beside(moved).objects
    assert (item.min_m.tolist(), item.max_m.tolist()) == ([0, 0, 0], [1, 1, 1])


# Images.


@FAST
@given(tail=st.binary(min_size=1, max_size=400), kind=st.sampled_from(["png", "jpg", "progressive"]))
def test_any_bytes_behind_an_image_are_left_out_and_no_beginning_is_whole(tail, kind):
    image = np.random.default_rng(len(tail)).integers(0, 255, (24, 32, 3)).astype(np.uint8)
    progressive = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1) if kind == "progressive" else ()
    data = png(image) if kind == "png" else jpg(image, *progressive)
    assert trimmed(data + tail) == data
    assert image_size(data + tail) == (32, 24, 8)
    for length in range(0, len(data), 7):
        with pytest.raises(ImageError):
            image_size(data[:length])


def thumbnailed(data):
    """The picture with a smaller one, whole, in its header, as cameras write it."""
    inner = b"Exif\0\0" + jpg(np.zeros((8, 8, 3), np.uint8))
    return data[:2] + b"\xff\xe1" + (len(inner) + 2).to_bytes(2, "big") + inner + data[2:]


def test_a_thumbnail_does_not_end_its_picture():
    data = thumbnailed(jpg(WALK[0][1]))
    assert trimmed(data + b"film") == data
    with pytest.raises(ImageError, match="cut off"):
        image_size(data[: len(data) // 2])


def turned(data):
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    part = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + (len(part) + 2).to_bytes(2, "big") + part + data[2:]


def test_an_orientation_tag_turns_no_pixel(tmp_path):
    folder = dataset(tmp_path / "d", depth_scale_m=0.001)
    for i, (_, color, _) in enumerate(WALK):
        (folder / f"color/{i:06d}.png").unlink()
        (folder / f"color/{i:06d}.jpg").write_bytes(turned(jpg(color)))
    assert_the_walk(open_source(folder), depth=False)
    bent = open_source(folder, options=ReadOptions(distortion=[0.01, 0, 0, 0]))
    plain = decoded(jpg(WALK[2][1]))
    difference = np.abs(decoded(list(bent)[2].color).astype(int) - plain)
    assert np.median(difference) <= 3


COLORS = {
    "16 bits": (".png", lambda c: png(c.astype(np.uint16) * 257)),
    "BMP": (".bmp", lambda c: cv2.imencode(".bmp", c)[1].tobytes()),
    "lossless WebP": (".webp", lambda c: cv2.imencode(".webp", c, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()),
}


@pytest.mark.parametrize("kind", COLORS)
def test_colour_of_other_kinds_is_the_same_picture(tmp_path, kind):
    folder, (ending, write) = dataset(tmp_path / "d"), COLORS[kind]
    for i, (_, color, _) in enumerate(WALK):
        (folder / f"color/{i:06d}.png").unlink()
        (folder / f"color/{i:06d}{ending}").write_bytes(write(color))
    assert_the_walk(open_source(folder))


@pytest.mark.parametrize("channels", ["grey", "transparent"])
def test_grey_and_transparent_colour_is_taken(tmp_path, channels):
    code = cv2.COLOR_BGR2GRAY if channels == "grey" else cv2.COLOR_BGR2BGRA
    frames = [(pose, cv2.cvtColor(color, code), depth) for pose, color, depth in WALK]
    read = list(open_source(dataset(tmp_path / "d", frames)))
    assert all(isinstance(frame, RawFrame) for frame in read)


def npy(depth):
    import io

    file = io.BytesIO()
    np.save(file, depth)
    return file.getvalue()


DEPTHS = {
    "metres.npy": (".npy", lambda d: npy((d / 1000).astype(np.float32))),
    "millimetres.npy": (".npy", npy),
    "wide.npy": (".npy", lambda d: npy(d.astype(np.int32))),
    "float millimetres.npy": (".npy", lambda d: npy(d.astype(np.float32))),
    "metres.tiff": (".tiff", lambda d: cv2.imencode(".tiff", (d / 1000).astype(np.float32))[1].tobytes()),
    "millimetres.tif": (".tif", lambda d: cv2.imencode(".tif", d)[1].tobytes()),
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_depth_of_other_kinds_is_the_same_depth(tmp_path, kind):
    folder, (ending, write) = dataset(tmp_path / "d"), DEPTHS[kind]
    for i, (_, _, depth) in enumerate(WALK):
        (folder / f"depth/{i:06d}.png").unlink()
        (folder / f"depth/{i:06d}{ending}").write_bytes(write(depth))
    assert_the_walk(open_source(folder))


def test_saturated_depth_is_no_measurement_and_is_told(tmp_path):
    frames = [(pose, color, depth.copy()) for pose, color, depth in WALK]
    for _, _, depth in frames:
        depth[10:20, 10:30] = 65535
    source = open_source(dataset(tmp_path / "d", frames))
    assert any("65535 is taken as no measurement" in note for note in source.notes)
    depth = decoded(next(iter(source)).depth)
    assert (depth[10:20, 10:30] == 0).all()
    assert (depth[:10] == WALK[0][2][:10]).all()
    kept = next(iter(open_source(tmp_path / "d", options=ReadOptions(depth_invalid=[int(WALK[0][2][0, 0])]))))
    assert decoded(kept.depth)[0, 0] == 0
    assert decoded(kept.depth)[15, 15] == 65535


@pytest.mark.parametrize("scale_m", [1.0, 1000.0, 1e-6, 0.0, -0.001, float("inf"), float("nan")])
def test_an_absurd_unit_of_depth_stops(tmp_path, scale_m):
    with pytest.raises(SourceError, match="depth_scale_m") as error:
        open_source(dataset(tmp_path / "d", depth_scale_m=scale_m))
    assert "--depth-scale" in str(error.value)
    assert_the_walk(open_source(tmp_path / "d", options=ReadOptions(depth_scale_m=0.001)))


def test_depth_out_of_the_wanted_range_is_no_measurement(tmp_path):
    options = ReadOptions(depth_min_m=1.0, depth_max_m=2.5)
    frame = next(iter(open_source(dataset(tmp_path / "d"), options=options)))
    depth, truth = decoded(frame.depth), WALK[0][2]
    np.testing.assert_array_equal(depth, np.where((truth >= 1000) & (truth <= 2500), truth, 0))
    assert 0 < (depth > 0).mean() < 1


# Cameras.


def test_colour_of_another_size_is_resampled_onto_depth(tmp_path):
    large = Intrinsics(160, 120, 120.0, 120.0, 79.5, 59.5)
    frames = [(p, big, depth) for (p, _, depth), (_, big, _) in zip(WALK, walk(large), strict=True)]
    for camera in (CAMERA, large):  # the camera may be that of either
        source = open_source(dataset(tmp_path / f"{camera.width_px}", frames, camera=camera))
        assert source.intrinsics == CAMERA
        for frame, (_, color, _) in zip(source, WALK, strict=True):
            assert np.abs(decoded(frame.color).astype(int) - color).mean() < 2
    wide = [(p, color[:40], depth) for p, color, depth in WALK]
    with pytest.raises(SourceError, match="80 x 40 pixels and the depth images 80 x 60"):
        open_source(dataset(tmp_path / "w", wide))


def test_a_crop_is_accepted_and_a_camera_for_other_images_is_not(tmp_path):
    crop = Intrinsics(50, 60, 60.0, 60.0, 39.5, 29.5)
    frames = [(pose, color[:, :50], depth[:, :50]) for pose, color, depth in WALK]
    assert open_source(dataset(tmp_path / "c", frames, camera=crop)).intrinsics == crop
    outside = Intrinsics(80, 60, 600.0, 600.0, 319.5, 239.5)
    with pytest.raises(SourceError, match="another image size"):
        open_source(dataset(tmp_path / "o", camera=outside))


LENSES = {
    "opencv": (-0.2, 0.05, 0.001, -0.002),
    "opencv with five": (-0.3, 0.11, 0.0, 0.001, 0.01),
    "opencv with eight": (-0.2, 0.05, 0.001, 0.0, 0.0, 0.02, 0.01, 0.0),
    "fisheye": (-0.02, 0.01, 0.0, 0.0),
}


def bent_walk(lens):
    """The walk through a lens: each pixel has the depth and colour of its bent ray."""
    matrix = np.array(((60.0, 0, 39.5), (0, 60.0, 29.5), (0, 0, 1)))
    v, u = np.indices((60, 80))
    pixels = np.stack((u, v), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    undistort = cv2.fisheye.undistortPoints if lens == "fisheye" else cv2.undistortPoints
    plane = undistort(pixels, matrix, np.array(LENSES[lens])).reshape(60, 80, 2)
    directions = np.concatenate((plane, np.ones((60, 80, 1))), axis=-1)
    rendered = [(pose, *render(pose, directions)) for pose, _, _ in WALK]
    return [(pose, color, np.rint(depth_m * 1000).astype(np.uint16)) for pose, depth_m, color in rendered]


@pytest.mark.parametrize("lens", LENSES)
def test_lenses_are_straightened_on_reading(tmp_path, lens):
    name = lens.split()[0]
    bent = bent_walk(lens)
    assert np.abs(bent[0][2].astype(int) - WALK[0][2]).max() > 50
    source = open_source(dataset(tmp_path / "d", bent, distortion=list(LENSES[lens]), model=name.upper()))
    assert any("undistorted" in note for note in source.notes)
    assert source.intrinsics == CAMERA
    for frame, (_, color, depth) in zip(source, WALK, strict=True):
        read = decoded(frame.depth).astype(int)
        seen = read > 0
        assert seen.mean() > 0.7
        assert np.quantile(np.abs(read - depth)[seen], 0.9) < 60
        assert np.quantile(np.abs(decoded(frame.color).astype(int) - color)[seen], 0.9) <= 6
    told = open_source(
        dataset(tmp_path / "o", bent), options=ReadOptions(distortion=list(LENSES[lens]), camera_model=name)
    )
    assert list(told)[1].depth == list(source)[1].depth
    with pytest.raises(SourceError, match="not known: give --camera-model"):
        open_source(dataset(tmp_path / "u", bent, distortion=[0.1] * 4, model="OMNI"))


# Layouts of one's own.


def own(path, frames=WALK, *, axes=None, inverse=False, pose=None, intrinsics=True):
    for name in ("rgb", "depth", "pose"):
        (path / name).mkdir(parents=True)
    for i, (world_from_camera, color, depth) in enumerate(frames):
        (path / f"rgb/{i:06d}.png").write_bytes(png(color))
        (path / f"depth/{i:06d}.png").write_bytes(png(depth))
        matrix = world_from_camera @ (np.eye(4) if axes is None else np.linalg.inv(axes))
        matrix = np.linalg.inv(matrix) if inverse else matrix
        np.savetxt(path / f"pose/{i:06d}.txt", matrix if pose is None else pose(matrix))
    if intrinsics:
        np.savetxt(path / "intrinsics.txt", [[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
    return path


OPENGL = np.diag((1.0, -1, -1, 1))
ROS = np.array(((0.0, 0, 1, 0), (-1, 0, 0, 0), (0, -1, 0, 0), (0, 0, 0, 1)))


def seven(order):
    def words(matrix):
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        return np.array([[*matrix[:3, 3], *((x, y, z, w) if order == "xyzw" else (w, x, y, z))]])

    return words


OWN = {
    "opencv": ({}, "world_from_camera with opencv"),
    "inverse": ({"inverse": True}, "camera_from_world with opencv"),
    "opengl": ({"axes": OPENGL}, "world_from_camera with opengl"),
    "ros": ({"axes": ROS}, "world_from_camera with ros"),
    "quaternions": ({"pose": seven("xyzw")}, "world_from_camera with opencv"),
    "quaternions, scalar first": ({"pose": seven("wxyz")}, "world_from_camera with opencv"),
}


@pytest.mark.parametrize("kind", OWN)
def test_what_poses_of_an_own_layout_mean_is_found_and_told(tmp_path, kind):
    changes, said = OWN[kind]
    source = open_source(own(tmp_path / "d", **changes))
    assert source.layout == "generic"
    assert source.why
    assert any(said in note and "agree by" in note for note in source.notes), source.notes
    assert any("0.001 metres per depth unit" in note for note in source.notes)
    assert_the_walk(source, stamps=False)


def test_an_own_layout_that_tells_nothing_is_asked_for(tmp_path):
    still = [WALK[0]] * FRAMES
    with pytest.raises(SourceError, match=r"give --poses .* and --axes"):
        open_source(own(tmp_path / "d", still))
    told = ReadOptions(poses="world_from_camera", camera_axes="opencv")
    assert len(list(open_source(tmp_path / "d", options=told))) == FRAMES
    with pytest.raises(SourceError, match=r"has no camera: put intrinsics\.txt .* --intrinsics"):
        open_source(own(tmp_path / "n", intrinsics=False))
    given_ = open_source(tmp_path / "n", options=ReadOptions(intrinsics=[60.0, 60.0, 39.5, 29.5]))
    assert_the_walk(given_, stamps=False)
    wrong = [(WALK[(5 * i + 3) % FRAMES][0], *WALK[i][1:]) for i in range(FRAMES)]
    with pytest.raises(SourceError, match="does not tell what its poses mean"):
        open_source(own(tmp_path / "w", wrong))


def test_up_of_an_own_layout_is_where_cameras_are_upright(tmp_path):
    y_up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    source = open_source(own(tmp_path / "d", [(y_up @ pose, *rest) for pose, *rest in WALK]))
    assert any("up is y" in note for note in source.notes)
    assert all(-frame.world_from_camera[2, 1] > 0.8 for frame in source)


# Lists of the TUM benchmark.


def tum(path, shift_s=0.0, separator=" ", name="{:.6f}", shuffle=False):
    for folder in ("rgb", "depth"):
        (path / folder).mkdir(parents=True)
    lists = {"rgb": [], "depth": [], "groundtruth": []}
    for i, (pose, color, depth) in enumerate(WALK):
        stamp = 1305031790.5 + 0.4 * i + 0.01 * (i % 3)
        file = name.format(stamp)
        (path / f"rgb/{file}.png").write_bytes(png(color))
        (path / f"depth/{file}.png").write_bytes(png(depth))
        words = [f"{v:.9f}" for v in (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat())]
        lists["rgb"].append(f"{stamp:.6f}{separator}rgb/{file}.png")
        lists["depth"].append(f"{stamp + 0.004:.6f}{separator}depth/{file}.png")
        lists["groundtruth"].append(separator.join((f"{stamp + shift_s:.6f}", *words)))
    for which, lines in lists.items():
        (path / f"{which}.txt").write_bytes(
            ("# a comment\r\n" + "\r\n".join(lines[::-1] if shuffle else lines) + "\r\n").encode("utf-8-sig")
        )
    camera = {"width": 80, "height": 60, "fx": 60, "fy": 60, "cx": 39.5, "cy": 29.5, "depth_scale_m": 0.001}
    (path / "camera.json").write_text(json.dumps(camera))
    return path


@pytest.mark.parametrize(
    "changes",
    [{}, {"separator": ", "}, {"separator": ","}, {"separator": "\t"}, {"name": "my frame {:.3f}"}, {"shuffle": True}],
)
def test_lists_of_any_hand_are_the_recording(tmp_path, changes):
    assert_the_walk(open_source(tum(tmp_path / "d", **changes)), stamps=False)


@pytest.mark.parametrize("shift_s", [0.5, -3.21, 7200.0])
def test_a_clock_beside_the_images_is_found_told_and_can_be_given(tmp_path, shift_s):
    source = open_source(tum(tmp_path / "d", shift_s))
    assert any("clock of groundtruth.txt is another" in note and "--stamp-offset" in note for note in source.notes)
    assert_the_walk(source, stamps=False)
    told = open_source(tmp_path / "d", options=ReadOptions(stamp_offset_s=-shift_s))
    assert_the_walk(told, stamps=False)
    with pytest.raises(SourceError, match="give the difference of the clocks with --stamp-offset"):
        open_source(tmp_path / "d", options=ReadOptions(stamp_offset_s=123.456))


@pytest.mark.parametrize(("unit", "scale_m"), [(1000.0, 0.001), (100.0, 0.01), (3.0, 1 / 3)])
def test_positions_in_another_unit_are_told(tmp_path, unit, scale_m):
    poses = [pose.copy() for pose, _, _ in WALK]
    for pose in poses:
        pose[:3, 3] *= unit
    dataset(tmp_path / "d", rows=rows_of(poses))
    assert_the_walk(open_source(tmp_path / "d", options=ReadOptions(position_scale_m=scale_m)))


def test_positions_of_an_own_layout_in_millimetres_are_found_and_told(tmp_path):
    poses = [(pose.copy(), *rest) for pose, *rest in WALK]
    for pose, *_ in poses:
        pose[:3, 3] *= 1000
    source = open_source(own(tmp_path / "d", poses))
    assert any("positions are read as units of 0.001 m" in note for note in source.notes), source.notes
    assert_the_walk(source, stamps=False)


def test_shares_of_the_image_are_no_intrinsics(tmp_path):
    fields = {"fx": 60 / 80, "fy": 1.0, "cx": 39.5 / 80, "cy": 29.5 / 60}
    with pytest.raises(SourceError, match=r"shares of the image, not pixels.* --intrinsics 60,60,39\.5,29\.5"):
        open_source(dataset(tmp_path / "d", **fields))


@pytest.mark.parametrize("factor", [100, 10_000])
def test_floating_point_depth_in_another_unit_is_named_with_the_unit_that_mends(tmp_path, factor):
    folder = dataset(tmp_path / "d")
    for i, (_, _, depth) in enumerate(WALK):
        (folder / f"depth/{i:06d}.png").unlink()
        (folder / f"depth/{i:06d}.npy").write_bytes(npy((depth / 1000 * factor).astype(np.float32)))
    try:
        mend = " ".join(f.mend for f in check(open_source(folder), Config()).problems)
    except SourceError as error:
        mend = str(error)
    assert f"--depth-scale {1 / factor:g}" in mend or f"sets it, {1 / factor:g} would" in mend
    told = list(open_source(folder, options=ReadOptions(depth_scale_m=1 / factor)))
    assert np.abs(decoded(told[0].depth).astype(int) - WALK[0][2]).max() <= 1


def test_a_saved_object_is_told_in_plain_words(tmp_path):
    folder = dataset(tmp_path / "d")
    (folder / "depth/000002.png").unlink()
    np.save(folder / "depth/000002.npy", np.array([{"depth": 1}], object), allow_pickle=True)
    (bad,) = [frame for frame in open_source(folder) if isinstance(frame, BadFrame)]
    assert "write it again with numpy.save" in bad.reason
    assert "pickle" not in bad.reason


# Packing.


def test_a_packed_log_reads_as_the_source_that_was_put_right(tmp_path):
    poses = [pose.copy() for pose, _, _ in WALK]
    for pose in poses:
        pose[:3, 3] += (512345.6, 5403210.9, 0)
    frames = [(pose, color.astype(np.uint16) * 257, depth) for pose, (_, color, depth) in zip(poses, WALK, strict=True)]
    folder = dataset(tmp_path / "d", frames)
    (folder / "depth/000003.png").unlink()
    (folder / "regions.json").write_text(json.dumps({"rooms": [{"name": "kitchen"}]}))  # somebody else's
    source, refused = pack_source(folder, tmp_path / "out.mcap", robot="r")
    assert sum(refused.values()) == 1
    again = open_source(tmp_path / "out.mcap")
    assert again.origin_m == source.origin_m != (0.0, 0.0, 0.0)
    assert again.ground_truth is None
    good = [frame for frame in source if isinstance(frame, RawFrame)]
    assert len(good) == len(list(again)) == FRAMES - 1
    for before, after in zip(good, again, strict=True):
        for name in ("frame_id", "stamp_ns", "intrinsics", "color", "depth", "depth_scale_m", "mask"):
            assert getattr(before, name) == getattr(after, name)
        np.testing.assert_array_equal(before.world_from_camera, after.world_from_camera)
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"depth_scale_m": float("inf")}, "depth_scale_m must be a positive"),
        ({"depth_scale_m": 0.0}, "depth_scale_m must be a positive"),
        ({"position_scale_m": 0.0}, "position_scale_m must be a positive"),
        ({"rate_hz": -1.0}, "rate_hz"),
        ({"intrinsics": [1.0, 2.0]}, "intrinsics must be fx fy cx cy"),
        ({"distortion": [0.1, 0.2]}, "4 or 5 or 8 distortion coefficients"),
        ({"camera_model": "fisheye", "distortion": [0.1] * 5}, "a fisheye lens has 4"),
        ({"origin": "here"}, "origin must be keep, auto, or x,y,z"),
        ({"depth_min_m": 3.0, "depth_max_m": 2.0}, "depth_min_m"),
    ],
)
def test_options_that_cannot_be_meant_are_one_sentence(fields, reason):
    with pytest.raises(ValueError, match=reason):
        ReadOptions(**fields)
