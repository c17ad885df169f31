"""A foresight of one opening, for scenes of tests; what is around openings."""

import numpy as np

from prior_sg.schemas.foresight import ForeseenLabel, Foresight, MissingLabel, Opening
from prior_sg.services.segmenter.core.foresight.around import Around


def foresight(scene, row, label, within=0.5):
    """An opening at a scene's place `row`, behind which a region of that label may be."""
    x, y, z = scene.positions_m[row].tolist()
    opening = Opening(
        place_id=int(scene.place_ids[row]),
        position_m=(x, y, z),
        beyond_m=(x + 1.5, y, z),
        width_m=0.9,
        region=int(scene.place_regions[row]),
        same=0.25,
        labels=[ForeseenLabel(label=label, next=within / 2, within=within, adjacency=0.75, existence=0.25)],
    )
    missing = [MissingLabel(label=label, probability=within)]
    return Foresight(openings=[opening], missing=missing, steps=3, look_m=1.0, elsewhere_m=40.0)


def around(count, **columns):
    """Around so many openings of regions that touch one other, on a storey of 20 m2; `columns` are others."""
    usual = {"touching": 1.0, "nearby": 0.0, "at_border": 0.0, "storey_m2": 20.0} | columns
    return Around(**{name: np.broadcast_to(np.array(value, float), (count,)) for name, value in usual.items()})
