"""Levels above regions that the library knows: chosen by the task, composed of base regions, checked."""

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.priors import Task
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.knowledge import LevelEntry, check_environment
from prior_sg.services.prior_gateway.outside import library

LIBRARY = library.load()
HOSPITAL = next(one for one in LIBRARY.environments if one.name == "hospital")


def asked(environment, task="", regions=()):
    return LIBRARY.answer(
        Task(robot="r", stamp_ns=1, environment=environment, task=task, regions=list(regions)), Config()
    )


def test_the_task_chooses_the_words_of_a_level():
    rooms = ["corridor", "patient room", "operating room", "office"]
    (wards,) = asked("hospital", "which ward is it?", rooms).levels
    assert wards.names == ["ward", "surgery", "diagnostics", "public area"] and wards.task
    usual = asked("hospital", "find the patient", rooms)
    assert usual.levels == [] and [region.parent for region in usual.regions] == ["", "care", "treatment", "service"]
    assert usual.zones == [region.parent for region in usual.regions]


def test_where_there_are_levels_no_parent_says_it_again():
    prior = asked("hospital", "which ward?", ["patient room", "operating room"])
    assert [region.parent for region in prior.regions] == ["", ""] and prior.zones == ["ward", "surgery"]


def test_a_building_rests_on_the_zones_of_its_regions():
    zones, building = asked("university campus").levels
    assert zones.names[0] == "outdoors" and building.names == ["building", "outdoors"]
    inside = dict(zip(zones.names, building.parents[:, 0].tolist(), strict=True))
    assert inside["indoors"] > 0.9 > inside["transition"] > inside["outdoors"]
    assert inside["outdoors"] < 0.1


def test_a_region_known_by_name_alone_may_be_in_any_zone():
    (wards,) = asked("hospital", "which ward?", ["patient room", "operating room", "orrery"]).levels
    known, alone = wards.parents[:2], wards.parents[2]
    assert known.max(axis=1).min() > 0.9 > alone.max()
    np.testing.assert_allclose(wards.parents.sum(axis=1), 1, atol=1e-5)


def test_existence_is_what_the_regions_make_it():
    prior = asked("residential home", "which part of the home?")
    (parts,) = prior.levels
    shares = np.array([region.existence for region in prior.regions]) @ parts.parents
    np.testing.assert_allclose([entry.existence for entry in parts.entries], shares, atol=1e-5)


FAULTS = {
    "different names": {"entries": ["ward", "ward"]},
    "unknown regions": {"parents": {"throne room": "ward"}},
    "no entries": {"parents": {"corridor": "court"}},
    "no probabilities": {"parents": {"corridor": {"ward": 0.75, "surgery": 0.75}}},
    "not of its entries": {"adjacent": {"ward": {"court": 0.5}}},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_absurd_levels_of_an_environment_are_refused(fault):
    fields = {"name": "zone", "entries": ["ward", "surgery"], "parents": {"corridor": "ward"}} | FAULTS[fault]
    with pytest.raises(ValueError, match=fault):
        check_environment(msgspec.structs.replace(HOSPITAL, levels=[LevelEntry(**fields)]))
