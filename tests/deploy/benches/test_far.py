"""What far views cost: a world beside itself, and the steps of a keyframe."""

import numpy as np
import pytest

from prior_sg.deploy.benches.far import Mapping, beside_itself, keyframes
from prior_sg.deploy.evaluation.worlds import world_of
from prior_sg.services.place_graph.core.config import AT_ONCE, preset


def test_a_world_beside_itself_looks_around_every_view_as_the_one_does():
    one = world_of("campus", 20)
    nine = beside_itself(one, 3, 50)
    assert nine.grid.shape == (3 * one.grid.shape[0], 3 * one.grid.shape[1], one.grid.shape[2])
    assert nine.stamps_ns.tolist() == one.stamps_ns[::50].tolist()
    for pose, moved in zip(one.world_from_camera[::50], nine.world_from_camera, strict=True):
        at, there = (np.floor((p[:3, 3] - one.origin_m) / one.voxel_m).astype(int) for p in (pose, moved))
        np.testing.assert_array_equal(
            one.grid[tuple(slice(i - 1, i + 2) for i in at)], nine.grid[tuple(slice(i - 1, i + 2) for i in there)]
        )


@pytest.mark.parametrize("places", ["2d", "3d"])
def test_steps_of_keyframes_are_told_apart(places):
    mappings = [
        Mapping(preset("outdoor", max_range_m=30.0, places=places, slice_blocks=most)) for most in (AT_ONCE, 16)
    ]
    for keyframe in keyframes("world:campus:20", 30.0, 1, 120):
        for mapping in mappings:
            mapping.take(keyframe)
    whole, sliced = (mapping.figures() for mapping in mappings)
    assert whole["steps"] == 1.0 and whole["keyframe_ms_p50"] == whole["longest_ms_p50"]
    assert sliced["steps"] > 2.0 and sliced["longest_ms_p50"] < sliced["keyframe_ms_p50"]
    assert whole["places"] == sliced["places"] > 0
