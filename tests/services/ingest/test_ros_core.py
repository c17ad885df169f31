"""Messages of ROS by their fields alone: pixels, cameras, transforms, pairs and the choice of topics."""

import struct
from types import SimpleNamespace as Message

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse
from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pairing import associate
from prior_sg.services.ingest.core.pixels import encoded, stored
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.cameras import camera_fields
from prior_sg.services.ingest.core.ros.images import color_file, depth_image, metres, shown_by
from prior_sg.services.ingest.core.ros.registration import rays, registered
from prior_sg.services.ingest.core.ros.topics import CAMERA_INFO, COMPRESSED, IMAGE, Topic, chosen
from prior_sg.services.ingest.core.ros.transforms import Stamped, Track, TransformTree, transforms_of

RNG = np.random.default_rng(5)
BGR = RNG.integers(0, 256, (6, 8, 3)).astype(np.uint8)
MS = 1_000_000


def image(pixels, encoding, big=False, pad=0):
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=77)
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.shape[1]}
    return Message(encoding=encoding, is_bigendian=int(big), data=rows.reshape(-1), **size)


@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("bgr8", BGR),
        ("8UC3", BGR),
        ("rgb8", BGR[..., ::-1]),
        ("bgra8", np.dstack((BGR, np.full((6, 8), 9, np.uint8)))),
        ("rgba8", np.dstack((BGR[..., ::-1], np.full((6, 8), 9, np.uint8)))),
    ],
)
def test_colour_comes_out_as_it_went_in(encoding, pixels, pad):
    message = image(pixels, encoding, pad=pad)
    assert shown_by(message) == "colour"
    assert np.array_equal(stored(color_file(message)), BGR)


def test_grey_and_bayer_patterns_are_colour_too():
    grey = image(BGR[..., 0], "mono8")
    assert shown_by(grey) == "grey" and np.array_equal(stored(color_file(grey)), BGR[..., 0])
    flat = np.empty((8, 8), np.uint8)  # red at even rows and columns, blue at odd ones
    flat[0::2, 0::2], flat[1::2, 1::2], flat[0::2, 1::2], flat[1::2, 0::2] = 200, 30, 90, 90
    assert (stored(color_file(image(flat, "bayer_rggb8")))[2:6, 2:6] == (30, 90, 200)).all()
    assert (stored(color_file(image(flat, "bayer_bggr8")))[2:6, 2:6] == (200, 90, 30)).all()


def test_depth_keeps_its_numbers_in_either_order_of_bytes():
    units = RNG.integers(0, 65535, (6, 8)).astype(np.uint16)
    assert np.array_equal(stored(depth_image(image(units, "16UC1", pad=4))), units)
    assert np.array_equal(stored(depth_image(image(units.byteswap(), "16UC1", big=True))), units)
    depth_m = np.where(units % 7 == 0, np.nan, units / 1000).astype(np.float32)
    assert np.array_equal(depth_image(image(depth_m, "32FC1")), depth_m, equal_nan=True)
    assert np.allclose(metres(depth_image(image(units, "16UC1")), 0.001), units / 1000)
    assert (metres(depth_image(image(depth_m, "32FC1")), 0.001)[np.isnan(depth_m)] == 0).all()


def test_compressed_depth_by_hand():
    """The header as compressed_depth_image_transport writes it: an enumeration of 4 bytes and two floats, 12 in all."""
    units = RNG.integers(0, 9000, (6, 8)).astype(np.uint16)
    png = encoded(units, ".png")
    plain = Message(format="16UC1; compressedDepth png", data=bytes.fromhex("00000000" + "00000000" * 2) + png)
    assert shown_by(plain) == "depth" and np.array_equal(stored(depth_image(plain)), units)
    # depth_quantization 100 and depth_max 10 m: A = 100 * 101 = 10100, B = 1 - A / 10 = -1009
    header = bytes.fromhex("0000000000d01d4600407cc4")
    assert struct.unpack("<iff", header) == (0, 10100.0, -1009.0)
    depth_m = np.array(((0.5, 1.0, 2.0), (4.0, 9.0, np.nan)), np.float32)
    inverse_depth = np.array(((19191, 9091, 4041), (1516, 113, 0)), np.uint16)  # trunc(A / depth + B)
    bent = Message(format="32FC1; compressedDepth", data=header + encoded(inverse_depth, ".png"))
    assert np.allclose(depth_image(bent), depth_m, rtol=1e-3, equal_nan=True)
    assert np.isnan(depth_image(bent)[1, 2])


