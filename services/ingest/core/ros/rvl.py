"""Depth images as compressedDepth's RVL has them: runs of zeros and of differences, in nibbles (pure).

A. Wilson, Fast Lossless Depth Image Compression, ISS 2017. A number is nibbles of three bits, the lowest first, each
but the last with its fourth bit set; nibbles stand in little-endian words of 32 bits from the highest. How many zeros,
how many others, then each of these as its difference to the one before, with the sign in the lowest bit.
"""

import struct

import numpy as np

from prior_sg.services.headers import ImageError

SIZE = struct.Struct("<II")  # width and height
MOST_NIBBLES = 11  # of a number of 32 bits


def unrolled(data: bytes, most_px: int) -> np.ndarray:
    """Pixels (h, w) uint16. Raises ImageError."""
    if len(data) < SIZE.size:
        raise ImageError("its RVL data has no size")
    width, height = SIZE.unpack_from(data)
    if not 0 < width * height <= most_px:
        raise ImageError(f"its size of {width} x {height} pixels is out of range")
    numbers = _numbers(data[SIZE.size :])
    pixels, at, done, last = np.zeros(width * height, np.uint16), 0, 0, 0
    while done < len(pixels):
        if at + 2 > len(numbers):
            raise ImageError(f"its RVL data ends after {done} of {len(pixels)} pixels")
        zeros, others = int(numbers[at]), int(numbers[at + 1])
        at, done = at + 2, done + zeros
        if done + others > len(pixels) or at + others > len(numbers):
            raise ImageError(f"its RVL data does not fit {width} x {height} pixels")
        if others:
            signed = numbers[at : at + others]
            values = last + np.cumsum((signed >> 1) ^ -(signed & 1))
            pixels[done : done + others] = values.astype(np.uint16)
            last, at, done = int(values[-1]), at + others, done + others
    return pixels.reshape(height, width)


def _numbers(data: bytes) -> np.ndarray:
    """All numbers (n,) int64 of a stream of nibbles. Raises ImageError."""
    words = np.frombuffer(data + bytes(-len(data) % 4), "<u4")
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        return np.empty(0, np.int64)
    starts = np.concatenate(([0], ends[:-1] + 1))
    lengths = ends - starts + 1
    if lengths.max() > MOST_NIBBLES:
        raise ImageError("its RVL data holds a number of more than 32 bits")
    places = np.arange(ends[-1] + 1) - np.repeat(starts, lengths)
    return np.add.reduceat((nibbles[: ends[-1] + 1] & 7) << (3 * places), starts)
