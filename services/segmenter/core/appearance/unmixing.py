"""What places look like each for itself, told apart from crops that show several (beyond the paper; pure).

A crop shows surfaces of several places, and its embedding is about the mean of what each looks like. The kernel spreads
that mean over all of them, as an unfiltered back-projection does in tomography: borders blur and what is seen through a
door takes the colour of the wall beside it. Crops from many views determine the parts: similarities of the places are
sought whose means, crop by crop, are the similarities of the crops (simultaneous iterative reconstruction after
Gilbert, 1972). A few rounds from the shared evidence, each smoothed along the place graph, keep what the crops do not
determine.

Reconstruction sharpens errors as it sharpens looks, so it counts by what the looks are worth, see `information`.
"""

import msgspec
import numpy as np
import scipy

from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import inverse
from prior_sg.services.segmenter.core.appearance import smoothing
from prior_sg.services.segmenter.core.appearance.smoothing import SharingConfig
from prior_sg.services.segmenter.core.evidence.kernel import Frame
from prior_sg.services.segmenter.core.map.arcs import Arcs

FRAMES = 1024  # frames that stand for all
CELLS = 300  # of a frame's surface that stand for all, about
NUDGE_M = 0.15  # from the surface towards the camera, so that a wall belongs to the side that it was seen from
REACH_M = 1.5  # surface further than this from a place's free sphere does not show it
SOFT_M = 0.3  # distance from the free sphere at which a place's part of a cell counts 1 / e
NEAREST = 3  # places that share a cell
LEAST_SHOWN = 0.3  # share of a crop that must show places


class UnmixingConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How far crops are told apart into places."""

    rounds: int = 10  # 0 = the kernel's means as they are (paper)
    steps: int = 4  # along the graph over which each round is smoothed
    mass: float = 5.0  # crops' worth of a place above which it counts no more in the smoothing
    ridge: float = 1.0  # crops' worth that each place is taken to have been seen as it is

    def __post_init__(self) -> None:
        if not (self.rounds >= 0 and self.steps >= 0 and self.mass > 0 and self.ridge > 0):
            raise ValueError("rounds, steps, mass or ridge is out of range")


def sampled(frames: list[Frame]) -> list[Frame]:
    """All frames that hold crops, or a regular sample of them."""
    kept = [frame for frame in frames if len(frame.sigmas_px)]
    return kept[:: max(-(-len(kept) // FRAMES), 1)]


def shown(frames: list[Frame], positions_m: np.ndarray, radii_m: np.ndarray) -> "scipy.sparse.csr_matrix":
    """Shares (crop, place) of each crop's measured surface that is each place's; places are (place, 3)."""
    positions_m, radii_m = positions_m.astype(np.float64), radii_m.astype(np.float64)
    rows = [_shares(frame, positions_m, radii_m) for frame in frames]
    return scipy.sparse.vstack(rows).tocsr() if rows else scipy.sparse.csr_matrix((0, len(radii_m)))


def unmixed(
    similarity: np.ndarray, looks: np.ndarray, shares: "scipy.sparse.csr_matrix", ties: Arcs, cfg: UnmixingConfig
) -> np.ndarray:
    """Similarities (place, label) that explain those of the crops, `looks` (crop, label), starting from `similarity`.

    `shares` (crop, place) as in `shown`; `ties` are the place graph.
    """
    covered = np.asarray(shares.sum(axis=1)).reshape(-1)
    kept = np.flatnonzero(covered > LEAST_SHOWN)
    shares, looks, covered = shares[kept], looks[kept], covered[kept, None]
    back = shares.T.tocsr()
    seen = np.asarray(back.sum(axis=1)).reshape(-1)
    masses, everywhere = np.minimum(seen, cfg.mass), np.arange(len(seen))
    smooth = SharingConfig(steps=cfg.steps, gain=1.0)
    found = similarity
    for _ in range(cfg.rounds):
        missing = looks - shares @ found / covered
        correction = back @ missing / (seen + cfg.ridge)[:, None]
        found = found + smoothing.shared(correction, masses, ties, rows=everywhere, cfg=smooth)
    return found


def _shares(frame: Frame, positions_m: np.ndarray, radii_m: np.ndarray) -> "scipy.sparse.csr_matrix":
    """Shares (crop, place) of one frame."""
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
    places, parts = _nearest(points_m, positions_m, radii_m, world_from_camera[:3, 3].copy(), reach_m)
    cells = np.repeat(np.arange(len(points_m)), NEAREST)
    shape = len(points_m), len(radii_m)
    held = scipy.sparse.csr_matrix((parts.reshape(-1), (cells, places.reshape(-1))), shape=shape)
    offsets_px = np.abs(np.stack((u_px, v_px), axis=1)[None] - frame.centers_px[:, None])
    covers = (offsets_px < frame.sigmas_px[:, None, None]).all(axis=2).astype(np.float64)
    covers /= np.maximum(covers.sum(axis=1, keepdims=True), 1.0)
    return scipy.sparse.csr_matrix(covers) @ held


@compiled()
def _nearest(points_m, positions_m, radii_m, camera_m, reach_m):  # noqa: ANN001, ANN202
    """Places (point, NEAREST) whose free spheres are nearest, and their parts, which sum to one or are all zero."""
    near = np.empty(len(radii_m), np.int64)
    count = 0
    for place in range(len(radii_m)):
        distance = np.sqrt(((positions_m[place] - camera_m) ** 2).sum())
        if distance - radii_m[place] <= reach_m:
            near[count] = place
            count += 1
    places = np.zeros((len(points_m), NEAREST), np.int64)
    parts = np.zeros((len(points_m), NEAREST))
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
        total = 0.0
        for at in range(NEAREST):
            if gaps_m[at] < REACH_M:
                parts[point, at] = np.exp(-max(gaps_m[at], 0.0) / SOFT_M)
                total += parts[point, at]
        if total > 0:
            parts[point] /= total
    return places, parts