def rolled(pixels):
    """RVL as its paper's C code writes it, a nibble at a time, after the size that image_transport puts before it."""
    nibbles, values = [], pixels.reshape(-1).astype(int).tolist()

    def write(value):
        while True:
            value, nibble = value >> 3, value & 7
            nibbles.append(nibble | (8 if value else 0))
            if not value:
                return

    at, last = 0, 0
    while at < len(values):
        for zero in (True, False):
            end = next((i for i in range(at, len(values)) if (values[i] == 0) is not zero), len(values))
            write(end - at)
            for value in [] if zero else values[at:end]:
                delta = value - last
                write((delta << 1) ^ (delta >> 31))
                last = value
            at = end
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    height, width = pixels.shape
    return struct.pack(f"<II{len(words)}I", width, height, *words)


MM = np.array(((0, 0, 500, 501), (499, 65535, 1, 0), (0, 700, 0, 9000)), np.uint16)


@pytest.mark.parametrize("pixels", [MM, np.zeros((5, 7), np.uint16), np.full((2, 3), 800, np.uint16)])
def test_depth_of_rvl_is_unrolled(pixels):
    header = struct.pack("<iff", 0, 0.0, 0.0)
    read = depth_image(Message(format="16UC1; compressedDepth rvl", data=header + rolled(pixels)))
    assert np.array_equal(stored(read), pixels)
    bent = struct.pack("<iff", 0, 10100.0, -1009.0)
    metres = depth_image(Message(format="32FC1; compressedDepth rvl", data=bent + rolled(np.array(((9091, 0),), "u2"))))
    assert metres[0, 0] == pytest.approx(1.0) and np.isnan(metres[0, 1])


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (Message(format="16UC1; compressedDepth rvl", data=b"0" * 40), "808464432 x 808464432"),
        (Message(format="16UC1; compressedDepth rvl", data=b"0" * 15), "RVL data has no size"),
        (Message(format="16UC1; compressedDepth rvl", data=bytes(12) + rolled(MM)[:12]), "RVL data"),
        (Message(format="16UC1; compressedDepth rvl", data=bytes(12) + rolled(MM)[:8] + b"\xff" * 8), "RVL data"),
        (Message(format="16UC1; compressedDepth", data=b"0" * 12), "12 bytes"),
        (Message(format="16UC1; compressedDepth png", data=b"0" * 12 + encoded(BGR, ".png")[:40]), "cut off"),
        (image(BGR, "rgb8"), "not one of depth"),
        (image(BGR, "nv21"), "'nv21' is not known"),
    ],
)
def test_depth_that_cannot_be_read_says_why(message, reason):
    with pytest.raises(ImageError, match=reason):
        depth_image(message)


@pytest.mark.parametrize(
    ("field", "value"),
    [("height", 7), ("height", 0), ("height", 2**31), ("width", 9), ("width", 0), ("width", 2**32 - 1), ("step", 23)],
)
def test_sizes_that_do_not_fit_the_data_are_refused(field, value):
    message = image(BGR, "bgr8")
    setattr(message, field, value)
    with pytest.raises(ImageError, match=r"too few|out of range"):
        color_file(message)


def info(model="plumb_bob", d=(), **more):
    roi = Message(x_offset=0, y_offset=0, width=0, height=0)
    fields = {"width": 640, "height": 480, "binning_x": 0, "binning_y": 0, "roi": roi, "distortion_model": model}
    fields |= {
        "k": [500, 0, 320, 0, 510, 240, 0, 0, 1],
        "d": list(d),
        "p": [400, 0, 300, 9, 0, 410, 220, 0, 0, 0, 1, 0],
    }
    return Message(**(fields | more))


