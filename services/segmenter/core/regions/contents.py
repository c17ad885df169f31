"""What the regions of a map hold (pure)."""

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.regions.components import OBJECT_REACH_M


def held(view: ObjectView, positions_m: np.ndarray, regions: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """How surely (region, concept) each of the regions `ids` holds each kind of object: the word of its best candidate.

    An object stands in the region of its nearest place. The best, as in the object expert, because the doubts of many
    objects about what they are do not add up to one that is there.
    """
    found = np.zeros((len(ids), view.concepts.shape[1]))
    if len(view.ids):
        distances_m, nearest = cKDTree(positions_m).query(view.positions_m)
        region = regions[nearest]
        inside = np.flatnonzero((distances_m <= OBJECT_REACH_M) & np.isin(region, ids))
        words = view.answers[inside, None] * view.concepts[inside]
        np.maximum.at(found, np.searchsorted(ids, region[inside]), words)
    return found
