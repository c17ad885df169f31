"""Depth from one picture: a network that was told the truth up to scale and shift, and a camera that moves."""

import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.ingest.core.mono import scale
from prior_sg.services.ingest.core.mono.scale import INVERSE, METRIC, ScaleError, Scaling
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.registration import rays
from prior_sg.services.ingest.sources import SourceError, open_source
from tests.services.ingest.test_sources import cast
from tests.services.ingest.test_stereo import CAMERA, LEFT, LENS, START_NS, picture, sensor

FRAMES, STEP_NS = 14, 100_000_000
SCALE, SHIFT = 1 / 260, 0.03  # of inverse depth: 1/z = SCALE * d + SHIFT
METRES_PER_UNIT = 1 / 45


def moving(index):
    """world_from_body of a robot that drives sideways and turns a little."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 40 + 1.5 * index, degrees=True).as_matrix()
    pose[:3, 3] = 1.3 - 0.02 * index, 0.4 + 0.04 * index, 1.3
    return pose


def turning(index):
    pose = moving(0)
    pose[:3, :3] = Rotation.from_euler("z", 40 + 3 * index, degrees=True).as_matrix()
    return pose


def inverse_code(depth_m):
    return (1 / depth_m - SHIFT) / SCALE


def metric_code(depth_m):
    return depth_m / METRES_PER_UNIT


def true_depth(world_from_camera, lens=LENS):
    directions = rays(CAMERA, "", lens) @ world_from_camera[:3, :3].T
    return cast(world_from_camera[:3, 3], directions)


def coloured(world_from_camera, code):
    """The room in red and green; in blue, which the network gives, its depth."""
    grey, blue = picture(world_from_camera), code(true_depth(world_from_camera))
    assert blue.min() > 1 and blue.max() < 255
    return np.dstack((np.rint(blue).astype(np.uint8), grey, grey))


def film(path, motion=moving, code=inverse_code):
    """One camera in the layout of EuRoC, 10 pictures a second."""
    (path / "mav0/cam0/data").mkdir(parents=True)
    (path / "mav0/cam0/sensor.yaml").write_text(sensor(LEFT))
    rows = []
    for index in range(FRAMES):
        stamp, pose = START_NS + index * STEP_NS, motion(index)
        cv2.imwrite(str(path / f"mav0/cam0/data/{stamp}.png"), coloured(pose @ LEFT, code))
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(",".join((str(stamp), *(f"{v:.9f}" for v in (*pose[:3, 3], w, x, y, z)))))
    (path / "mav0/state_groundtruth_estimate0").mkdir()
    (path / "mav0/state_groundtruth_estimate0/data.csv").write_text("#timestamp,x,y,z,w,x,y,z\n" + "\n".join(rows))
    return path


def network(path, kind=""):
    """A file that gives the blue of its picture."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper, number = onnx.helper, onnx.TensorProto.FLOAT
    given = helper.make_tensor_value_info("picture", number, [1, 3, "h", "w"])
    node = helper.make_node("Gather", ["picture", "blue"], ["depth"], axis=1)
    blue = onnx.numpy_helper.from_array(np.array([2], np.int64), "blue")
    told = helper.make_tensor_value_info("depth", number, None)
    graph = helper.make_graph([node], "seeing", [given], [told], [blue])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    if kind:
        helper.set_model_props(model, {"depth_output": kind})
    onnx.save(model, str(path))
    return str(path)


def off(frame, index, motion=moving):
    """Share by which depth is wrong where there is some, and the share of pixels that have some."""
    depth_m = cv2.imdecode(np.frombuffer(frame.depth, np.uint8), cv2.IMREAD_UNCHANGED) * frame.depth_scale_m
    true_m = true_depth(motion(index) @ LEFT, ())
    seen = depth_m > 0
    return float(np.median(depth_m[seen] / true_m[seen])) - 1, float(seen.mean())


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return film(tmp_path_factory.mktemp("film") / "d")


