"""Two cameras beside each other give depth on the walls of a room that was drawn for them."""

import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.registration import rays
from prior_sg.services.ingest.core.stereo import Lens, Pair
from prior_sg.services.ingest.sources import SourceError, depth_models, open_source
from tests.services.ingest.test_clouds import points_world
from tests.services.ingest.test_sources import ROBOT, cast, off_wall

CAMERA = Intrinsics(320, 240, 220.0, 221.0, 161.3, 118.2)
LENS = (-0.12, 0.03, 0.001, -0.0005)  # radial-tangential
START_NS = 1_403_636_579_763_555_584


def body_from(right_m, yaw_deg):
    """body_from_camera of a camera that looks ahead, a little aside."""
    pose = np.eye(4)
    pose[:3, :3] = (Rotation.from_euler("z", yaw_deg, degrees=True) * ROBOT).as_matrix()
    pose[:3, 3] = 0.1, -right_m, 0.05
    return pose


LEFT, RIGHT = body_from(0.0, 0.6), body_from(0.11, -0.5)


def world_from_body(stamp_ns):
    seconds = (stamp_ns - START_NS) / 1e9
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 25 + 20 * seconds, degrees=True).as_matrix()
    pose[:3, 3] = 1.3 + 0.5 * seconds, 0.4, 1.3
    return pose


def picture(world_from_camera):
    """What a camera with this lens sees of the room, papered with a pattern that does not repeat."""
    directions = rays(CAMERA, "", LENS) @ world_from_camera[:3, :3].T
    points = world_from_camera[:3, 3] + cast(world_from_camera[:3, 3], directions)[..., None] * directions
    grey = np.zeros(points.shape[:2])
    for cell_m, share in ((0.25, 0.5), (0.09, 0.5)):
        i, j, k = np.moveaxis(np.floor((points + 0.0137) / cell_m).astype(np.int64), -1, 0)
        grey += share * np.random.default_rng(4).integers(20, 235, 4096)[(i * 73 + j * 1931 + k * 28657) % 4096]
    return cv2.GaussianBlur(grey.astype(np.uint8), (3, 3), 0)


def sensor(body_from_sensor):
    numbers = ", ".join(f"{v:.9f}" for v in body_from_sensor.ravel())
    return f"""#Camera
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{numbers}]
rate_hz: 20
resolution: [320, 240]
camera_model: pinhole
intrinsics: [220.0, 221.0, 161.3, 118.2] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [{", ".join(map(str, LENS))}]
"""


