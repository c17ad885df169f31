"""A voxel map that grows: hashed blocks of 16 x 16 x 16 voxels, read and written through dense windows (pure).

Blocks lie open near the camera. Those left behind are compressed, and opened again when anything reads or writes them:
the map does not change by it. When even the compressed blocks exceed the bound, the oldest are dropped for good.
"""

import itertools
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled

BLOCK = 16  # voxels along one side of a block
UNOBSERVED, FREE, OCCUPIED = 0, 1, 2
UNKNOWN_D2 = -1  # squared distance of an unobserved voxel
FAR_D2 = 32767  # squared distance of a free voxel farther from any obstacle than the field reaches


class Box(NamedTuple):
    """Half-open range of voxel indices; `low` and `high` are (3,) int64."""

    low: np.ndarray
    high: np.ndarray

    def grown(self, margin: int | np.ndarray) -> "Box":
        """The box with `margin` voxels more on every side."""
        return Box(self.low - margin, self.high + margin)

    def clipped(self, other: "Box") -> "Box":
        """The part inside `other`."""
        return Box(np.maximum(self.low, other.low), np.minimum(self.high, other.high))

    def contains(self, voxels: np.ndarray) -> np.ndarray:
        """Whether each voxel (..., 3) lies inside."""
        return np.all((voxels >= self.low) & (voxels < self.high), axis=-1)

    @staticmethod
    def around(voxels: np.ndarray) -> "Box":
        """The smallest box that holds all voxels (n, 3), n > 0."""
        return Box(*_extent(voxels))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along each axis, never negative."""
        size = np.maximum(self.high - self.low, 0)
        return int(size[0]), int(size[1]), int(size[2])


@compiled()
def _extent(voxels):  # noqa: ANN001, ANN202
    low, high = voxels[0].copy(), voxels[0] + 1
    for axis in range(3):
        least = greatest = voxels[0, axis]
        for n in range(len(voxels)):
            least, greatest = min(least, voxels[n, axis]), max(greatest, voxels[n, axis])
        low[axis], high[axis] = least, greatest + 1
    return low, high


def _cube(dtype: str, fill: int = 0) -> np.ndarray:
    return np.full((BLOCK, BLOCK, BLOCK), fill, dtype)


@dataclass
class Block:
    """One cube of voxels. What is measured: `tsdf_m`, `weight`, `label`. What follows from it: the rest."""

    sdf: np.ndarray = field(default_factory=lambda: _cube("int32"))  # sum of signed distances, shares of truncation
    weight: np.ndarray = field(default_factory=lambda: _cube("int32"))  # sum of weights
    label: np.ndarray = field(default_factory=lambda: _cube("uint8"))  # UNOBSERVED, FREE, OCCUPIED
    d2: np.ndarray = field(default_factory=lambda: _cube("int16", UNKNOWN_D2))  # squared voxels to the nearest obstacle
    offset: np.ndarray = field(default_factory=lambda: np.zeros((BLOCK, BLOCK, BLOCK, 3), "int8"))  # voxel - obstacle
    basis: np.ndarray = field(default_factory=lambda: _cube("uint8"))  # basis points of a GVD voxel, 0 = not on the GVD


_EMPTY = Block()
FIELDS = tuple(_EMPTY.__dataclass_fields__)
MEASURED = ("sdf", "weight", "label")  # what a grid holds whose distances lie in another one ...
DERIVED = ("label", "d2", "offset", "basis")  # ... and that other one
for _name in FIELDS:
    getattr(_EMPTY, _name).setflags(write=False)

BlockKey = tuple[int, int, int]
Part = tuple[slice, slice, slice]


class VoxelGrid:
    """Blocks by index. Voxel i covers [i, i + 1) * voxel_m in the world."""

    def __init__(self, names: tuple[str, ...] = FIELDS) -> None:
        self.names = names  # the fields that it holds; the others stay blank, and cannot be written
        self.blocks: dict[BlockKey, Block] = {}
        self._packed: dict[BlockKey, bytes] = {}  # oldest first
        self.packed_bytes = 0
        self._low = np.zeros(3, np.int64)
        self._high = np.zeros(3, np.int64)

    @property
    def bounds(self) -> Box:
        """The smallest box of voxels that holds every block there was."""
        return Box(self._low * BLOCK, self._high * BLOCK)

    @property
    def size_bytes(self) -> int:
        """Memory of all voxels, open and compressed."""
        return len(self.blocks) * self.block_bytes + self.packed_bytes

    @property
    def block_bytes(self) -> int:
        """Memory of an open block."""
        return sum(getattr(_EMPTY, name).nbytes for name in self.names)

    def blank(self) -> Block:
        """A block without observations that is in no grid yet."""
        return Block(**{name: getattr(_EMPTY, name) for name in FIELDS if name not in self.names})

    def block(self, key: BlockKey) -> Block | None:
        """A block, opened if it was compressed; None if there is none."""
        data = self._packed.pop(key, None) if self._packed else None
        if data is not None:
            self.packed_bytes -= len(data)
            self.blocks[key] = self._opened(data)
        return self.blocks.get(key)

    def insert(self, key: BlockKey, block: Block) -> None:
        """Add a block that is not there yet."""
        index = np.array(key, np.int64)
        first = not self.blocks and not self._packed
        self._low = index if first else np.minimum(self._low, index)
        self._high = index + 1 if first else np.maximum(self._high, index + 1)
        self.blocks[key] = block

    def leave(self, center: np.ndarray, radius: float, limit_bytes: float) -> list[BlockKey]:
        """Compress blocks whose centre is farther than `radius` voxels from `center`; drop the oldest beyond the limit.

        Returns the keys of the dropped blocks. The limit counts open blocks too, which are never dropped.
        """
        low, high = self.bounds
        farthest = np.linalg.norm(np.maximum(np.abs(low - center), np.abs(high - center)))
        keys = list(self.blocks) if farthest > radius else []
        distances = np.linalg.norm((np.array(keys).reshape(-1, 3) + 0.5) * BLOCK - center, axis=1)
        for index in np.flatnonzero(distances > radius).tolist():
            data = self._squeezed(self.blocks.pop(keys[index]))
            self._packed[keys[index]] = data
            self.packed_bytes += len(data)
        dropped = []
        while self._packed and self.size_bytes > limit_bytes:
            oldest = next(iter(self._packed))
            self.packed_bytes -= len(self._packed.pop(oldest))
            dropped.append(oldest)
        return dropped

    def gather(self, name: str, box: Box, fill: int = 0) -> np.ndarray:
        """Dense copy of one field inside `box`; `fill` where there is no block."""
        return self.gather_all({name: fill}, box)[0]

    def gather_all(self, fills: Mapping[str, int], box: Box) -> list[np.ndarray]:
        """Dense copies of several fields inside `box`, in the order of `fills`."""
        windows = []
        for name, fill in fills.items():
            sample = getattr(_EMPTY, name)
            windows.append(np.full((*box.shape, *sample.shape[3:]), fill, sample.dtype))
        for block, outer, inner in self._overlaps(box):
            for name, window in zip(fills, windows, strict=True):
                window[outer] = getattr(block, name)[inner]
        return windows

    def scatter(self, windows: Mapping[str, np.ndarray], box: Box) -> None:
        """Write fields inside `box` back; voxels without a block are left out."""
        for block, outer, inner in self._overlaps(box):
            for name, window in windows.items():
                getattr(block, name)[inner] = window[outer]

    def forget(self, box: Box) -> None:
        """Nothing inside `box` was ever observed; blocks that hold nothing else are gone."""
        blank = {name: getattr(_EMPTY, name) for name in self.names}
        blank = {name: np.broadcast_to(one[0, 0, 0], (*box.shape, *one.shape[3:])) for name, one in blank.items()}
        self.scatter(blank, box)
        ends = zip((box.low // BLOCK).tolist(), (-(-box.high // BLOCK)).tolist(), strict=True)
        for x, y, z in itertools.product(*(range(low, high) for low, high in ends)):
            block = self.block((x, y, z))
            if block is not None and not block.label.any():
                del self.blocks[x, y, z]

    def voxels_with(self, label: int) -> np.ndarray:
        """Indices (n, 3) of all voxels with this label, in ascending order."""
        parts = [np.argwhere(b.label == label) + np.array(key) * BLOCK for key, b in self._all()]
        voxels = np.concatenate(parts) if parts else np.empty((0, 3), np.int64)
        return voxels[np.lexsort(voxels.T[::-1])]

    def _all(self) -> Iterator[tuple[BlockKey, Block]]:
        """Every block; compressed ones stay compressed."""
        yield from self.blocks.items()
        for key, data in self._packed.items():
            yield key, self._opened(data)

    def _squeezed(self, block: Block) -> bytes:
        return zlib.compress(b"".join(getattr(block, name).tobytes() for name in self.names), 1)

    def _opened(self, data: bytes) -> Block:
        raw, start, block = zlib.decompress(data), 0, self.blank()
        for name in self.names:
            sample = getattr(_EMPTY, name)
            values = np.frombuffer(raw, sample.dtype, sample.size, start).reshape(sample.shape).copy()
            setattr(block, name, values)
            start += sample.nbytes
        return block

    def _overlaps(self, box: Box) -> list[tuple[Block, Part, Part]]:
        """Blocks that meet `box`, each with its part of the window and its part of the block."""
        axes = [_axis_overlaps(low, high) for low, high in zip(box.low.tolist(), box.high.tolist(), strict=True)]
        found: list[tuple[Block, Part, Part]] = []
        block_at = self.block if self._packed else self.blocks.get
        for bx, ox, ix in axes[0]:
            for by, oy, iy in axes[1]:
                for bz, oz, iz in axes[2]:
                    block = block_at((bx, by, bz))
                    if block is not None:
                        found.append((block, (ox, oy, oz), (ix, iy, iz)))
        return found


def _axis_overlaps(low: int, high: int) -> list[tuple[int, slice, slice]]:
    overlaps = []
    for index in range(low // BLOCK, -(-high // BLOCK)):
        start, stop = max(low, index * BLOCK), min(high, (index + 1) * BLOCK)
        overlaps.append((index, slice(start - low, stop - low), slice(start - index * BLOCK, stop - index * BLOCK)))
    return overlaps
