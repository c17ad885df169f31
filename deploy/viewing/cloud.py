"""Coloured points of the map, from the depth and colour images of its keyframes (pure).

Each keyframe adds the points that no earlier one has covered, so that what was sent stays as it is. A corrected pose
moves the points of its keyframe. When there are too many, cells double and everything is thinned once.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from prior_sg.deploy.viewing.shapes import Picture, Points
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.images import MAX_PRINCIPAL_OFFSET, color_of, depth_of

CELL_M, MOST_POINTS = 0.05, 300_000
MOST_PIXELS = 160 * 120  # of a depth image that are looked at
NEAR_M, FAR_M = 0.2, 6.0  # farther depth is too noisy for a calm picture
GROUP = 16  # keyframes whose points are one shape
STEEP = 0.05  # depth that changes more from pixel to pixel, relative to itself, is the rim of something


@dataclass
class _Part:
    """Points of one keyframe."""

    stamp_ns: int
    world_from_camera: np.ndarray  # (4, 4)
    points_m: np.ndarray  # (point, 3) float32, world
    colors: np.ndarray  # (point, 3) uint8
    cells: np.ndarray  # (point,) int64


class Cloud:
    """All points so far."""

    def __init__(self) -> None:
        self._parts: dict[int, _Part] = {}  # by frame id
        self._cell_m = CELL_M
        self._taken: set[int] = set()

    def __len__(self) -> int:
        return sum(len(part.points_m) for part in self._parts.values())

    def __contains__(self, frame_id: int) -> bool:
        return frame_id in self._parts

    def add(self, keyframe: Keyframe) -> None:
        """Take the points of one keyframe. Raises ImageFault."""
        if keyframe.frame_id in self._parts:
            return
        points_m, colors = points_of(keyframe)
        cells = _cells(points_m, self._cell_m)
        _, first = np.unique(cells, return_index=True)
        new = [row for row in first.tolist() if int(cells[row]) not in self._taken]
        self._taken.update(cells[new].tolist())
        self._parts[keyframe.frame_id] = _Part(
            keyframe.stamp_ns, keyframe.world_from_camera, points_m[new], colors[new], cells[new]
        )
        if len(self) > MOST_POINTS:
            self._thin()

    def _thin(self) -> None:
        self._cell_m *= 2
        self._taken = set()
        for part in self._parts.values():
            part.cells = _cells(part.points_m, self._cell_m)
            _, first = np.unique(part.cells, return_index=True)
            kept = [row for row in first.tolist() if int(part.cells[row]) not in self._taken]
            self._taken.update(part.cells[kept].tolist())
            part.points_m, part.colors, part.cells = part.points_m[kept], part.colors[kept], part.cells[kept]

    def move(self, poses: dict[int, np.ndarray]) -> None:
        """Give keyframes, by frame id, their corrected world_from_camera (4, 4)."""
        for frame_id, pose in poses.items():
            if part := self._parts.get(frame_id):
                motion = pose @ np.linalg.inv(part.world_from_camera)
                part.points_m = (part.points_m @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)
                part.world_from_camera = pose

    def picture(self, highest_m: float = np.inf, until_ns: float = np.inf) -> Picture:
        """What lies no higher and was seen by then, a shape for some keyframes each."""
        picture: Picture = {}
        frames = sorted(frame for frame, part in list(self._parts.items()) if part.stamp_ns <= until_ns)  # others add
        for group in sorted({frame // GROUP for frame in frames}):
            parts = [self._parts[frame] for frame in frames if frame // GROUP == group]
            points_m, colors = (
                np.concatenate([getattr(part, name) for part in parts]) for name in ("points_m", "colors")
            )
            low = points_m[:, 2] <= highest_m
            if low.any():
                picture[f"/map/{group}"] = Points(points_m[low], colors[low], self._cell_m * 1.1)
        return picture

    def floor_m(self, below_m: float) -> float:
        """Height of the fullest layer below a height; that height where nothing lies below."""
        heights = [part.points_m[part.points_m[:, 2] < below_m, 2] for part in self._parts.values()]
        every = np.concatenate([np.zeros(0, np.float32), *heights])
        if not len(every):
            return below_m
        layers, counts = np.unique(np.round(every / 0.1).astype(int), return_counts=True)
        return float(layers[counts.argmax()] * 0.1)


def points_of(keyframe: Keyframe) -> tuple[np.ndarray, np.ndarray]:
    """Points (point, 3) float32 in the world and their colours (point, 3) uint8."""
    depth_m, color = depth_of(keyframe, MAX_PRINCIPAL_OFFSET), color_of(keyframe)
    lens = keyframe.intrinsics
    stride = max(1, round((depth_m.size / MOST_PIXELS) ** 0.5))
    rows, columns = np.mgrid[0 : depth_m.shape[0] : stride, 0 : depth_m.shape[1] : stride]
    z = depth_m[rows, columns]
    seen = (z > NEAR_M) & (z < FAR_M) & ~_rims(z)
    z, rows, columns = z[seen], rows[seen], columns[seen]
    points = _rays(lens, rows, columns) * z[:, None]
    pose = keyframe.world_from_camera
    return (points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32), color[rows, columns]


def _rims(z: np.ndarray) -> np.ndarray:
    """Pixels beside a jump of depth: what lies between near and far is nowhere."""
    rims = np.zeros(z.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(z, axis=axis)) > STEEP * np.maximum(*(np.delete(z, end, axis=axis) for end in (0, -1)))
        for side in ((1, 0), (0, 1)):
            rims |= np.pad(jump, [side if axis == d else (0, 0) for d in (0, 1)])
    return rims


def _rays(lens: Intrinsics, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    x, y = (columns - lens.cx_px) / lens.fx_px, (rows - lens.cy_px) / lens.fy_px
    return np.stack((x, y, np.ones_like(x)), axis=1)


def small_image(keyframe: Keyframe, width_px: int) -> np.ndarray:
    """The colour image, no wider (row, column, 3). Raises ImageFault."""
    image = color_of(keyframe)
    scale = min(1.0, width_px / image.shape[1])
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _cells(points_m: np.ndarray, cell_m: float) -> np.ndarray:
    """A number per cell of a grid; 21 bits an axis."""
    cells = np.floor(points_m / cell_m).astype(np.int64) & 0x1FFFFF
    return cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2]
