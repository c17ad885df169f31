"""Clouds of points in files: .npy, .pcd, .ply, and .bin as KITTI and nuScenes have it (pure)."""

import io
import math
import re
import struct

import numpy as np

from prior_sg.services.ingest.core.clouds.lzf import decompressed
from prior_sg.services.ingest.core.clouds.sweep import MOST_POINTS, CloudError
from prior_sg.services.ingest.core.pixels import NPY_FAULTS

ENDINGS = (".npy", ".pcd", ".ply", ".bin")
PCD_TYPES = {"F": "f", "I": "i", "U": "u"}
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
KITTI_COLUMNS = ("x", "y", "z", "intensity")
NUSCENES_COLUMNS = (*KITTI_COLUMNS, "ring")
MOST_RINGS = 256
PCD_SIZES = struct.Struct("<II")  # of compressed data: as it is, and as it was
HEADER_BYTES = 1 << 16


def columns_of(data: bytes, ending: str) -> dict[str, np.ndarray]:
    """Named numbers of the points of a file, by its ending. Raises CloudError."""
    read = {".npy": _npy, ".pcd": _pcd, ".ply": _ply, ".bin": _kitti}[ending.lower()]
    try:
        return read(data)
    except CloudError:
        raise
    except (*NPY_FAULTS, KeyError, IndexError, StopIteration, struct.error) as error:
        raise CloudError(f"it is damaged: {str(error)[:100]}") from error


def _npy(data: bytes) -> dict[str, np.ndarray]:
    """A structured array by its names, or rows (…, 3) or more of x y z."""
    array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    if array.dtype.names:
        return _named(array)
    if array.ndim < 2 or not 3 <= array.shape[-1] <= 16 or array.dtype.kind not in "fiu":
        raise CloudError(f"its array has the shape {array.shape} and the type {array.dtype} instead of (n, 3) numbers")
    return {name: array[..., i] for i, name in enumerate("xyz")}


def _kitti(data: bytes) -> dict[str, np.ndarray]:
    """Rows of four numbers, or of five where the fifth can be a ring."""
    numbers = np.frombuffer(data, "<f4")
    columns: tuple[str, ...] = KITTI_COLUMNS
    if len(numbers) and len(numbers) % len(NUSCENES_COLUMNS) == 0:
        rings = numbers[len(KITTI_COLUMNS) :: len(NUSCENES_COLUMNS)]
        with np.errstate(invalid="ignore"):
            whole = bool((rings == np.floor(rings)).all() and (rings >= 0).all() and (rings < MOST_RINGS).all())
        columns = NUSCENES_COLUMNS if whole and (rings.any() or len(numbers) % len(columns)) else columns
    rows = numbers.reshape(-1, len(columns))
    return {name: rows[:, i] for i, name in enumerate(columns)}


def _pcd(data: bytes) -> dict[str, np.ndarray]:
    head = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[:HEADER_BYTES], re.MULTILINE)
    if head is None:
        raise CloudError("it has no header of a PCD file")
    lines = data[: head.start()].decode("ascii", errors="replace").splitlines()
    said = {words[0]: words[1:] for words in map(str.split, lines) if words and not words[0].startswith("#")}
    counts = [int(count) for count in said.get("COUNT", ["1"] * len(said["FIELDS"]))]
    kinds = [f"<{PCD_TYPES[kind]}{size}" for kind, size in zip(said["TYPE"], said["SIZE"], strict=True)]
    names = [f"{name}.{i}" if name == "_" else name for i, name in enumerate(said["FIELDS"])]
    fields = [
        (name, kind) if count == 1 else (name, kind, (count,))
        for name, kind, count in zip(names, kinds, counts, strict=True)
    ]
    points = int(said["POINTS"][0]) if "POINTS" in said else int(said["WIDTH"][0]) * int(said["HEIGHT"][0])
    form, body = head[1].decode(), data[head.end() :]
    if form == "binary":
        return _named(_rows(body, np.dtype(fields), points))
    if form == "ascii":
        return _named(_table(body, np.dtype(fields), points))
    if form == "binary_compressed":
        return _columns(body, np.dtype(fields), points)
    raise CloudError(f"its data is {form[:20]}: save it as binary (pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1)")


