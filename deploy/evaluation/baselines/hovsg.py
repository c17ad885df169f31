"""Baseline HOV-SG (Werby et al. 2024): floors from a height histogram, rooms by watershed of the plan, names by votes.

Rooms are where walls, seen from above, enclose space; what a room is called is decided afterwards by its views.

HOV-SG works on points 0.02 m apart and a plan of 0.05 m. Our map has coarser voxels, so each occupied voxel stands for
the cells of the plan that it covers, and the sizes in cells keep their meaning. The histogram spans whole cells, so the
scale error of HOV-SG's back-projection does not arise.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage, signal
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION

from .common import NO_LABEL, Answer, Inputs, Views, similarities

BACKGROUND = 1  # watershed marker of the corner outside the building


@dataclass(frozen=True)
class Config:
    """HOV-SG's values."""

    grid_m: float = 0.05  # plan
    height_bin_m: float = 0.01  # height histogram
    height_sigma_bins: float = 2.0
    peak_gap_m: float = 0.2
    peak_percentile: float = 90.0
    peak_cluster_m: float = 1.0
    wall_from_m: float = 1.5  # walls are what stands this high above the floor
    wall_below_ceiling_m: float = 0.3  # up to this far below the ceiling
    inside_below_ceiling_m: float = 0.2
    wall_share: float = 0.25  # of the densest cell
    pad_cells: int = 10
    min_seed_m: float = 0.5  # side of the smallest square that seeds a room
    view_clusters: int = 10
    standardised: bool = False  # views vote by standardised similarity instead of cosine


# Tuned on split dev (mean of F1_S and penalised mIoU_S, with our segmenter's concepts). Tried: both scales of
# similarity; wall_share 0.1, 0.25, 0.4; wall_from_m 1.0, 1.5.
TUNED = Config(standardised=True, wall_share=0.1)


class Floor(NamedTuple):
    """One storey: slab and ceiling heights, world."""

    low_m: float
    high_m: float


class Plan(NamedTuple):
    """Rooms of one floor on a grid: 0 = none, then 1, 2, ..."""

    rooms: np.ndarray  # (x cell, y cell)
    origin_m: np.ndarray  # (2,) corner of cell (0, 0)
    cell_m: float

    def cells_m(self, room: int) -> np.ndarray:
        """Centres (n, 2) of a room's cells."""
        return (np.argwhere(self.rooms == room) + 0.5) * self.cell_m + self.origin_m


def segment(inputs: Inputs, cfg: Config) -> Answer:
    """Floors, rooms of each floor, places by footprint, names by votes of the views inside.

    Places outside all rooms, and those on no floor, stay without region.
    """
    regions = np.full(len(inputs.place_ids), NO_REGION, np.int64)
    labels = [NO_LABEL] * len(regions)
    points_m = (inputs.voxels.occupied.astype(float) + 0.5) * inputs.voxels.voxel_m
    first = 0
    for floor in floors(points_m[:, 2], inputs.voxels.voxel_m, cfg):
        plan = rooms(inputs.voxels, floor, cfg)
        names = name_rooms(plan, _on_floor(inputs.views, floor), inputs, cfg)
        height_m = inputs.positions_m[:, 2]
        for row in np.flatnonzero((height_m >= floor.low_m) & (height_m < floor.high_m)).tolist():
            room = room_of(plan, inputs.positions_m[row, :2], float(inputs.radii_m[row]))
            if room:
                regions[row], labels[row] = first + room - 1, names[room - 1]
        first += len(names)
    return Answer(labels, regions)


