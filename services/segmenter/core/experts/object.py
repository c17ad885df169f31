"""The object expert: which regions the objects near a place belong to."""

import numpy as np
import scipy

from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.experts.context import Context


def objects(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Proximity-discounted max-pool of P(r | o) over the objects within reach (paper, The Object Expert).

    Confidence is the pooled mass. Each object's P(r | o) sums to one, so one object gives its proximity weight; several
    that speak for different regions can add up to more, while a confidence ends at 1: the mass is cut there. An object
    of which it is unsure whether it is any of the prior's weighs less.
    """
    settings, view = context.object_settings, context.objects
    count, labels = len(context.frames), len(context.prior.regions)
    places, found, distances_m = _near(context.positions_m, view.positions_m, settings.reach_m)
    pooled = np.zeros((count, labels))
    if len(places):
        evidence = (view.concepts @ region_of_concept(context.prior))[found]
        evidence *= (np.exp(-distances_m / settings.decay_m) * view.words[found])[:, None]
        anchored, first = np.unique(places, return_index=True)
        pooled[anchored] = np.maximum.reduceat(evidence, first, axis=0)
    mass = pooled.sum(axis=1)
    shares = np.where(mass[:, None] > 0, pooled, 1.0)
    shares /= shares.sum(axis=1, keepdims=True)
    return np.log(np.maximum(shares, np.finfo(float).tiny)), np.minimum(mass, 1.0)


def region_of_concept(prior: Prior) -> np.ndarray:
    """P(r | c) (object concept, region) by Bayes from containment and existence; rows sum to one.

    A concept that no region holds says nothing: its row is the existence prior.
    """
    existence = np.array([region.existence for region in prior.regions])
    joint = prior.containment.astype(np.float64).T * existence
    joint[joint.sum(axis=1) == 0] = existence
    return joint / joint.sum(axis=1, keepdims=True)


def _near(places_m: np.ndarray, objects_m: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs (place, object) within reach, sorted, and their distances."""
    if not (len(places_m) and len(objects_m)):
        none = np.zeros(0, dtype=np.int64)
        return none, none, np.zeros(0)
    of_places, of_objects = scipy.spatial.cKDTree(places_m), scipy.spatial.cKDTree(objects_m)
    pairs = of_places.sparse_distance_matrix(of_objects, reach_m, output_type="ndarray")
    pairs.sort(order=("i", "j"))
    return pairs["i"], pairs["j"], pairs["v"]
