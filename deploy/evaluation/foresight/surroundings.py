"""What an explorer has seen around its openings, as the product reads it of a map's regions."""

import numpy as np

from prior_sg.deploy.evaluation.foresight import loops
from prior_sg.deploy.evaluation.foresight.explorer import Explorer, Frontiers
from prior_sg.deploy.evaluation.worlds.ways import CELL_M
from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.segmenter.core.foresight.around import Around, fading
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig

RASTER_CELLS = 4  # of seen floor, one cell in so many along each axis stands for all
AHEAD_CELLS = 10  # what is unseen so far behind an opening tells where it leads


def surroundings(
    explorer: Explorer,
    frontiers: Frontiers,
    origins: np.ndarray,
    crossings: tuple[np.ndarray, np.ndarray],
    *,
    found: np.ndarray,
    cfg: ForesightConfig,
) -> Around:
    """Around each opening, given the region (opening,) that it opens from, the nodes on both sides of all borders, and
    which regions (region,) were recognised."""
    plan, known = explorer.plan, explorer.known
    count = len(frontiers.targets)
    if not count:
        return Around(*np.zeros((4, 0)))
    a, b = crossings
    met = known[a] & known[b]
    sides = np.stack((plan.regions[a[met]], plan.regions[b[met]]), axis=1)
    touching = np.bincount(np.unique(np.sort(sides, axis=1), axis=0).reshape(-1), minlength=len(found))
    nodes = np.flatnonzero(known)
    i, j, _ = np.unravel_index(nodes, plan.heights.shape)
    nodes = nodes[(i % RASTER_CELLS == 0) & (j % RASTER_CELLS == 0)]
    points_m, held = plan.position_m(nodes), plan.regions[nodes]
    beyond_m = np.array([_beyond_m(explorer, edge) for edge in frontiers.nodes])
    nearest_m = np.full((count, len(found)), np.inf)
    recognised = (held != NO_REGION) & found[held]
    order = np.flatnonzero(recognised)[np.argsort(held[recognised], kind="stable")]
    if len(order):
        regions, starts = np.unique(held[order], return_index=True)
        off_m = _apart_m(beyond_m, points_m[order], cfg.steepness)
        nearest_m[:, regions] = np.minimum.reduceat(off_m, starts, axis=1)
    nearest_m[np.arange(count), origins] = np.inf
    doors_m = _apart_m(frontiers.centers_m, plan.position_m(a[met]), cfg.steepness)
    level = np.abs(points_m[:, 2] - frontiers.centers_m[:, 2:]) <= cfg.storey_m
    return Around(
        touching=touching[origins].astype(float),
        nearby=fading(nearest_m, cfg.nearby_m).sum(axis=1),
        at_border=fading(doors_m.min(axis=1, initial=np.inf), cfg.border_m),
        storey_m2=level.sum(axis=1) * (RASTER_CELLS * CELL_M) ** 2,
    )


def _beyond_m(explorer: Explorer, nodes: np.ndarray) -> np.ndarray:
    """The middle (3,) of what is unseen just behind a frontier."""
    plan = explorer.plan
    ahead, *_ = loops.flooded(plan.heights, plan.clearance, explorer.known, nodes, AHEAD_CELLS, plan.step)
    return np.asarray(plan.position_m(ahead if len(ahead) else nodes).mean(axis=0))


def _apart_m(points_m: np.ndarray, others_m: np.ndarray, steepness: float) -> np.ndarray:
    """Distances (n, m), height counted more."""
    off_m = points_m[:, None] - others_m
    return np.asarray(np.hypot(np.linalg.norm(off_m[:, :, :2], axis=2), steepness * off_m[:, :, 2]))