@pytest.mark.parametrize(
    ("model", "d", "kept"),
    [
        ("plumb_bob", (0.0,) * 5, None),
        ("plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.0), 4),
        ("plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.05), 5),
        ("rational_polynomial", (0.1, -0.2, 0, 0, 0.05, 0.3, -0.1, 0.2), 8),
        ("rational_polynomial", (0.1, 0, 0, 0, 0, 0.3, 0, 0, 0, 0, 0, 0, 0, 0), 8),
        ("equidistant", (0.1, 0, 0, 0), 4),
        ("rational_polynomial", (0.1,) * 14, 14),  # thin prisms: refused where lenses are checked
    ],
)
def test_coefficients_in_one_of_the_known_lengths(model, d, kept):
    camera = camera_fields(info(model, d), rectified=False)
    assert (camera["fx"], camera["fy"], camera["cx"], camera["cy"]) == (500, 510, 320, 240)
    assert camera.get("distortion") == (None if kept is None else list((*d, 0.0))[:kept])


def test_a_camera_of_ros_1_of_a_part_of_the_sensor_and_of_rectified_images():
    old = info(d=())
    old.K, old.P, old.D = old.k, old.p, old.d
    del old.k, old.p, old.d
    assert camera_fields(old, rectified=False)["fx"] == 500
    straight = camera_fields(info(d=(0.1, 0, 0, 0, 0)), rectified=True)
    assert (straight["fx"], straight["cy"], "distortion" in straight) == (400, 220, False)
    part = info(roi=Message(x_offset=20, y_offset=40, width=600, height=400), binning_x=2, binning_y=2)
    camera = camera_fields(part, rectified=False)
    assert (camera["width"], camera["height"], camera["fx"]) == (300, 200, 250)
    assert (camera["cx"], camera["cy"]) == (300.5 / 2 - 0.5, 200.5 / 2 - 0.5)
    with pytest.raises(ValueError, match="not calibrated"):
        camera_fields(info(k=[0.0] * 9), rectified=False)


def motion(x, y, z, *degrees):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("ZYX", degrees, degrees=True).as_matrix(), (x, y, z)
    return pose


def stamped(stamp_ns, parent, child, pose):
    return Stamped(stamp_ns, parent, child, tuple(pose[:3, 3]), tuple(Rotation.from_matrix(pose[:3, :3]).as_quat()))


def test_a_chain_of_transforms_by_hand():
    """A robot at (1, 2) turned left by 90 degrees, its camera 0.2 m ahead and 1 m up, with optical axes."""
    base = motion(1, 2, 0, 90, 0, 0)
    optical = np.array(((0, 0, 1, 0.2), (-1, 0, 0, 0), (0, -1, 0, 1.0), (0, 0, 0, 1)), float)
    tree = TransformTree([stamped(0, "map", "base", base)], [stamped(0, "base", "camera", optical)])
    expected = np.array(((1, 0, 0, 1), (0, 0, 1, 2.2), (0, -1, 0, 1), (0, 0, 0, 1)), float)
    assert np.allclose(tree.at("map", "camera", 0, MS), expected, atol=1e-12)
    assert np.allclose(tree.at("camera", "map", 0, MS), inverse(expected), atol=1e-12)
    assert tree.fixed_frame("camera") == "map"
    assert tree.ancestors("camera") == ["camera", "base", "map"]


def test_between_stamps_as_scipy_does():
    stamps = [0, 40 * MS, 100 * MS]
    poses = [motion(0, 0, 0, 0, 0, 0), motion(1, -1, 0.5, 70, -20, 10), motion(0, 2, 0, 200, 30, -40)]
    flipped = stamped(stamps[1], "a", "b", poses[1])
    flipped = Stamped(*[getattr(flipped, n) for n in ("stamp_ns", "parent", "child", "position_m")],
                      tuple(-v for v in flipped.quaternion_xyzw))  # fmt: skip
    track = Track([stamped(stamps[2], "a", "b", poses[2]), stamped(stamps[0], "a", "b", poses[0]), flipped])
    turns = Slerp(stamps, Rotation.from_matrix([pose[:3, :3] for pose in poses]))
    for stamp in (0, 1, 17 * MS, 40 * MS, 63 * MS + 5, 100 * MS):
        pose = track.at(stamp, 0)
        assert np.allclose(pose[:3, :3], turns(stamp).as_matrix(), atol=1e-9)
        line = [np.interp(stamp, stamps, [p[axis, 3] for p in poses]) for axis in range(3)]
        assert np.allclose(pose[:3, 3], line, atol=1e-9)


def test_beyond_the_stamps_and_over_long_gaps_there_is_no_pose():
    track = Track([stamped(s * MS, "a", "b", motion(s, 0, 0, 0, 0, 0)) for s in (100, 200, 1900)])
    assert track.at(90 * MS, 20 * MS)[0, 3] == 100
    assert track.at(1910 * MS, 20 * MS)[0, 3] == 1900
    assert track.at(210 * MS, 20 * MS)[0, 3] == 200  # in the gap, close to its end
    for stamp in (50, 700, 2000):
        with pytest.raises(PoseError, match="within 20 ms"):
            track.at(stamp * MS, 20 * MS)


def test_trees_that_are_none_are_one_sentence():
    still = motion(0, 0, 0, 0, 0, 0)
    loop = TransformTree([], [stamped(0, a, b, still) for a, b in (("a", "b"), ("b", "c"), ("c", "a"))])
    with pytest.raises(PoseError, match="tf is a loop: a <- c <- b <- a"):
        loop.ancestors("a")
    two = TransformTree([stamped(0, "a", "c", still), stamped(0, "b", "c", still)])
    with pytest.raises(PoseError, match="several parents: a, b"):
        two.at("a", "c", 0, 0)
    apart = TransformTree([], [stamped(0, "a", "b", still)])
    with pytest.raises(PoseError, match="does not connect b with x"):
        apart.at("x", "b", 0, 0)
    bad = Stamped(0, "a", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(PoseError, match="no pose"):
        TransformTree([bad]).at("a", "b", 0, 0)


def test_a_camera_that_rests_in_its_world_moves_nowhere():
    still = motion(1, 0, 0, 5, 0, 0)
    tree = TransformTree([stamped(s, "odom", "base", still) for s in (0, 1, 2)], [stamped(0, "base", "cam", still)])
    assert tree.fixed_frame("cam") == ""
    moving = [stamped(s, "odom", "base", motion(s, 0, 0, 0, 0, 0)) for s in (0, 1)]
    chain = TransformTree([*moving, stamped(0, "earth", "map", still)], [stamped(0, "map", "odom", still)])
    assert chain.fixed_frame("base") == "map"


def test_messages_of_poses():
    header = Message(frame_id="/odom", stamp=Message(sec=3, nanosec=5))
    point, turn = Message(x=1, y=2, z=3), Message(x=0, y=0, z=0, w=1)
    pose = Message(position=point, orientation=turn)
    (odometry,) = transforms_of(Message(header=header, child_frame_id="/base", pose=Message(pose=pose)))
    (bare,) = transforms_of(Message(header=header, pose=pose))
    assert odometry == Stamped(3_000_000_005, "odom", "base", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    assert (bare.child, bare.position_m) == ("", odometry.position_m)


@pytest.mark.parametrize("seed", range(5))
def test_pairs_against_every_pair(seed):
    rng = np.random.default_rng(seed)
    first, second = (np.unique(rng.integers(0, 900, 40)).tolist() for _ in range(2))
    free, taken, expected = set(range(len(first))), set(range(len(second))), {}
    for away, i, j in sorted((abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second)):
        if away < 15 and i in free and j in taken:
            expected[i] = j
            free.remove(i)
            taken.remove(j)
    assert associate(first, second, 15) == expected


def test_depth_is_drawn_into_a_camera_beside_it():
    """A wall 2 m ahead with a box at 1 m, seen by a finer colour camera 10 cm to the right."""
    coarse, fine = Intrinsics(80, 60, 60, 60, 39.5, 29.5), Intrinsics(160, 120, 120, 120, 79.5, 59.5)
    depth_m = np.full((60, 80), 2.0)
    depth_m[20:40, 30:50] = 1.0
    color_from_depth = np.eye(4)
    color_from_depth[0, 3] = -0.1
    seen = registered(depth_m, rays(coarse, "", ()), color_from_depth, fine)
    # the box spans x -0.158 … 0.158 m at 1 m: shifted by -0.1 m its middle lies 12 pixels left of the image's
    assert np.allclose(seen[60, 52:84], 1.0)
    assert seen[60, 68 + 25] in (0.0, 2.0) and np.allclose(seen[10, 10:140], 2.0)
    assert np.isin(np.round(seen, 9), (0.0, 1.0, 2.0)).all()
    same = registered(depth_m, rays(coarse, "", ()), np.eye(4), coarse)
    assert np.allclose(same[same > 0], depth_m[same > 0]) and (same > 0).mean() > 0.9


def test_rays_of_a_bent_lens_as_opencv_projects_them():
    camera = Intrinsics(40, 30, 30, 30, 19.5, 14.5)
    matrix = np.array(((30.0, 0, 19.5), (0, 30, 14.5), (0, 0, 1)))
    lenses = (("", (-0.2, 0.05, 0.001, 0.002)), ("fisheye", (0.02, 0.01, 0, 0)))
    for model, d in lenses:
        points = rays(camera, model, d).reshape(-1, 1, 3)
        if model == "fisheye":
            pixels, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(d))
        else:
            pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(d))
        v, u = np.indices((30, 40))
        assert np.abs(pixels.reshape(30, 40, 2) - np.stack((u, v), axis=-1)).max() < 0.01


def topic(name, kind=IMAGE, shows="colour", encoding="rgb8", frame="color"):
    return Topic(name, kind, 100, 30.0, encoding, frame, shows)


REALSENSE = [
    topic("/cam/color/image_raw"),
    topic("/cam/color/image_raw/compressed", COMPRESSED, encoding="rgb8; jpeg compressed bgr8"),
    topic("/cam/infra1/image_rect_raw", shows="grey", encoding="mono8", frame="infra"),
    topic("/cam/depth/image_rect_raw", shows="depth", encoding="16UC1", frame="depth"),
    topic("/cam/aligned_depth_to_color/image_raw", shows="depth", encoding="16UC1"),
    topic("/cam/color/camera_info", CAMERA_INFO, shows=""),
    topic("/cam/depth/camera_info", CAMERA_INFO, shows="", frame="depth"),
    topic("/cam/aligned_depth_to_color/camera_info", CAMERA_INFO, shows=""),
]


def test_registered_depth_and_colour_go_before_all_else():
    for order in (REALSENSE, REALSENSE[::-1]):
        choice = chosen(order, ReadOptions())
        assert choice.color.name == "/cam/color/image_raw"
        assert choice.depth.name == "/cam/aligned_depth_to_color/image_raw"
        assert choice.color_info.name == "/cam/color/camera_info"
        assert choice.depth_info.name == "/cam/aligned_depth_to_color/camera_info"
        assert choice.others == ("/cam/depth/image_rect_raw",)


def test_what_is_told_is_taken_or_refused_in_one_sentence():
    told = ReadOptions(color_topic="cam/color/image_raw/compressed", depth_topic="/cam/depth/image_rect_raw")
    choice = chosen(REALSENSE, told)
    assert (choice.color.type, choice.depth.frame, choice.depth_info.frame) == (COMPRESSED, "depth", "depth")
    assert choice.color_info.name == "/cam/color/camera_info"
    with pytest.raises(ValueError, match=r"--depth-topic /cam/color/image_raw .* cannot serve; what can: /cam/"):
        chosen(REALSENSE, ReadOptions(depth_topic="/cam/color/image_raw"))
    with pytest.raises(ValueError, match=r"--color-topic /x is not in it"):
        chosen(REALSENSE, ReadOptions(color_topic="/x"))
    with pytest.raises(ValueError, match=r"no depth images; images of an unknown encoding: /y \(nv21\)"):
        chosen([REALSENSE[0], topic("/y", shows="", encoding="nv21")], ReadOptions())