def _columns(body: bytes, row: np.dtype, points: int) -> dict[str, np.ndarray]:
    """Fields that follow each other, compressed. Raises CloudError."""
    _check_count(points)
    compressed, size = PCD_SIZES.unpack_from(body)
    held = body[PCD_SIZES.size : PCD_SIZES.size + compressed]
    if len(held) < compressed or size != points * row.itemsize:
        raise CloudError(f"its compressed data is cut off, or not of {points} points of {row.itemsize} bytes")
    data, at, found = decompressed(held, size), 0, dict[str, np.ndarray]()
    for name in row.names or ():
        kind = row[name]
        if not kind.shape:
            found[name] = np.frombuffer(data, kind, points, at)
        at += points * kind.itemsize
    return found


def _ply(data: bytes) -> dict[str, np.ndarray]:
    head = re.match(rb"ply\r?\n.*?^end_header\r?\n", data[:HEADER_BYTES], re.MULTILINE | re.DOTALL)
    if head is None:
        raise CloudError("it has no header of a PLY file")
    lines = [line.split() for line in head[0].decode("ascii", errors="replace").splitlines()]
    form = next(words[1] for words in lines if words[:1] == ["format"])
    starts = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    if not starts or lines[starts[0]][1] != "vertex":
        raise CloudError("its first element is not vertex")
    own = lines[starts[0] + 1 : starts[1] if len(starts) > 1 else None]
    order = PLY_ORDERS.get(form, "<")
    fields = [(words[-1], order + PLY_TYPES[words[1]]) for words in own if words[:1] == ["property"]]
    rows = _rows if form in PLY_ORDERS else _table
    return _named(rows(data[head.end() :], np.dtype(fields), int(lines[starts[0]][2])))


def _rows(body: bytes, row: np.dtype, points: int) -> np.ndarray:
    _check_count(points)
    if len(body) < points * row.itemsize:
        raise CloudError(f"its {len(body)} bytes are too few for {points} points of {row.itemsize} bytes")
    return np.frombuffer(body, row, points)


def _table(body: bytes, row: np.dtype, points: int) -> np.ndarray:
    """Points of a text, a line each; numbers with a fraction keep all their digits."""
    _check_count(points)
    lines = body.decode("ascii", errors="replace").splitlines()[:points]
    numbers = np.array([line.split() for line in lines if line.strip()], np.float64)
    kinds = [(name, *_wide(row[name])) for name in row.names or ()]
    width = sum(math.prod(shape) for _, _, shape in kinds)
    if len(numbers) != points or numbers.shape[1] < width:
        raise CloudError(f"it has {len(numbers)} lines instead of {points}, or too few numbers in them")
    table, at = np.empty(points, kinds), 0
    for name, kind, shape in kinds:
        held = numbers[:, at : at + math.prod(shape)].reshape(points, *shape)
        if kind.kind != "f" and not np.isfinite(held).all():
            raise CloudError(f"its {name[:20]} is a whole number by its header and none in its lines")
        table[name] = held
        at += math.prod(shape)
    return table


def _wide(kind: np.dtype) -> tuple[np.dtype, tuple[int, ...]]:
    """What holds a number that is written out, and how many make a field."""
    return np.dtype(np.float64) if kind.base.kind == "f" else kind.base, kind.shape


def _check_count(points: int) -> None:
    if not 0 < points <= MOST_POINTS:
        raise CloudError(f"it has {points} points instead of 1 to {MOST_POINTS}")


def _named(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Those of one number per point."""
    return {name: rows[name] for name in rows.dtype.names or () if rows.dtype[name].kind in "fiu"}