def floors(heights_m: np.ndarray, voxel_m: float, cfg: Config) -> list[Floor]:
    """Storeys between the slabs that stand out in the histogram of the occupied voxels' heights (voxel,).

    A voxel counts evenly in all bins that it covers. Peaks closer than `peak_cluster_m` form one slab: of the first and
    last slab the strongest peak counts, of those between the two strongest (ceiling below, floor above). Where that
    leaves no pair, all is one storey (HOV-SG fails there, its issue 33).
    """
    if not len(heights_m):
        return []
    low_m, high_m = float(heights_m.min() - voxel_m / 2), float(heights_m.max() + voxel_m / 2)
    per_voxel = max(round(voxel_m / cfg.height_bin_m), 1)
    layers = np.bincount(np.rint((heights_m - heights_m.min()) / voxel_m).astype(np.int64))
    margin = round(cfg.peak_gap_m / cfg.height_bin_m)  # lets a slab at either end be a peak
    histogram = np.pad(np.repeat(layers.astype(float), per_voxel), margin)
    density = ndimage.gaussian_filter1d(histogram, cfg.height_sigma_bins)
    threshold = np.percentile(density[margin:-margin], cfg.peak_percentile)
    peaks, found = signal.find_peaks(density, distance=margin, height=threshold)
    at_m = low_m + (peaks - margin + 0.5) * voxel_m / per_voxel
    slabs = np.split(np.arange(len(peaks)), np.flatnonzero(np.diff(at_m) > cfg.peak_cluster_m) + 1)
    if len(slabs) < 2:
        return [Floor(low_m, high_m)]
    bounds_m: list[float] = []
    for index, slab in enumerate(slabs):
        count = 1 if index in {0, len(slabs) - 1} else 2
        strongest = slab[np.argsort(-found["peak_heights"][slab], kind="stable")[:count]]
        bounds_m += sorted(at_m[strongest].tolist())
    bounds_m[0], bounds_m[-1] = (bounds_m[0] + low_m) / 2, (bounds_m[-1] + high_m) / 2
    return [Floor(a, b) for a, b in zip(bounds_m[::2], bounds_m[1::2], strict=False)]


