"""Sizes of compressed images from their headers, without decoding them (pure)."""

import struct
from collections.abc import Iterator

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 … SOF15 without tables and extensions
JPEG_SCAN = 0xDA
JPEG_PADDING = 1024  # bytes some cameras leave behind the end marker


class ImageError(ValueError):
    """The data is not a whole PNG or JPEG file."""


def image_size(data: bytes) -> tuple[int, int, int]:
    """Width and height in pixels and bits per channel of a PNG or JPEG file. Raises ImageError."""
    if data.startswith(PNG_MAGIC):
        return _png_size(data)
    if data.startswith(JPEG_MAGIC):
        return _jpeg_size(data)
    raise ImageError("it is neither a PNG nor a JPEG file")


def _png_size(data: bytes) -> tuple[int, int, int]:
    if len(data) < 33 or b"IEND" not in data[-12:]:
        raise ImageError("it is cut off")
    width_px, height_px, bits = struct.unpack_from(">IIB", data, 16)
    return width_px, height_px, bits


def _jpeg_size(data: bytes) -> tuple[int, int, int]:
    if b"\xff\xd9" not in data[-JPEG_PADDING:]:
        raise ImageError("it is cut off")
    for marker, start, _ in jpeg_segments(data):
        if marker in JPEG_FRAME_MARKERS and start + 9 <= len(data):
            bits, height_px, width_px = struct.unpack_from(">BHH", data, start + 4)
            return width_px, height_px, bits
    raise ImageError("it has no frame header")


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Marker, start and end of each segment of a JPEG header; the last one, the scan, ends with the data."""
    start = 2
    while start + 4 <= len(data) and data[start] == 0xFF:
        marker, length = data[start + 1], int.from_bytes(data[start + 2 : start + 4], "big")
        end = len(data) if marker == JPEG_SCAN else start + 2 + length
        yield marker, start, end
        start = end
