"""Image messages of ROS as files and arrays of pixels (pure)."""

import struct
from typing import Any

import numpy as np

from prior_sg.services.headers import ImageError, is_sized, trimmed
from prior_sg.services.ingest.core.pixels import encoded, stored
from prior_sg.services.ingest.core.ros.rvl import unrolled
from prior_sg.services.opencv import cv2

COLOR, GREY, DEPTH = "colour", "grey", "depth"  # what an image shows
# Of sensor_msgs/Image: what it shows, type and number of channels, and OpenCV's name of the way to blue, green, red.
LAYOUTS = {
    "bgr8": (COLOR, "u1", 3, ""),
    "8UC3": (COLOR, "u1", 3, ""),  # OpenCV's own name, whose order is OpenCV's
    "rgb8": (COLOR, "u1", 3, "COLOR_RGB2BGR"),
    "bgra8": (COLOR, "u1", 4, "COLOR_BGRA2BGR"),
    "8UC4": (COLOR, "u1", 4, "COLOR_BGRA2BGR"),
    "rgba8": (COLOR, "u1", 4, "COLOR_RGBA2BGR"),
    "yuv422": (COLOR, "u1", 2, "COLOR_YUV2BGR_UYVY"),
    "uyvy": (COLOR, "u1", 2, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (COLOR, "u1", 2, "COLOR_YUV2BGR_YUY2"),
    "yuyv": (COLOR, "u1", 2, "COLOR_YUV2BGR_YUY2"),
    "bayer_rggb8": (COLOR, "u1", 1, "COLOR_BayerBG2BGR"),  # OpenCV names the pattern by its second row
    "bayer_bggr8": (COLOR, "u1", 1, "COLOR_BayerRG2BGR"),
    "bayer_gbrg8": (COLOR, "u1", 1, "COLOR_BayerGR2BGR"),
    "bayer_grbg8": (COLOR, "u1", 1, "COLOR_BayerGB2BGR"),
    "mono8": (GREY, "u1", 1, ""),
    "8UC1": (GREY, "u1", 1, ""),
    "16UC1": (DEPTH, "u2", 1, ""),  # millimetres
    "mono16": (DEPTH, "u2", 1, ""),
    "32FC1": (DEPTH, "f4", 1, ""),  # metres
}
COMPRESSED_DEPTH = "compressedDepth"
DEPTH_HEADER = struct.Struct("<iff")  # format, and the two numbers A and B of the quantisation of inverse depth
MOST_PX = 1 << 26


def is_compressed(message: Any) -> bool:
    """Whether it is a CompressedImage."""
    return hasattr(message, "format")


def encoding_of(message: Any) -> str:
    """Its pixels' encoding, or the format of its compression, in the publisher's words."""
    return str(message.format if is_compressed(message) else message.encoding).strip()


def shown_by(message: Any) -> str:
    """COLOR, GREY or DEPTH; empty for what cannot be read."""
    encoding = encoding_of(message)
    if not is_compressed(message):
        return LAYOUTS[encoding][0] if encoding in LAYOUTS else ""
    pixels = encoding.split(";")[0].strip()
    if COMPRESSED_DEPTH in encoding or LAYOUTS.get(pixels, ("",))[0] == DEPTH:
        return DEPTH
    return GREY if pixels in LAYOUTS and LAYOUTS[pixels][0] == GREY else COLOR


def color_file(message: Any) -> bytes:
    """Colour or grey as an image file: that of a CompressedImage as it is, else a PNG. Raises ImageError."""
    if is_compressed(message):
        return bytes(message.data)
    pixels = _pixels(message)
    shows, _, _, conversion = LAYOUTS[message.encoding]
    if shows == DEPTH:
        raise ImageError(f"its encoding {message.encoding} is one of depth, not of colour")
    try:
        return encoded(cv2.cvtColor(pixels, getattr(cv2, conversion)) if conversion else pixels, ".png")
    except cv2.error as error:
        raise ImageError(f"its {pixels.shape[1]} x {pixels.shape[0]} pixels cannot be {message.encoding}") from error


def depth_image(message: Any) -> bytes | np.ndarray:
    """A PNG of 16 bits (millimetres, where nobody says otherwise), or metres (h, w) with NaN = no measurement.

    Raises ImageError.
    """
    if is_compressed(message):
        return _compressed_depth(message)
    pixels = _pixels(message)
    if LAYOUTS[message.encoding][0] != DEPTH:
        raise ImageError(f"its encoding {message.encoding} is not one of depth")
    return pixels if pixels.dtype.kind == "f" else encoded(pixels, ".png")


def metres(depth: bytes | np.ndarray, unit_m: float) -> np.ndarray:
    """Depth (h, w), metres, 0 = no measurement, of what `depth_image` gives. Raises ImageError."""
    if isinstance(depth, np.ndarray):
        return np.nan_to_num(depth.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    units = stored(depth)
    if units.ndim != 2 or units.dtype != np.uint16:
        raise ImageError("the depth image does not have one channel of 16 bits")
    return np.where(units == np.iinfo(np.uint16).max, 0, units) * unit_m


def _compressed_depth(message: Any) -> bytes | np.ndarray:
    encoding, data = encoding_of(message), bytes(message.data)
    if COMPRESSED_DEPTH not in encoding:
        return trimmed(data)
    held, rolled = data[DEPTH_HEADER.size :], "rvl" in encoding.lower()
    if len(data) <= DEPTH_HEADER.size or not (rolled or is_sized(held)):
        raise ImageError(f"no PNG file follows the {DEPTH_HEADER.size} bytes of its compressedDepth header")
    _, a, b = DEPTH_HEADER.unpack_from(data)
    if not encoding.startswith("32FC1"):
        return encoded(unrolled(held, MOST_PX), ".png") if rolled else trimmed(held)
    inverse = unrolled(held, MOST_PX) if rolled else stored(trimmed(held))
    if inverse.ndim != 2 or inverse.dtype != np.uint16 or not (np.isfinite(a) and np.isfinite(b) and a > 0):
        raise ImageError("its quantised depth is none")
    with np.errstate(divide="ignore"):
        return np.where(inverse > 0, a / (inverse.astype(np.float64) - b), np.nan)


def _pixels(message: Any) -> np.ndarray:
    """Pixels (h, w) or (h, w, channels) of a sensor_msgs/Image, in the machine's order of bytes. Raises ImageError."""
    if message.encoding not in LAYOUTS:
        known = ", ".join(LAYOUTS)
        raise ImageError(f"its encoding {str(message.encoding)[:40]!r} is not known: republish it as one of {known}")
    _, kind, channels, _ = LAYOUTS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if not (width > 0 and height > 0 and width * height <= MOST_PX):
        raise ImageError(f"its size of {width} x {height} pixels is out of range")
    if step < row_bytes or len(data) < step * (height - 1) + row_bytes:
        raise ImageError(f"its {len(data)} bytes are too few for {width} x {height} pixels of {message.encoding}")
    rows = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels.reshape(height, width, channels)
