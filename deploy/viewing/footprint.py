"""The ground that each region covers, as smooth meshes and outlines that touch and never overlap (pure).

A region's height field is the largest of its places' `radius - distance`, seen from above. A point belongs to the
region whose field is highest there, and to none where all are below zero. Borders are the zero lines of what is left,
found by marching squares; regions of other storeys do not compete.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene

PAD_M = 0.14  # spheres touch walls in single points: a little more covers the corners
SMALLEST_CELL_M, CELLS = 0.06, 420  # cell size, and cells along the longer side of the map from which it grows
SMOOTHING_CELLS = 1.6
MARGIN_CELLS = 6  # around everything, so that smoothing meets no end of the grid
STOREY_M = 1.6  # regions whose middles differ by more in height are on other storeys
STEP_M, LEVEL_M = 2.0, 0.05  # by which a grid moves, and floors differ
FAR = -9.0


@dataclass(frozen=True)
class Footprint:
    """The ground of one region; metres, world."""

    vertices: np.ndarray  # (vertex, 3) float32
    faces: np.ndarray  # (face, 3) uint32, seen from above
    outline: np.ndarray  # (segment, 2, 3) float32


@dataclass(frozen=True)
class _Field:
    """Heights over a window of a storey's grid."""

    corner: tuple[int, int]
    heights: np.ndarray  # (i, j) float32

    @property
    def window(self) -> tuple[slice, slice]:
        (i, j), (rows, columns) = self.corner, self.heights.shape
        return slice(i, i + rows), slice(j, j + columns)


class Grounds:
    """Footprints of one scene after another; those of regions around which nothing has changed are kept."""

    def __init__(self) -> None:
        self._fields: dict[int, tuple[bytes, _Field]] = {}  # by region, with what they were made of
        self._made: dict[int, tuple[bytes, Footprint | None]] = {}

    def of(self, scene: Scene) -> dict[int, Footprint]:
        """By region id; regions without places have none, nor those whose places lie all under others' higher ones."""
        rows = _rows_of_regions(scene)
        self._fields = {region: kept for region, kept in self._fields.items() if region in rows}
        self._made = {region: kept for region, kept in self._made.items() if region in rows}
        found: dict[int, Footprint | None] = {}
        for storey in _storeys(scene, rows):
            found |= self._of_storey(scene, {region: rows[region] for region in storey})
        return {region: footprint for region, footprint in found.items() if footprint is not None}

    def _of_storey(self, scene: Scene, rows: dict[int, np.ndarray]) -> dict[int, Footprint | None]:
        every = np.concatenate(list(rows.values()))
        grid, ground_m = _grid(scene, every), round(floor_m(scene, every) / LEVEL_M) * LEVEL_M
        fields = {region: self._field(scene, region, of, grid) for region, of in rows.items()}
        best, second, owner = _contest(fields)
        found = {}
        for region, field in fields.items():
            rival = np.where(owner[field.window] == region, second[field.window], best[field.window])
            signed = np.minimum(field.heights, field.heights - rival)
            key = b"".join((signed.tobytes(), repr((field.corner, grid, ground_m)).encode()))
            if region not in self._made or self._made[region][0] != key:
                self._made[region] = key, _footprint(signed, field.corner, grid, ground_m)
            found[region] = self._made[region][1]
        return found

    def _field(self, scene: Scene, region: int, rows: np.ndarray, grid: "_Grid") -> "_Field":
        columns = (scene.positions_m[rows], scene.radii_m[rows])
        key = b"".join((*(column.tobytes() for column in columns), repr(grid).encode()))
        if region not in self._fields or self._fields[region][0] != key:
            self._fields[region] = key, _field(*columns, grid)
        return self._fields[region][1]


def footprints(scene: Scene) -> dict[int, Footprint]:
    """The footprints of one scene, by region id."""
    return Grounds().of(scene)


def _footprint(signed: np.ndarray, corner: tuple[int, int], grid: "_Grid", ground_m: float) -> Footprint | None:
    plane, faces, segments = _contour(cv2.GaussianBlur(signed, (0, 0), SMOOTHING_CELLS))
    if not len(faces):
        return None
    origin_m = np.array(grid.low_m) + np.array(corner) * grid.cell_m
    plane_m, segments_m = plane * grid.cell_m + origin_m, segments * grid.cell_m + origin_m
    return Footprint(_lifted(plane_m, ground_m), faces, _lifted(segments_m, ground_m))


