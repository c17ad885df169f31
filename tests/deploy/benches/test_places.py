"""The stages of the place graph's benchmark: each is found, and one that is not is a fault."""

import cProfile
import itertools

import pytest

from prior_sg.deploy.benches.places import PLACE_STAGES, stages_s
from prior_sg.schemas.frames import Keyframe
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.place_graph.core.ground import GroundGraph
from prior_sg.services.place_graph.service import SERVICE
from prior_sg.services.runtime.service import Identity
from tests.help.paths import SAMPLE


@pytest.fixture(scope="module")
def profile():
    cfg = SERVICE.config(voxel_m=0.2)
    state = SERVICE.init(cfg, Identity("r", "p", 1))
    recorded = cProfile.Profile()
    for frame in itertools.islice(open_source(SAMPLE), 2):
        fields = {name: getattr(frame, name) for name in Keyframe.__struct_fields__ if hasattr(frame, name)}
        keyframe = Keyframe(robot="r", **fields)
        recorded.runcall(lambda keyframe=keyframe: list(SERVICE.step(state, keyframe, cfg)))
    return recorded


def test_every_stage_takes_time(profile):
    assert all(seconds > 0 for seconds in stages_s(profile, PLACE_STAGES).values())


def test_a_stage_whose_function_is_never_called_is_named(profile):
    with pytest.raises(RuntimeError, match=r"never calls the functions of these stages: tiles$"):
        stages_s(profile, PLACE_STAGES | {"tiles": GroundGraph.renew})
