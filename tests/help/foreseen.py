"""A foresight of one opening, for scenes of tests."""

from prior_sg.schemas.foresight import ForeseenLabel, Foresight, MissingLabel, Opening


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