def floor_m(scene: Scene, rows: np.ndarray) -> float:
    """Height of the floor below some places: spheres of free space touch it."""
    return float(np.quantile(scene.positions_m[rows, 2] - scene.radii_m[rows], 0.1)) if len(rows) else 0.0


def _rows_of_regions(scene: Scene) -> dict[int, np.ndarray]:
    """Rows of each region's places."""
    order = np.argsort(scene.place_regions, kind="stable")
    regions, starts = np.unique(scene.place_regions[order], return_index=True)
    parts = np.split(order, starts[1:]) if len(starts) else []
    return {int(region): rows for region, rows in zip(regions, parts, strict=True) if region != NO_REGION}


def _storeys(scene: Scene, rows: dict[int, np.ndarray]) -> list[list[int]]:
    """Regions that lie at about the same height, from below."""
    middles = sorted((float(scene.positions_m[of, 2].mean()), region) for region, of in rows.items())
    storeys: list[list[int]] = []
    last_m = -np.inf
    for middle_m, region in middles:
        if middle_m - last_m > STOREY_M:
            storeys.append([])
        storeys[-1].append(region)
        last_m = middle_m
    return storeys


class _Grid(NamedTuple):
    """Cells of a storey. It moves and grows in steps, so that it stays the same while the map grows a little."""

    low_m: tuple[float, float]
    cell_m: float


def _grid(scene: Scene, rows: np.ndarray) -> _Grid:
    reach_m = float(scene.radii_m[rows].max()) + PAD_M
    low_m = scene.positions_m[rows, :2].min(axis=0) - reach_m
    extent_m = float((scene.positions_m[rows, :2].max(axis=0) + reach_m - low_m).max())
    cell_m = SMALLEST_CELL_M
    while cell_m * CELLS < extent_m:
        cell_m *= 2
    low_m = np.floor((low_m - MARGIN_CELLS * cell_m) / STEP_M) * STEP_M
    return _Grid((float(low_m[0]), float(low_m[1])), cell_m)


def _lifted(plane_m: np.ndarray, height_m: float) -> np.ndarray:
    return np.concatenate((plane_m, np.full((*plane_m.shape[:-1], 1), height_m)), axis=-1).astype(np.float32)


def _field(positions_m: np.ndarray, radii_m: np.ndarray, grid: _Grid) -> _Field:
    """The height field of some places on the window that holds their discs and a margin."""
    at = (positions_m[:, :2] - np.array(grid.low_m)) / grid.cell_m  # in cells
    radii = (radii_m + PAD_M) / grid.cell_m
    reach = int(np.ceil(radii.max())) + 1
    corner = np.maximum(np.floor(at.min(axis=0)).astype(int) - reach - MARGIN_CELLS, 0)
    size = np.ceil(at.max(axis=0)).astype(int) + reach + MARGIN_CELLS - corner
    heights = height_field((int(size[0]), int(size[1])), at - corner, radii)
    return _Field((int(corner[0]), int(corner[1])), heights * np.float32(grid.cell_m))


