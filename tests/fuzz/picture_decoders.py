"""Images, depth, saved arrays and clouds of points, as sensors, recordings and messages hold them."""

import io
import struct
from types import SimpleNamespace

import cv2
import msgspec
import numpy as np

from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services import headers
from prior_sg.services.images import MAX_PRINCIPAL_OFFSET, ImageFault, color_of, depth_of
from prior_sg.services.ingest.core import pixels
from prior_sg.services.ingest.core.clouds.files import columns_of
from prior_sg.services.ingest.core.clouds.sweep import CloudError, sweep_of
from prior_sg.services.ingest.core.ros.images import DEPTH_HEADER, LAYOUTS, color_file, depth_image, metres, shown_by
from tests.fuzz.trial import Decoder
from tests.help.examples import KEYFRAME

CAMERA = Intrinsics(6, 4, 5.0, 5.0, 2.5, 1.5)
COLOR = (np.arange(72) * 3 % 251).astype(np.uint8).reshape(4, 6, 3)
DEPTH = np.arange(900, 924, dtype=np.uint16).reshape(4, 6)
ENDINGS = (".pcd", ".ply", ".npy", ".bin")


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def _jpg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def _saved(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _files() -> list[bytes]:
    return [_png(COLOR), _jpg(COLOR), _png(DEPTH), _jpg(COLOR[..., 0]), _jpg(COLOR) + bytes(7) + _jpg(COLOR)]


def _header(data: bytes) -> None:
    """What is trimmed is whole, and measured alike."""
    list(headers.jpeg_segments(data))
    headers.is_sized(data)
    headers.told_size(data)
    size = headers.image_size(data)
    whole = headers.trimmed(data)
    assert len(whole) <= len(data) and headers.image_size(whole) == size


def _arrays() -> list[bytes]:
    return [*_files(), _saved(DEPTH), _saved(COLOR), _saved(DEPTH.astype(np.float64))]


def _pixels(data: bytes) -> None:
    pixels.measured(data)
    if pixels.stored(data).dtype in (np.uint8, np.uint16):
        pixels.eight_bit(data)


def _keyframes() -> list[bytes]:
    """Colour, depth and mask, each with its length before it."""
    mask = _png(np.zeros((4, 6), np.uint8))
    return [
        b"".join(struct.pack("<I", len(f)) + f for f in files)
        for files in ((_jpg(COLOR), _png(DEPTH), b""), (_png(COLOR), _png(DEPTH), mask))
    ]


def _keyframe(data: bytes) -> None:
    files = []
    for _ in range(3):
        length = int.from_bytes(data[:4], "little")
        files.append(data[4 : 4 + length])
        data = data[4 + length :]
    keyframe = msgspec.structs.replace(KEYFRAME, intrinsics=CAMERA, color=files[0], depth=files[1], mask=files[2])
    decode_both(keyframe)


def decode_both(keyframe: Keyframe) -> None:
    color = color_of(keyframe)
    depth = depth_of(keyframe, MAX_PRINCIPAL_OFFSET)
    assert color.shape == (4, 6, 3) and depth.shape == (4, 6) and np.isfinite(depth).all()


FORMATS = (
    "16UC1; compressedDepth png",
    "32FC1; compressedDepth png",
    "16UC1; compressedDepth rvl",
    "32FC1; compressedDepth rvl",
    "jpeg",
)
RVL_NIBBLES = "0" + "83" + "2" * 24 + "0" * 5  # no zeros, then 24 others, each one more than the one before
RVL = struct.pack("<II4I", 6, 4, *(int(RVL_NIBBLES[i : i + 8], 16) for i in range(0, 32, 8)))


def _depths() -> list[bytes]:
    """The number of a format, then the data."""
    head = DEPTH_HEADER.pack(0, 10100.0, -1009.0)
    raw = [bytes([len(FORMATS) + i]) + struct.pack("<HHHB", 4, 6, 48, 0) + bytes(200) for i in range(len(LAYOUTS))]
    return [*(bytes([i]) + head + (RVL if "rvl" in said else _png(DEPTH)) for i, said in enumerate(FORMATS)), *raw]


def _depth(data: bytes) -> None:
    number, held = (data[0], data[1:]) if data else (0, b"")
    if number < len(FORMATS):
        message = SimpleNamespace(format=FORMATS[number], data=np.frombuffer(held, np.uint8))
    else:
        height, width, step, big = struct.unpack_from("<HHHB", held.ljust(7, b"\0"))
        encoding = list(LAYOUTS)[(number - len(FORMATS)) % len(LAYOUTS)]
        fields = {"height": height, "width": width, "step": step, "is_bigendian": big % 2}
        message = SimpleNamespace(encoding=encoding, data=np.frombuffer(held[7:], np.uint8), **fields)
    if shown_by(message) == "depth":
        assert metres(depth_image(message), 0.001).ndim == 2
    else:
        color_file(message)


def _clouds() -> list[bytes]:
    """The number of an ending, then the file."""
    points = np.array([(1, 2, 3, 0.5), (4, 5, 6, 0.25)], "<f4")
    head = "VERSION .7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA "
    columns = points.T.tobytes()
    packed = bytes([len(columns) - 1]) + columns
    pcd = [
        f"{head}binary\n".encode() + points.tobytes(),
        f"{head}ascii\n1 2 3 0\n4 5 6 0.05\n".encode(),
        f"{head}binary_compressed\n".encode() + struct.pack("<II", len(packed), len(columns)) + packed,
    ]
    ply = (
        "ply\nformat {} 1.0\nelement vertex 2\nproperty float x\n"
        "property float y\nproperty float z\nproperty float t\nend_header\n"
    )
    plys = [
        ply.format("ascii").encode() + b"1 2 3 0\n4 5 6 0.05\n",
        ply.format("binary_big_endian").encode() + points.byteswap().tobytes(),
    ]
    saved = [_saved(points), _saved(np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f8"), ("t", "u4")]))]
    kinds = (pcd, plys, saved, [points.tobytes(), np.ones((3, 5), "<f4").tobytes()])
    return [bytes([i]) + file for i, files in enumerate(kinds) for file in files]


def _cloud(data: bytes) -> None:
    ending = ENDINGS[data[0] % len(ENDINGS)] if data else ".bin"
    sweep = sweep_of(columns_of(data[1:], ending), 10**18)
    assert sweep.points_lidar.shape[1] == 3 and np.isfinite(sweep.points_lidar).all()


DECODERS = (
    Decoder("image-headers", _files, _header, (headers.ImageError,), share=12),
    Decoder("pixels", _arrays, _pixels, (headers.ImageError,), share=3),
    Decoder("keyframe-images", _keyframes, _keyframe, (ImageFault,), share=6),
    Decoder("ros-images", _depths, _depth, (headers.ImageError,), share=6),
    Decoder("clouds", _clouds, _cloud, (CloudError,), share=2),
)
