"""Images are decoded only when their headers say what their camera says: a small file may be a huge image."""

import resource
import struct
import zlib

import cv2
import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import copied
from prior_sg.schemas.frames import MOST_PIXELS, Intrinsics, Keyframe
from prior_sg.services.images import ImageFault, color_of, depth_of
from tests.help.examples import EXAMPLES

CAMERA = Intrinsics(4, 3, 5.0, 5.0, 1.5, 1.0)
GOOD = msgspec.structs.replace(
    next(example for example in EXAMPLES if isinstance(example, Keyframe)),
    intrinsics=CAMERA,
    color=cv2.imencode(".jpg", np.zeros((3, 4, 3), np.uint8))[1].tobytes(),
    depth=cv2.imencode(".png", np.full((3, 4), 9, np.uint16))[1].tobytes(),
    mask=b"",
)


def zeros(width_px, height_px, bits, kind):
    """A PNG file of nothing but zeros, written row by row."""

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    row = b"\0" * (1 + width_px * bits // 8 * (3 if kind == 2 else 1))
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(row) for _ in range(height_px)) + packer.flush()
    head = struct.pack(">IIBBBBB", width_px, height_px, bits, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def claims(data, width_px, height_px):
    """A JPEG file whose header claims another size."""
    at = next(i for i in range(len(data)) if data[i : i + 2] in (b"\xff\xc0", b"\xff\xc2"))
    return data[: at + 5] + struct.pack(">HH", height_px, width_px) + data[at + 9 :]


@pytest.mark.parametrize(
    ("decode", "changes"),
    [
        (color_of, {"color": zeros(9000, 9000, 8, 2)}),
        (color_of, {"color": claims(GOOD.color, 20000, 20000)}),
        (lambda frame: depth_of(frame, 0.5), {"depth": zeros(9000, 9000, 16, 0)}),
        (lambda frame: depth_of(frame, 0.5), {"mask": zeros(9000, 9000, 8, 0)}),
    ],
)
def test_what_its_header_says_to_be_larger_than_the_camera_is_never_decoded(decode, changes, monkeypatch):
    assert color_of(GOOD).shape == (3, 4, 3) and depth_of(GOOD, 0.5).shape == (3, 4)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ImageFault, match=r"000 x \d+ pixels, the intrinsics are for 4 x 3"):
        decode(msgspec.structs.replace(GOOD, **changes))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 50_000


@pytest.mark.parametrize(
    "data", [b"", b"no", GOOD.color[:20], b"\x89PNG\r\n\x1a\n", GOOD.depth[:30], b"BM" + b"\0" * 60]
)
def test_what_has_no_header_of_a_format_that_travels_cannot_be_decoded(data):
    damaged = msgspec.structs.replace(GOOD, color=data)
    for frame in (damaged, copied(damaged)):  # as a source gives it, and as the bus does
        with pytest.raises(ImageFault, match="cannot be decoded"):
            color_of(frame)


@pytest.mark.parametrize("extension", [".jpg", ".png"])
def test_images_of_a_received_keyframe_are_decoded_as_they_were_sent(extension):
    pixels = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    color = cv2.imencode(extension, pixels)[1].tobytes() + b"what follows the end"
    mask = cv2.imencode(".png", np.eye(3, 4, dtype=np.uint8))[1].tobytes()
    sent = msgspec.structs.replace(GOOD, color=color, mask=mask)
    received = copied(sent)
    assert isinstance(received.color, memoryview)
    np.testing.assert_array_equal(color_of(received), color_of(sent))
    np.testing.assert_array_equal(depth_of(received, 0.5), depth_of(sent, 0.5))
    assert depth_of(received, 0.5)[0, 0] == 0 < depth_of(received, 0.5)[0, 1]


def test_a_camera_has_no_more_pixels_than_memory_bears():
    assert Intrinsics(7680, 4320, 5.0, 5.0, 1.5, 1.0).width_px * 4320 <= MOST_PIXELS
    with pytest.raises(ValueError, match="more than"):
        Intrinsics(16384, 16384, 5.0, 5.0, 1.5, 1.0)