def height_field(shape: tuple[int, int], at: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """The largest `radius - distance` of some discs (disc, 2), (disc,) over cells; all in cells, FAR beyond them."""
    reach = int(np.ceil(radii.max())) + 1
    heights = np.full(shape, FAR, np.float32)
    raise_field = _by_place if len(at) < (2 * reach + 1) ** 2 else _by_step
    raise_field(heights, at, radii, reach)
    return heights


def _by_place(heights: np.ndarray, at: np.ndarray, radii: np.ndarray, reach: int) -> None:
    """Raise the field to the cone of each place in turn; all in cells."""
    for (i, j), radius in zip(at.tolist(), radii.tolist(), strict=True):
        top, left = max(round(i) - reach, 0), max(round(j) - reach, 0)
        part = heights[top : round(i) + reach + 1, left : round(j) + reach + 1]
        down = (np.arange(top, top + part.shape[0], dtype=np.float32) - i) ** 2
        along = (np.arange(left, left + part.shape[1], dtype=np.float32) - j) ** 2
        np.maximum(part, radius - np.sqrt(down[:, None] + along), out=part)


def _by_step(heights: np.ndarray, at: np.ndarray, radii: np.ndarray, reach: int) -> None:
    """The same for many places with small discs: one step from all of them at a time."""
    size = np.array(heights.shape)
    for step in np.argwhere(np.ones((2 * reach + 1, 2 * reach + 1))) - reach:
        cells = np.round(at).astype(int) + step
        inside = ((cells >= 0) & (cells < size)).all(axis=1)
        away = at[inside] - cells[inside]
        cones = radii[inside] - np.hypot(away[:, 0], away[:, 1])
        np.maximum.at(heights, tuple(cells[inside].T), cones.astype(np.float32))


def _contest(fields: dict[int, _Field]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per cell of the storey the highest field, the second highest, and whose the highest is."""
    rows = max(field.corner[0] + field.heights.shape[0] for field in fields.values())
    columns = max(field.corner[1] + field.heights.shape[1] for field in fields.values())
    best = np.full((rows, columns), FAR, np.float32)
    second, owner = best.copy(), np.full((rows, columns), NO_REGION, np.int64)
    for region, field in fields.items():
        top, next_, whose = best[field.window], second[field.window], owner[field.window]
        wins = field.heights > top
        next_[:] = np.where(wins, top, np.maximum(next_, field.heights))
        whose[wins] = region
        top[wins] = field.heights[wins]
    return best, second, owner


# Marching squares. Corners of a cell counter-clockwise from the lower one, the edge behind each, and per case what
# bounds the inside: corners 0..3 and crossings 4..7 of the edge behind corner 0..3.
CORNERS = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])


def _boundary(case: int) -> list[int]:
    inside = [bool(case >> corner & 1) for corner in range(4)]
    path: list[int] = []
    for corner in range(4):
        if inside[corner]:
            path.append(corner)
        if inside[corner] != inside[(corner + 1) % 4]:
            path.append(4 + corner)
    return path


BOUNDARIES = [_boundary(case) for case in range(16)]


def _contour(signed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The part of a field above zero: vertices (vertex, 2) in cells, faces (face, 3), outline (segment, 2, 2)."""
    signed = np.where(np.abs(signed) < 1e-6, np.float32(-1e-6), signed)
    values = np.stack([signed[i : signed.shape[0] - 1 + i, j : signed.shape[1] - 1 + j] for i, j in CORNERS])
    cases = ((values > 0) * (1 << np.arange(4))[:, None, None]).sum(axis=0)
    polygons, faces = [_runs(cases == 15)], []
    faces.append(_fans(0, polygons[0].shape))
    segments = [np.zeros((0, 2, 2))]
    count = polygons[0].shape[0] * polygons[0].shape[1]
    for case in range(1, 15):
        at = np.argwhere(cases == case)
        path = BOUNDARIES[case]
        points = _points(at, values[:, at[:, 0], at[:, 1]], path)
        polygons.append(points)
        faces.append(_fans(count, points.shape))
        count += points.shape[0] * points.shape[1]
        for here, there in zip(range(len(path)), [*range(1, len(path)), 0], strict=True):
            if path[here] >= 4 and path[there] >= 4:
                segments.append(points[:, [here, there]])
    vertices = np.concatenate([polygon.reshape(-1, 2) for polygon in polygons])
    return vertices, np.concatenate(faces).astype(np.uint32), np.concatenate(segments)


def _points(at: np.ndarray, values: np.ndarray, path: list[int]) -> np.ndarray:
    """Corners and crossings of some cells along a path (cell, step, 2)."""
    points = []
    for step in path:
        corner, after = CORNERS[step % 4], CORNERS[(step + 1) % 4]
        here, there = values[step % 4], values[(step + 1) % 4]
        share = np.zeros(len(at)) if step < 4 else here / (here - there)
        points.append(at + corner + share[:, None] * (after - corner))
    return np.stack(points, axis=1)


def _runs(full: np.ndarray) -> np.ndarray:
    """Cells that lie wholly inside, joined along j: rectangles (run, 4, 2)."""
    padded = np.pad(full, ((0, 0), (1, 1))).astype(np.int8)
    starts, ends = np.argwhere(np.diff(padded, axis=1) == 1), np.argwhere(np.diff(padded, axis=1) == -1)
    low, high = starts, np.column_stack((starts[:, 0] + 1, ends[:, 1])) if len(starts) else starts
    corners = (low, np.column_stack((high[:, 0], low[:, 1])), high, np.column_stack((low[:, 0], high[:, 1])))
    return np.stack(corners, axis=1).astype(float)


def _fans(first: int, shape: tuple[int, ...]) -> np.ndarray:
    """Triangles (face, 3) of polygons whose vertices follow each other from `first` on."""
    polygons, corners = shape[:2]
    starts = first + corners * np.arange(polygons)[:, None]
    fans = [np.concatenate((starts, starts + k, starts + k + 1), axis=1) for k in range(1, corners - 1)]
    return np.concatenate(fans) if fans else np.zeros((0, 3), int)