@pytest.mark.parametrize(("code", "kind"), [(inverse_code, ""), (metric_code, METRIC)])
def test_scale_and_shift_of_a_network_are_those_that_the_movement_shows(tmp_path, kept, code, kind):
    path = kept if code is inverse_code else film(tmp_path / "d", code=code)
    source = open_source(path, options=ReadOptions(depth_model=network(tmp_path / "n.onnx", kind)))
    assert any(f"({'depth' if kind else 'inverse depth'})" in note for note in source.notes)
    frames = [frame for frame in source if isinstance(frame, RawFrame)]
    assert len(frames) == FRAMES
    for frame in frames:
        wrong, share = off(frame, frame.index)
        assert abs(wrong) < 0.03
        assert share > 0.9


def test_images_are_made_only_of_frames_that_may_become_keyframes(tmp_path, kept):
    source = open_source(kept, options=Config(depth_model=network(tmp_path / "n.onnx"), min_translation_m=0.2))
    frames = list(source.events())
    whole = [frame for frame in frames if not frame.pose_only]
    assert len(frames) == FRAMES
    assert 2 <= len(whole) <= FRAMES // 2
    assert all(frame.depth and frame.color for frame in whole)
    assert not any(frame.depth or frame.color for frame in frames if frame.pose_only)


def test_without_parallax_nothing_is_made_up(tmp_path):
    path = film(tmp_path / "d", motion=turning)
    with pytest.raises(SourceError, match=r"nothing tells the scale of its depth: 0 points.*has to move sideways"):
        open_source(path, options=ReadOptions(depth_model=network(tmp_path / "n.onnx")))


@pytest.mark.parametrize("told", [{"depth_output": METRIC}, {}])
def test_a_network_of_the_other_kind_is_told(tmp_path, kept, told):
    path = kept if told else film(tmp_path / "d", code=metric_code)
    with pytest.raises(SourceError, match=r"--depth-output says whether|fits .* of the points"):
        open_source(path, options=ReadOptions(depth_model=network(tmp_path / "n.onnx"), **told))


def own(path):
    """Pictures and a list of poses, in a layout of one's own."""
    (path / "rgb").mkdir(parents=True)
    rows = []
    for index in range(FRAMES):
        pose = moving(index) @ LEFT
        cv2.imwrite(str(path / f"rgb/{index:04d}.png"), coloured(pose, inverse_code))
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(" ".join(f"{v:.9f}" for v in (index, *pose[:3, 3], x, y, z, w)))
    (path / "poses.txt").write_text("\n".join(rows))
    camera = {"fx": 220.0, "fy": 221.0, "cx": 161.3, "cy": 118.2, "width": 320, "height": 240}
    (path / "camera.json").write_text(json.dumps({**camera, "model": "opencv", "distortion": list(LENS)}))
    return path


def test_a_folder_of_one_s_own_needs_no_depth_where_a_network_sees_it(tmp_path):
    path, model = own(tmp_path / "d"), network(tmp_path / "n.onnx")
    with pytest.raises(SourceError, match=r"or give --depth-model FILE.onnx"):
        open_source(path)
    with pytest.raises(SourceError, match=r"no depth that would tell what its poses mean: give --poses .* and --quat"):
        open_source(path, options=ReadOptions(depth_model=model))
    told = ReadOptions(
        depth_model=model,
        poses="world_from_camera",
        camera_axes="opencv",
        quaternion="xyzw",
        rate_hz=10,
        world_up=[0, 0, 1],
    )
    frames = [frame for frame in open_source(path, options=told) if isinstance(frame, RawFrame)]
    assert len(frames) == FRAMES
    assert all(abs(off(frame, frame.index)[0]) < 0.03 for frame in frames)


def test_a_source_with_depth_has_nothing_for_a_network_to_do(tmp_path):
    path = own(tmp_path / "d")
    (path / "depth").mkdir()
    for index in range(FRAMES):
        depth_mm = np.rint(1000 * true_depth(moving(index) @ LEFT)).astype(np.uint16)
        cv2.imwrite(str(path / f"depth/{index:04d}.png"), depth_mm)
    with pytest.raises(SourceError, match=r"leave out --depth-model"):
        open_source(
            path,
            options=ReadOptions(
                depth_model=network(tmp_path / "n.onnx"),
                poses="world_from_camera",
                camera_axes="opencv",
                quaternion="xyzw",
                depth_scale_m=0.001,
            ),
        )


