"""Three faults on a whole system, with a fixed seed, and what judges them; `make chaos` runs hundreds."""

import json
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from rich.console import Console

from prior_sg.deploy.running.job import Job, run
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import Keyframe
from prior_sg.services.feature_pyramid.encoders.base import FAMILIES
from tests.chaos import painted
from tests.chaos.dialects import spoken
from tests.chaos.faults import FAULTS
from tests.chaos.oracle import ASPECTS, LASTING, differences, kept_ids, likeness
from tests.chaos.results import Results, table
from tests.chaos.schedule import BY_NAME, KINDS, Planned, planned
from tests.chaos.streams import ROBOT, made
from tests.chaos.system import SETTINGS, TASK
from tests.chaos.voyage import GRID, Hit, Outcome, Reference, sailed
from tests.help.examples import EXAMPLES
from tests.help.long import long_run

EXACT = dict.fromkeys(ASPECTS, 1.0) | dict.fromkeys(LASTING, 0.0)
FRAMES = 4 * GRID
PHASE = (
    Planned("kill", "segmenter", 0.1, 0.0),
    Planned("cable out", "place_graph", 0.5, 1.0),
    Planned("router away", "router", 2.0, 0.5),
)


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    return made("sample", FRAMES, tmp_path_factory.mktemp("stream"))


@pytest.fixture(scope="module")
def undisturbed(stream, tmp_path_factory):
    """The scene of a run in one process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FAMILIES, "painted/", "tests.chaos.painted")
        patch.setenv(painted.LABELS, json.dumps(stream.labels))
        job = Job(
            source=str(stream.path),
            out=tmp_path_factory.mktemp("undisturbed"),
            environment=stream.environment,
            task=TASK,
            regions=list(stream.labels),
            robot=ROBOT,
            settings=list(SETTINGS),
            in_process=True,
        )
        return run(job, Console(quiet=True)).scene


@long_run
@pytest.mark.timeout(280)
def test_a_disturbed_system_maps_what_an_undisturbed_one_does(stream, undisturbed, tmp_path):
    known = Reference(scenes={FRAMES: encode(undisturbed)}, tolerance=EXACT, resident_mb={})
    (outcome,) = sailed(0, stream, known, [PHASE], tmp_path / "voyage")
    assert [(hit.fault, hit.target) for hit in outcome.hits] == [(plan.fault, plan.target) for plan in PHASE]
    assert outcome.problems == [] and outcome.beside == [] and outcome.frames == FRAMES


def changed(scene, **fields):
    return msgspec.structs.replace(scene, **fields)


def test_the_oracle_sees_what_differs(undisturbed):
    same = likeness(undisturbed, undisturbed)
    assert same == dict.fromkeys(ASPECTS, 1.0) and differences(same, EXACT, lasting=True) == []
    first = int(undisturbed.place_ids[0])
    other = next(region.id for region in undisturbed.regions if region.id != undisturbed.place_regions[0])
    moved = undisturbed.positions_m + np.array((0.05, 0, 0), np.float32)
    regions = np.where(undisturbed.place_ids == first, other, undisturbed.place_regions)
    ids = undisturbed.place_regions + 100
    renamed = [msgspec.structs.replace(region, id=region.id + 100) for region in undisturbed.regions]
    objects = [msgspec.structs.replace(item, id=item.id + 100) for item in undisturbed.objects]
    for worse, aspects in [
        (changed(undisturbed, positions_m=moved), {"places", "edges"}),
        (
            changed(undisturbed, place_ids=undisturbed.place_ids + 1, edges=undisturbed.edges + 1),
            {"place_ids"},
        ),
        (changed(undisturbed, edges=undisturbed.edges[1:], clearances_m=undisturbed.clearances_m[1:]), {"edges"}),
        (changed(undisturbed, trajectory=undisturbed.trajectory[1:]), {"cameras"}),
        (changed(undisturbed, place_regions=regions), {"labels", "regions", "region_ids"}),
        (changed(undisturbed, place_regions=ids, regions=renamed), {"region_ids"}),
        (changed(undisturbed, objects=undisturbed.objects[1:]), {"objects", "object_ids"}),
        (changed(undisturbed, objects=objects), {"object_ids"}),
    ]:
        lower = {aspect for aspect, share in likeness(undisturbed, worse).items() if share < 1.0}
        assert aspects <= lower, aspects
        assert lower <= aspects | {"regions"}, lower


def test_ids_that_are_given_anew_are_seen(undisturbed):
    assert kept_ids(undisturbed, undisturbed) == 1.0
    assert kept_ids(undisturbed, changed(undisturbed, place_ids=undisturbed.place_ids + 1)) == 0.0


def test_a_schedule_is_that_of_its_seed_and_spares_whoever_was_hit_before():
    names = list(FAULTS)
    phases = planned(3, 0, 200, names)
    assert phases == planned(3, 0, 200, names) != planned(4, 0, 200, names)
    assert {plan.fault for phase in phases for plan in phase} == set(names) == {kind.name for kind in KINDS}
    for before, phase in pairwise(phases):
        targets = [plan.target for plan in phase if len(BY_NAME[plan.fault].targets) > 2]
        assert len(targets) == len(set(targets))
        assert not set(targets) & {plan.target for plan in before}


def test_dialects_change_bytes_and_not_what_they_say():
    whole = next(example for example in EXAMPLES if isinstance(example, Keyframe))
    plain = msgspec.structs.replace(whole, mask=b"", space="", origin_m=(0.0, 0.0, 0.0))
    for message in (whole, plain):
        for dialect in ("older", "newer"):
            assert decode(Keyframe, spoken(Keyframe, encode(message), dialect)) == message
    assert (
        len(spoken(Keyframe, encode(plain), "older"))
        < len(encode(plain))
        < len(spoken(Keyframe, encode(plain), "newer"))
    )


def test_results_survive_a_cut_and_are_summed_up(tmp_path):
    hits = [Hit(fault="kill", target="ingest", lasted_s=0.0, recovered_s=seconds) for seconds in (1.0, 3.0)]
    good = Outcome(
        voyage=0, phase=0, stream="s", frames=8, hits=hits, likeness=EXACT, problems=[], resident_mb={"ingest": 9.0}
    )
    bad = msgspec.structs.replace(good, phase=1, hits=hits[:1], problems=["revision 3 was announced and is not kept"])
    for outcome in (good, bad):
        Results(tmp_path).add(outcome)
    with (tmp_path / "outcomes.jsonl").open("ab") as file:
        file.write(b'{"voyage": 1, "pha')
    results = Results(tmp_path)
    assert (results.faults, results.voyages()) == (3, 1)
    found = results.summary()
    assert found["faults"]["kill"] == {"times": 3, "equal": 2, "s_p50": 1.0, "s_max": 3.0}
    assert found["acknowledged_lost"] == 1 and len(found["problems"]) == 1
    assert "| kill | 3 | 2 | 1.0 | 3.0 |" in table(found)
