"""How much of what lies behind an opening no place has covered (pure).

Shadows of furniture, gaps in depth and corners open into space that is seen from elsewhere; a door that was not passed
opens into space that is not.
"""

import numpy as np
import scipy

from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.map.received import ReceivedGraph


def unseen_shares(graph: ReceivedGraph, edges_m: np.ndarray, outward: np.ndarray, cfg: ForesightConfig) -> np.ndarray:
    """Share (opening,) of the points of a level fan, from each edge (opening, 3) along its unit direction (opening, 3),
    that lie in no place's sphere."""
    if not len(edges_m):
        return np.zeros(0)
    points_m = _fans(edges_m, outward, cfg)
    covered = _covered(graph, points_m.reshape(-1, 3), cfg.covered_m).reshape(points_m.shape[:2])
    return np.asarray(1.0 - covered.mean(axis=1))


def _fans(edges_m: np.ndarray, outward: np.ndarray, cfg: ForesightConfig) -> np.ndarray:
    """Points (opening, point, 3) behind each opening."""
    heading = np.arctan2(outward[:, 1], outward[:, 0])[:, None] + np.array(cfg.fan_rad)
    ways = np.stack((np.cos(heading), np.sin(heading), np.zeros_like(heading)), axis=2)
    points_m = edges_m[:, None, None] + ways[:, :, None] * np.array(cfg.fan_m)[:, None]
    return np.asarray(points_m.reshape(len(edges_m), -1, 3))


def _covered(graph: ReceivedGraph, points_m: np.ndarray, margin_m: float) -> np.ndarray:
    """Whether each point (n, 3) lies in a sphere that is larger by a margin.

    |p - c|^2 - r^2 is least for one sphere: with sqrt(R^2 - r^2) as a fourth coordinate, that is the nearest centre.
    """
    radii_m2 = (graph.radii_m + margin_m) ** 2
    centres = np.column_stack((graph.positions_m, np.sqrt(radii_m2.max() - radii_m2)))
    nearest_m, _ = scipy.spatial.cKDTree(centres).query(np.column_stack((points_m, np.zeros(len(points_m)))))
    return np.asarray(nearest_m**2 < radii_m2.max())