def points(count=200, seed=1):
    random = np.random.default_rng(seed)
    inverse_depth = random.uniform(0.15, 1.0, count)
    return random, (inverse_depth - SHIFT) / SCALE, inverse_depth, np.full(count, 0.01)


def test_a_third_of_wrong_points_changes_nothing():
    random, output, inverse_depth, sigma = points()
    wrong = inverse_depth.copy()
    wrong[: len(wrong) // 3] = random.uniform(0.05, 3.0, len(wrong) // 3)
    factors = scale.fitted(0, scale.rows_of(output, INVERSE), wrong, sigma).factors
    assert factors == pytest.approx((SCALE, SHIFT), rel=0.03)


def test_a_network_that_fits_half_of_the_points_is_refused():
    random, output, inverse_depth, sigma = points()
    inverse_depth[::2] = random.uniform(0.05, 3.0, len(inverse_depth) // 2)
    with pytest.raises(ScaleError, match=r"fits 5.% of the points"):
        scale.fitted(0, scale.rows_of(output, INVERSE), inverse_depth, sigma)


def test_the_same_everywhere_is_refused():
    _, _, inverse_depth, sigma = points()
    flat = np.full_like(inverse_depth, 7.0)
    with pytest.raises(ScaleError, match=r"the same everywhere|fits 0%"):
        scale.fitted(0, scale.rows_of(flat, INVERSE), np.full_like(inverse_depth, 0.5), sigma)


def test_the_last_scale_holds_for_a_second_without_parallax():
    _, output, inverse_depth, sigma = points()
    scaling, none = Scaling(INVERSE), np.zeros(0)
    with pytest.raises(ScaleError, match=r"nothing tells"):
        scaling.take(0, none, none, none)
    kept = scaling.take(10**9, output, inverse_depth, sigma)
    assert scaling.take(2 * 10**9, none, none, none) is kept
    with pytest.raises(ScaleError, match=r"nothing tells"):
        scaling.take(2 * 10**9 + 1, none, none, none)


def test_a_scale_follows_slowly_and_forgets():
    _, _, inverse_depth, sigma = points()
    scaling = Scaling(METRIC)
    depth = 1 / inverse_depth
    assert scaling.take(0, depth, inverse_depth, sigma).factors[0] == pytest.approx(1.0, rel=1e-6)
    soon = scaling.take(3 * 10**7, depth * 1.2, inverse_depth, sigma).factors[0]
    late = scaling.take(10**9, depth * 1.2, inverse_depth, sigma).factors[0]
    assert 1.05 < soon < 1.15
    assert late == pytest.approx(1.2, rel=0.02)


def test_pixels_beyond_what_was_seen_are_no_measurement():
    _, output, inverse_depth, sigma = points()
    fit = Scaling(INVERSE).take(0, output, inverse_depth, sigma)
    code = (np.array([[0.5, 0.02, -0.05]]) - SHIFT) / SCALE
    depth_m = fit.depth_m(code, INVERSE)
    assert depth_m[0, 0] == pytest.approx(2.0, rel=0.02)
    assert (depth_m[0, 1:] == 0).all()


def test_bad_frames_are_counted_and_the_next_is_tried(tmp_path, kept):
    path = shutil.copytree(kept, tmp_path / "d")
    files = sorted((path / "mav0/cam0/data").iterdir())
    cv2.imwrite(str(files[0]), np.full((240, 320, 3), 90, np.uint8))
    events = list(open_source(path, options=Config(depth_model=network(tmp_path / "n.onnx"))).events())
    assert isinstance(events[0], BadFrame)
    assert "nothing tells the scale" in events[0].reason
    assert isinstance(events[1], RawFrame) and not events[1].pose_only
