"""Openings: frontiers of neighbouring places that look the same way out of the same region (pure)."""

from dataclasses import dataclass

import numpy as np
import scipy

from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.fan import unseen_shares
from prior_sg.services.segmenter.core.map.frontiers import Frontiers
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.map.table import Places


@dataclass(frozen=True)
class Openings:
    """One row for each opening, the widest first."""

    place_ids: np.ndarray  # (opening,) the place with the largest frontier
    positions_m: np.ndarray  # (opening, 3) of its centre
    beyond_m: np.ndarray  # (opening, 3) a point in the unobserved space
    widths_m: np.ndarray  # (opening,)
    regions: np.ndarray  # (opening,) id of the region it opens from
    beliefs: np.ndarray  # (opening, label) rows sum to one
    rises: np.ndarray  # (opening,) absolute sine of its direction
    unseen: np.ndarray  # (opening,) share of a fan behind it that no place covers


def openings_of(graph: ReceivedGraph, places: Places, frontiers: Frontiers, cfg: ForesightConfig) -> Openings:
    """The openings of a map whose places have regions and beliefs."""
    ids, directions, areas_m2 = frontiers.columns()
    rows = graph.rows(ids)
    usable = (rows >= 0) & (np.abs(directions[:, 2]) <= cfg.steep)
    usable[usable] = places.regions[rows[usable]] != NO_REGION
    rows, outward_m2 = rows[usable], (directions * areas_m2[:, None])[usable]
    group = _merged(graph, places.regions, rows, outward_m2, cfg.aligned)
    count = int(group.max(initial=-1)) + 1
    net_m2 = np.zeros((count, 3))
    np.add.at(net_m2, group, outward_m2)
    widths_m = np.linalg.norm(net_m2, axis=1) / cfg.opening_height_m
    sizes_m2 = np.linalg.norm(outward_m2, axis=1)
    by_size = np.lexsort((-sizes_m2, group))
    first = by_size[np.searchsorted(group[by_size], np.arange(count))]
    beliefs = np.zeros((count, places.posteriors.shape[1]))
    np.add.at(beliefs, group, places.posteriors[rows] * sizes_m2[:, None])
    kept = np.flatnonzero((widths_m >= cfg.least_width_m) & (beliefs.sum(axis=1) > 0))
    kept = kept[np.argsort(-widths_m[kept], kind="stable")][: cfg.most_openings]
    largest, beliefs = rows[first[kept]], beliefs[kept]
    outward = net_m2[kept] / np.linalg.norm(net_m2[kept], axis=1, keepdims=True)
    edges_m = graph.positions_m[largest] + outward * graph.radii_m[largest][:, None]
    return Openings(
        place_ids=graph.ids[largest],
        positions_m=graph.positions_m[largest],
        beyond_m=edges_m + outward * cfg.beyond_m,
        widths_m=widths_m[kept],
        regions=places.regions[largest],
        beliefs=beliefs / beliefs.sum(axis=1, keepdims=True),
        rises=np.abs(outward[:, 2]),
        unseen=unseen_shares(graph, edges_m, outward, cfg),
    )


def _merged(
    graph: ReceivedGraph, regions: np.ndarray, rows: np.ndarray, outward_m2: np.ndarray, aligned: float
) -> np.ndarray:
    """Number (n,) of the opening that each frontier is part of; `rows` (n,) of its places."""
    at = np.full(len(graph.ids), -1)
    at[rows] = np.arange(len(rows))
    pairs = at[graph.edges]
    pairs = pairs[(pairs >= 0).all(axis=1)]
    one, other = pairs.T
    unit = outward_m2 / np.linalg.norm(outward_m2, axis=1, keepdims=True)
    same = ((unit[one] * unit[other]).sum(axis=1) >= aligned) & (regions[rows[one]] == regions[rows[other]])
    joined = scipy.sparse.coo_matrix((np.ones(same.sum(), np.int8), pairs[same].T), shape=(len(rows), len(rows)))
    return scipy.sparse.csgraph.connected_components(joined, directed=False)[1].astype(np.int64)