def euroc(path):
    for name, mount in (("cam0", LEFT), ("cam1", RIGHT)):
        (path / f"mav0/{name}/data").mkdir(parents=True)
        (path / f"mav0/{name}/sensor.yaml").write_text(sensor(mount))
        for i in range(4):
            stamp = START_NS + i * 500_000_000
            cv2.imwrite(str(path / f"mav0/{name}/data/{stamp}.png"), picture(world_from_body(stamp) @ mount))
    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x"]
    for stamp in range(START_NS - 200_000_000, START_NS + 2_000_000_000, 5_000_000):
        pose = world_from_body(stamp)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(",".join((str(stamp), *(f"{v:.9f}" for v in (*pose[:3, 3], w, x, y, z)), "0.0")))
    (path / "mav0/state_groundtruth_estimate0").mkdir()
    (path / "mav0/state_groundtruth_estimate0/data.csv").write_text("\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return euroc(tmp_path_factory.mktemp("euroc") / "d")


def test_two_cameras_see_depth_on_the_walls(kept):
    source = open_source(kept)
    frames = [frame for frame in source if isinstance(frame, RawFrame)]
    assert source.layout == "euroc"
    assert any("semi-global" in note for note in source.notes)
    assert len(frames) == 4
    for frame in frames:
        points, share = points_world(frame)
        off_m = off_wall(points)
        assert share > 0.6
        assert np.median(off_m) < 0.06  # a quarter of a pixel of disparity, 2.7 m away
        assert (off_m < 0.3).mean() > 0.9
        depth_m = cv2.imdecode(np.frombuffer(frame.depth, np.uint8), cv2.IMREAD_UNCHANGED) * frame.depth_scale_m
        pose, of = frame.world_from_camera, frame.intrinsics
        true_m = cast(pose[:3, 3], rays(of, "", ()) @ pose[:3, :3].T)
        seen = depth_m > 0
        off_px = of.fx_px * 0.11 * (1 / depth_m[seen] - 1 / true_m[seen])
        assert abs(np.median(off_px)) < 0.12  # nothing is shifted


def network(path, inputs=2, shape=(1, 3, "h", "w")):
    """A file that gives a tenth of the left picture's red as disparity."""
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    names = ["left", "right"][:inputs]
    given = [helper.make_tensor_value_info(name, kind, list(shape)) for name in names]
    nodes = [
        helper.make_node("Gather", ["left", "first"], ["red"], axis=1),
        helper.make_node("Mul", ["red", "tenth"], ["disparity"]),
    ]
    constants = [
        onnx.numpy_helper.from_array(np.array([0], np.int64), "first"),
        onnx.numpy_helper.from_array(np.array(0.1, np.float32), "tenth"),
    ]
    told = [helper.make_tensor_value_info("disparity", kind, None)]
    graph = helper.make_graph(nodes, "matching", given, told, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize("shape", [(1, 3, "h", "w"), (1, 3, 64, 128)])
def test_a_network_of_one_s_own_gets_red_green_blue_and_gives_pixels_of_the_picture(tmp_path, shape):
    pytest.importorskip("onnxruntime")
    of = depth_models.Network(network(tmp_path / "n.onnx", shape=shape))
    left = np.zeros((48, 96, 3), np.uint8)
    left[:, :, 2] = 100  # red
    disparity_px = of(left, left)
    assert disparity_px.shape == (48, 96)
    scale = 96 / 128 if shape[3] == 128 else 1.0
    assert disparity_px == pytest.approx(10.0 * scale, rel=1e-4)


def test_a_network_replaces_the_matching_of_a_source(tmp_path, kept):
    pytest.importorskip("onnxruntime")
    file = network(tmp_path / "mine.onnx")
    source = open_source(kept, options=ReadOptions(depth_model=str(file)))
    assert any("by mine.onnx" in note for note in source.notes)
    frame = next(iter(source))
    depth = cv2.imdecode(np.frombuffer(frame.depth, np.uint8), cv2.IMREAD_UNCHANGED) * frame.depth_scale_m
    red = cv2.imdecode(np.frombuffer(frame.color, np.uint8), cv2.IMREAD_GRAYSCALE)
    pair = Pair.of(Lens(CAMERA, "", LENS), Lens(CAMERA, "", LENS), inverse(RIGHT) @ LEFT)
    expected = pair.intrinsics.fx_px * pair.baseline_m / (0.1 * red[100, 200])
    assert depth[100, 200] == pytest.approx(expected, rel=0.02)


def test_a_rate_that_is_told_counts_in_place_of_stamps(kept):
    source = open_source(kept, options=ReadOptions(rate_hz=2.0))
    assert any("2 frames a second, as told" in note for note in source.notes)
    assert [frame.stamp_ns for frame in source] == [0, 500_000_000, 1_000_000_000, 1_500_000_000]


@pytest.mark.parametrize(
    "made", [lambda path: network(path, shape=(1, 4, "h", "w")), lambda path: path.write_bytes(b"no")]
)
def test_a_file_that_is_no_network_that_matches_is_told(tmp_path, kept, made):
    pytest.importorskip("onnxruntime")
    made(tmp_path / "n.onnx")
    with pytest.raises(SourceError, match=r"cannot be loaded as a network|a network that matches has two"):
        open_source(kept, options=ReadOptions(depth_model=str(tmp_path / "n.onnx")))


def no_right(path):
    shutil.rmtree(path / "mav0/cam1")


def exchanged(path):
    one, other = (path / f"mav0/{name}/sensor.yaml" for name in ("cam0", "cam1"))
    first, second = one.read_text(), other.read_text()
    one.write_text(second), other.write_text(first)


def without(text, name="cam0/sensor.yaml"):
    def change(path):
        file = path / "mav0" / name
        file.write_text("\n".join(line for line in file.read_text().splitlines() if text not in line))

    return change


def with_lens(text, name="cam0"):
    """Another lens in place of the last two lines of a camera."""

    def change(path):
        file = path / f"mav0/{name}/sensor.yaml"
        file.write_text(file.read_text().partition("distortion_model")[0] + text)

    return change


def later(path):
    for file in (path / "mav0/cam1/data").iterdir():
        file.rename(file.with_name(f"{int(file.stem) + 100_000_000}.png"))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (with_lens("distortion_model: radtan\ndistortion_coefficients: [0.1, 0.2, 0.3]"), "coefficients, not 3"),
        (with_lens("distortion_coefficients: [0.1, 0.2, 0.0, 0.0]"), "no distortion_model"),
        (with_lens("distortion_model: equidistant\ndistortion_coefficients: [0, 0, 0, 0]", "cam1"), "other has none"),
        (later, "within 1 ms: name both by the same stamps"),
        (no_right, "depth needs cam0 and cam1"),
        (exchanged, "exchange them"),
        (without("intrinsics"), "intrinsics with 4 numbers"),
        (
            with_lens("distortion_model: radtan\ndistortion_coefficients: [-0.28340811, 0.07395907"),
            "coefficients with nothing but",
        ),
        (without("data:"), "T_BS with 16 numbers"),
        (lambda path: shutil.rmtree(path / "mav0/state_groundtruth_estimate0"), "has no poses"),
        (without("1", "state_groundtruth_estimate0/data.csv"), "no pose that can be used|no list of poses"),
        (lambda path: [f.write_bytes(b"") for f in (path / "mav0/cam1/data").iterdir()], "damaged"),
    ],
)
def test_what_a_stereo_sequence_lacks_is_told(tmp_path, kept, damage, said):
    path = shutil.copytree(kept, tmp_path / "d")
    damage(path)
    with pytest.raises(SourceError, match=said):
        list(open_source(path))