def rooms(voxels: VoxelMap, floor: Floor, cfg: Config) -> Plan:
    """Rooms by watershed: seeds are where the blurred distance from walls exceeds Otsu's threshold."""
    wall_counts, inside_counts, origin_m = _plans(voxels, floor, cfg)
    blurred = cv2.GaussianBlur(_to_bytes(wall_counts), (5, 5), 1)
    dense = np.where(blurred > cfg.wall_share * blurred.max(), 255, 0).astype(np.uint8)
    walls = cv2.morphologyEx(dense, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    rect = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
    outside = cv2.bitwise_not(_inside(inside_counts))
    blocked = cv2.morphologyEx(cv2.max(walls, outside), cv2.MORPH_CLOSE, rect, iterations=2)
    distance = _to_bytes(cv2.distanceTransform(cv2.bitwise_not(blocked), cv2.DIST_L2, 5))
    _, peaks = cv2.threshold(cv2.GaussianBlur(distance, (11, 1), 10), 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(peaks, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    seeds = [outline for outline in contours if cv2.contourArea(outline) > (cfg.min_seed_m / cfg.grid_m) ** 2]
    markers = np.zeros(blocked.shape, np.int32)
    for number, outline in enumerate(seeds, BACKGROUND + 1):
        cv2.drawContours(markers, [outline], -1, number, cv2.FILLED)
    cv2.circle(markers, (3, 3), 1, BACKGROUND, cv2.FILLED)
    cv2.watershed(cv2.cvtColor(blocked, cv2.COLOR_GRAY2BGR), markers)
    return Plan(np.maximum(markers - BACKGROUND, 0), origin_m, cfg.grid_m)


def room_of(plan: Plan, position_m: np.ndarray, radius_m: float) -> int:
    """Room that holds most cells of a place's footprint, a disc (2,) seen from above; 0 = none has any."""
    reach = int(np.ceil(radius_m / plan.cell_m))
    middle = np.floor((position_m - plan.origin_m) / plan.cell_m).astype(np.int64)
    cells = middle + np.argwhere(np.ones((2 * reach + 1,) * 2)) - reach
    near = np.linalg.norm((cells + 0.5) * plan.cell_m + plan.origin_m - position_m, axis=1) <= radius_m
    near |= (cells == middle).all(axis=1)
    near &= ((cells >= 0) & (cells < plan.rooms.shape)).all(axis=1)
    votes = np.bincount(plan.rooms[tuple(cells[near].T)], minlength=2)
    votes[0] = 0
    return int(votes.argmax()) if votes.any() else 0


def name_rooms(plan: Plan, views: Views, inputs: Inputs, cfg: Config) -> list[str]:
    """Name of each room: votes of representative views of the frames whose camera is nearest to its footprint.

    A room without frames borrows the one nearest to it (HOV-SG borrows by an inverted floor test).
    """
    trees = [cKDTree(plan.cells_m(room)) for room in range(1, int(plan.rooms.max(initial=0)) + 1)]
    if not trees:
        return []
    if not len(views.pyramids):
        return [NO_LABEL] * len(trees)
    distances_m = np.stack([tree.query(views.cameras_m[:, :2])[0] for tree in trees], axis=1)  # (frame, room)
    nearest = distances_m.argmin(axis=1)
    names = []
    for room in range(len(trees)):
        rows = np.flatnonzero(nearest == room)
        rows = rows if len(rows) else distances_m[:, [room]].argmin(axis=0)
        chosen = representatives(views.embeddings[rows], cfg.view_clusters)
        votes = similarities(views.embeddings[rows][chosen], inputs.text, cfg.standardised).argmax(axis=1)
        names.append(inputs.names[np.bincount(votes).argmax()])
    return names


def representatives(embeddings: np.ndarray, clusters: int) -> np.ndarray:
    """Rows of the embeddings (n, dim) nearest to the centres of a k-means clustering, one per non-empty cluster."""
    distinct = len(np.unique(embeddings, axis=0))
    if distinct <= clusters:
        return np.arange(len(embeddings))
    centres, assigned = kmeans2(embeddings, clusters, minit="++", rng=np.random.default_rng(0))
    offsets = np.linalg.norm(embeddings - centres[assigned], axis=1)
    order = np.lexsort((offsets, assigned))
    return np.sort(order[np.unique(assigned[order], return_index=True)[1]])


def _on_floor(views: Views, floor: Floor) -> Views:
    height_m = views.cameras_m[:, 2]
    rows = np.flatnonzero((height_m >= floor.low_m) & (height_m < floor.high_m))
    return Views(tuple(views.pyramids[row] for row in rows.tolist()), views.embeddings[rows])


def _plans(voxels: VoxelMap, floor: Floor, cfg: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points per plan cell between wall heights and below the ceiling, padded, and the world corner of cell (0, 0)."""
    heights_m = (voxels.occupied[:, 2] + 0.5) * voxels.voxel_m
    storey = (heights_m >= floor.low_m) & (heights_m < floor.high_m)
    occupied, heights_m = voxels.occupied[storey, :2].astype(np.int64), heights_m[storey]
    low = occupied.min(axis=0)
    shape = occupied.max(axis=0) - low + 1
    walls = (heights_m >= floor.low_m + cfg.wall_from_m) & (heights_m < floor.high_m - cfg.wall_below_ceiling_m)
    inside = heights_m < floor.high_m - cfg.inside_below_ceiling_m
    per_voxel = max(round(voxels.voxel_m / cfg.grid_m), 1)
    plans = []
    for kept in (walls, inside):
        counts = np.zeros(shape)
        np.add.at(counts, tuple((occupied[kept] - low).T), 1)
        plans.append(np.pad(np.kron(counts, np.ones((per_voxel, per_voxel))), cfg.pad_cells))
    return plans[0], plans[1], low * voxels.voxel_m - cfg.pad_cells * cfg.grid_m


def _inside(counts: np.ndarray) -> np.ndarray:
    """255 within the building's filled outline."""
    blurred = cv2.GaussianBlur(_to_bytes(counts), (21, 21), 2)
    touched = np.where(blurred > 0, 255, 0).astype(np.uint8)
    rect = cv2.getStructuringElement(cv2.MORPH_RECT, (5, 5))
    solid = cv2.morphologyEx(touched, cv2.MORPH_CLOSE, rect, iterations=3)
    contours, _ = cv2.findContours(solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return cv2.drawContours(np.zeros_like(solid), contours, -1, 255, cv2.FILLED)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    """Values stretched to 0..255."""
    low, high = float(values.min()), float(values.max())
    return ((values - low) * (255 / (high - low) if high > low else 0.0)).astype(np.uint8)
