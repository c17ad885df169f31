"""Whose surface each crop shows, kept frame by frame as long as no place near that surface changes (pure).

What a frame shows depends on the places around what it measured alone. So after a change the frames near it are looked
at again, and a robot that goes round a map it knows pays for what is new.
"""

from typing import NamedTuple

import msgspec
import numpy as np
import scipy

from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import inverse
from prior_sg.services.segmenter.core.evidence.kernel import Frame
from prior_sg.services.segmenter.core.slices import Parts

FRAMES = 1024  # frames that stand for all
CELLS = 300  # of a frame's surface that stand for all, about
NUDGE_M = 0.15  # from the surface towards the camera, so that a wall belongs to the side that it was seen from
REACH_M = 1.5  # surface further than this from a place's free sphere does not show it
SOFT_M = 0.3  # distance from the free sphere at which a place's part of a cell counts 1 / e
NEAREST = 3  # places that share a cell
ROUNDING_M = 1e-3  # by which a kept point may lie elsewhere
FRAME_VISITS = 2_000  # what looking at a frame takes, as `slices` counts, without its part for each place


class Spheres(NamedTuple):
    """Places by what they take of the surface: ids (place,) ascending, centres (place, 3) and radii (place,)."""

    ids: np.ndarray
    positions_m: np.ndarray
    radii_m: np.ndarray


class _Look(msgspec.Struct):
    """What one frame shows."""

    frame: Frame
    points_m: np.ndarray  # (cell, 3) float32
    limits_m: np.ndarray  # (cell,) float32: a place whose free sphere is further away takes no part in the cell
    counts: np.ndarray  # (crop,) places that each crop shows
    place_ids: np.ndarray  # (shown,) crop by crop
    shares: np.ndarray  # (shown,)


