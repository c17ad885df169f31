"""Sizes and ends of compressed images from their headers, without decoding them (pure)."""

import re
import struct
from collections.abc import Iterator

from prior_sg.schemas.codec import File

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 … SOF15 without tables and extensions
JPEG_SCAN, JPEG_END = 0xDA, 0xD9
JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])")  # in scan data: neither stuffing, padding nor a restart
BARE_MARKERS = frozenset({0xFF, 0x01}) | frozenset(range(0xD0, 0xD8))
CUT_OFF = "it is cut off"


class ImageError(ValueError):
    """The data is not a whole PNG or JPEG file."""


def is_sized(data: File) -> bool:
    """Whether the data begins as one of the formats that are measured here."""
    return _is_png(data) or _is_jpeg(data)


def told_size(data: File) -> tuple[int, int]:
    """Width and height in pixels as the header of a PNG or JPEG file says, whole or not. Raises ImageError."""
    if not is_sized(data):
        raise ImageError("it is neither a PNG nor a JPEG file")
    width_px, height_px, _ = _png_size(data) if _is_png(data) else _jpeg_size(data)
    return width_px, height_px


def image_size(data: File) -> tuple[int, int, int]:
    """Width and height in pixels and bits per channel of a whole PNG or JPEG file. Raises ImageError."""
    image_end(data)
    return _png_size(data) if _is_png(data) else _jpeg_size(data)


def trimmed(data: bytes) -> bytes:
    """A PNG or JPEG file without what follows its end: padding, a film, a second picture. Raises ImageError."""
    end = image_end(data)
    return data if end == len(data) else data[:end]


def image_end(data: File) -> int:
    """Where a PNG or JPEG file ends; more may follow. Raises ImageError."""
    if _is_png(data):
        return _png_end(data)
    if _is_jpeg(data):
        return _jpeg_end(data)
    raise ImageError("it is neither a PNG nor a JPEG file")


def _is_png(data: File) -> bool:
    return data[: len(PNG_MAGIC)] == PNG_MAGIC


def _is_jpeg(data: File) -> bool:
    return data[: len(JPEG_MAGIC)] == JPEG_MAGIC


def _png_end(data: File) -> int:
    start = len(PNG_MAGIC)
    while start + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, start)
        start += 12 + length
        if kind == b"IEND" and start <= len(data):
            return start
    raise ImageError(CUT_OFF)


def _jpeg_end(data: File) -> int:
    """The end marker that belongs to the picture: not one of a thumbnail in its header or of a picture behind it."""
    start = 2
    while start + 2 <= len(data) and data[start] == 0xFF:
        marker = data[start + 1]
        if marker == JPEG_END:
            return start + 2
        if marker in BARE_MARKERS:  # padding, and markers without a segment
            start += 1 if marker == 0xFF else 2
            continue
        start += 2 + int.from_bytes(data[start + 2 : start + 4], "big")
        if marker == JPEG_SCAN:
            found = JPEG_MARKER.search(data, start)
            if found is None:
                break
            start = found.end() - 2
    raise ImageError(CUT_OFF)


def _png_size(data: File) -> tuple[int, int, int]:
    if data[12:16] != b"IHDR" or len(data) < 33:
        raise ImageError("it has no header")
    width_px, height_px, bits = struct.unpack_from(">IIB", data, 16)
    return width_px, height_px, bits


def _jpeg_size(data: File) -> tuple[int, int, int]:
    for marker, start, _ in jpeg_segments(data):
        if marker in JPEG_FRAME_MARKERS and start + 9 <= len(data):
            bits, height_px, width_px = struct.unpack_from(">BHH", data, start + 4)
            return width_px, height_px, bits
    raise ImageError("it has no frame header")


def jpeg_segments(data: File) -> Iterator[tuple[int, int, int]]:
    """Marker, start and end of each segment of a JPEG header; the last one, the scan, ends with the data."""
    start = 2
    while start + 4 <= len(data) and data[start] == 0xFF:
        if data[start + 1] == 0xFF:  # padding
            start += 1
            continue
        marker, length = data[start + 1], int.from_bytes(data[start + 2 : start + 4], "big")
        end = len(data) if marker == JPEG_SCAN else start + 2 + length
        yield marker, start, end
        start = end
