"""What the regions of a map hold (pure)."""

import numpy as np
import scipy

from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.regions.components import OBJECT_REACH_M

DECAY_M = 2.0  # at which a thing in the same region counts 1 / e


def held(view: ObjectView, positions_m: np.ndarray, regions: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """How surely (region, concept) each of the regions `ids` holds each kind of object: the word of its best candidate.

    An object stands in the region of its nearest place. The best, as in the object expert, because the doubts of many
    objects about what they are do not add up to one that is there.
    """
    found = np.zeros((len(ids), view.concepts.shape[1]))
    if len(view.ids):
        distances_m, nearest = scipy.spatial.cKDTree(positions_m).query(view.positions_m)
        region = regions[nearest]
        inside = np.flatnonzero((distances_m <= OBJECT_REACH_M) & np.isin(region, ids))
        words = view.answers[inside, None] * view.concepts[inside]
        np.maximum.at(found, np.searchsorted(ids, region[inside]), words)
    return found


def held_around(view: ObjectView, positions_m: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """How surely (place, concept) the region of each place holds each kind of object, the less the farther off: where
    two rooms were taken for one region, each still hears its own things first."""
    found = np.zeros((len(positions_m), view.concepts.shape[1]))
    if not (len(view.ids) and len(positions_m)):
        return found
    distances_m, nearest = scipy.spatial.cKDTree(positions_m).query(view.positions_m)
    region = np.where(distances_m <= OBJECT_REACH_M, regions[nearest], NO_REGION)
    for item in np.flatnonzero((region != NO_REGION) & (view.words > 0)):
        rows = np.flatnonzero(regions == region[item])
        away_m = np.linalg.norm(positions_m[rows] - view.positions_m[item], axis=1)
        weight = view.words[item] * np.exp(-away_m / DECAY_M)
        found[rows] = np.maximum(found[rows], weight[:, None] * view.concepts[item])
    return found