def sampled(frames: dict[int, Frame]) -> dict[int, Frame]:
    """All frames that hold crops, or a regular sample of them, by id."""
    kept = [number for number, frame in frames.items() if len(frame.sigmas_px)]
    return {number: frames[number] for number in kept[:: max(-(-len(kept) // FRAMES), 1)]}


class Shown:
    """Shares of the surfaces of frames, as they were found last."""

    def __init__(self) -> None:
        self.renewed = 0  # frames looked at since the start
        self._looks: dict[int, _Look] = {}  # by frame id
        self._places = Spheres(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))

    def shares(self, frames: dict[int, Frame], places: Spheres) -> Parts["scipy.sparse.csr_matrix"]:
        """Shares (crop, place) of each crop's measured surface that is each place's; crops frame by frame."""
        places = Spheres(places.ids, places.positions_m.astype(np.float64), places.radii_m.astype(np.float64))
        kept = {n: look for n, look in self._looks.items() if n in frames and frames[n] is look.frame}
        valid = self._untouched(kept, _changed(self._places, places))
        looks = {}
        for number, frame in frames.items():
            if number not in valid:
                yield FRAME_VISITS + len(places.ids) // 10
            looks[number] = valid[number] if number in valid else _look(frame, places)
        self.renewed += len(frames) - len(valid)
        self._looks, self._places = looks, places
        return _matrix(list(looks.values()), places.ids)

    @staticmethod
    def _untouched(looks: dict[int, _Look], changed: np.ndarray) -> dict[int, _Look]:
        """The looks that none of the `changed` spheres (sphere, 4) takes or took part in."""
        if not looks or not len(changed):
            return looks
        starts = np.cumsum([0, *(len(look.points_m) for look in looks.values())])
        points_m = np.concatenate([look.points_m for look in looks.values()])
        limits_m = np.concatenate([look.limits_m for look in looks.values()])
        touched = _touched(points_m, limits_m, starts, changed)
        return {n: look for (n, look), hit in zip(looks.items(), touched, strict=True) if not hit}


def _changed(before: Spheres, after: Spheres) -> np.ndarray:
    """Spheres (sphere, 4) of the places that are gone, new or other than before, as they were and as they are."""
    old, new = (np.column_stack((places.positions_m, places.radii_m)) for places in (before, after))
    _, at_old, at_new = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    same = (old[at_old] == new[at_new]).all(axis=1)
    return np.concatenate((np.delete(old, at_old[same], axis=0), np.delete(new, at_new[same], axis=0)))


def _look(frame: Frame, places: Spheres) -> _Look:
    """What one frame shows of the places."""
    rows, columns = frame.surface_m.shape
    step = max(round((rows * columns / CELLS) ** 0.5), 1)
    row, column = (grid.reshape(-1) for grid in np.mgrid[step // 2 : rows : step, step // 2 : columns : step])
    depths_m = frame.surface_m[row, column].astype(np.float64)
    measured = depths_m > 0
    row, column, depths_m = row[measured], column[measured], depths_m[measured]
    camera = frame.intrinsics
    u_px = (column + 0.5) * camera.width_px / columns - 0.5
    v_px = (row + 0.5) * camera.height_px / rows - 0.5
    x, y = (u_px - camera.cx_px) / camera.fx_px * depths_m, (v_px - camera.cy_px) / camera.fy_px * depths_m
    points_m = np.stack((x, y, depths_m), axis=1)
    distances_m = np.linalg.norm(points_m, axis=1, keepdims=True)
    points_m *= np.maximum(1 - NUDGE_M / np.maximum(distances_m, NUDGE_M), 0.0)
    world_from_camera = inverse(frame.camera_from_world)
    points_m = points_m @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    reach_m = float(distances_m.max(initial=0.0)) + REACH_M
    nearest, parts, limits_m = _nearest(
        points_m, places.positions_m, places.radii_m, world_from_camera[:3, 3].copy(), reach_m
    )
    offsets_px = np.abs(np.stack((u_px, v_px), axis=1)[None] - frame.centers_px[:, None])
    covers = (offsets_px < frame.sigmas_px[:, None, None]).all(axis=2)
    counts, at, shares = _summed(covers, nearest, parts, len(places.ids))
    return _Look(frame, points_m.astype(np.float32), limits_m.astype(np.float32), counts, places.ids[at], shares)


def _matrix(looks: list[_Look], ids: np.ndarray) -> "scipy.sparse.csr_matrix":
    """All that is shown (crop, place)."""
    if not looks:
        return scipy.sparse.csr_matrix((0, len(ids)))
    counts = np.concatenate([look.counts for look in looks])
    columns = np.searchsorted(ids, np.concatenate([look.place_ids for look in looks]))
    shares = np.concatenate([look.shares for look in looks])
    starts = np.concatenate(([0], np.cumsum(counts)))
    return scipy.sparse.csr_matrix((shares, columns, starts), shape=(len(counts), len(ids)))


@compiled()
def _nearest(points_m, positions_m, radii_m, camera_m, reach_m):  # noqa: ANN001, ANN202
    """Places (point, NEAREST) whose free spheres are nearest, their parts, which sum to one or are all zero, and the
    gap (point,) beyond which no place takes part."""
    near = np.empty(len(radii_m), np.int64)
    count = 0
    for place in range(len(radii_m)):
        distance = np.sqrt(((positions_m[place] - camera_m) ** 2).sum())
        if distance - radii_m[place] <= reach_m:
            near[count] = place
            count += 1
    places = np.zeros((len(points_m), NEAREST), np.int64)
    parts = np.zeros((len(points_m), NEAREST))
    limits_m = np.empty(len(points_m))
    for point in range(len(points_m)):
        gaps_m = np.full(NEAREST, REACH_M)
        x, y, z = points_m[point]
        for index in range(count):
            place = near[index]
            dx, dy, dz = positions_m[place, 0] - x, positions_m[place, 1] - y, positions_m[place, 2] - z
            limit = gaps_m[NEAREST - 1] + radii_m[place]
            square = dx * dx + dy * dy + dz * dz
            if square >= limit * limit:
                continue
            gap_m = np.sqrt(square) - radii_m[place]
            at = NEAREST - 1
            while at > 0 and gaps_m[at - 1] > gap_m:
                gaps_m[at], places[point, at] = gaps_m[at - 1], places[point, at - 1]
                at -= 1
            gaps_m[at], places[point, at] = gap_m, place
        limits_m[point] = gaps_m[NEAREST - 1]
        total = 0.0
        for at in range(NEAREST):
            if gaps_m[at] < REACH_M:
                parts[point, at] = np.exp(-max(gaps_m[at], 0.0) / SOFT_M)
                total += parts[point, at]
        if total > 0:
            parts[point] /= total
    return places, parts, limits_m


@compiled()
def _summed(covers, nearest, parts, places):  # noqa: ANN001, ANN202
    """Means of the parts over the cells that each crop covers (crop, cell): how many places each crop shows, these
    places, crop by crop, and their shares."""
    counts = np.zeros(len(covers), np.int64)
    most = min(nearest.size, places)
    found, shares = np.empty(len(covers) * most, np.int64), np.empty(len(covers) * most)
    slots = np.full(places, -1, np.int64)
    end = 0
    for crop in range(len(covers)):
        first = end
        weight = 1.0 / max(covers[crop].sum(), 1)
        for cell in range(covers.shape[1]):
            if not covers[crop, cell]:
                continue
            for at in range(nearest.shape[1]):
                part, place = parts[cell, at], nearest[cell, at]
                if part <= 0.0:
                    continue
                if slots[place] < 0:
                    slots[place], found[end], shares[end] = end, place, 0.0
                    end += 1
                shares[slots[place]] += weight * part
        for shown in range(first, end):
            slots[found[shown]] = -1
        counts[crop] = end - first
    return counts, found[:end].copy(), shares[:end].copy()


@compiled()
def _touched(points_m, limits_m, starts, spheres):  # noqa: ANN001, ANN202
    """Whether any of the spheres (sphere, 4) takes part in a cell of each look."""
    touched = np.zeros(len(starts) - 1, np.bool_)
    for look in range(len(touched)):
        first, end = starts[look], starts[look + 1]
        if first == end:
            continue
        low, high = points_m[first].astype(np.float64), points_m[first].astype(np.float64)
        for point in range(first + 1, end):
            for axis in range(3):
                low[axis] = min(low[axis], points_m[point, axis])
                high[axis] = max(high[axis], points_m[point, axis])
        for sphere in range(len(spheres)):
            away = 0.0
            for axis in range(3):
                at = spheres[sphere, axis]
                away += max(low[axis] - at, 0.0, at - high[axis]) ** 2
            if away > (spheres[sphere, 3] + REACH_M + ROUNDING_M) ** 2:
                continue
            for point in range(first, end):
                square = 0.0
                for axis in range(3):
                    square += (spheres[sphere, axis] - points_m[point, axis]) ** 2
                limit = limits_m[point] + spheres[sphere, 3] + ROUNDING_M
                if limit > 0 and square <= limit * limit:
                    touched[look] = True
                    break
            if touched[look]:
                break
    return touched
