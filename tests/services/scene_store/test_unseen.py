"""Where to look for what has not been seen, and what is missing, over a stored scene."""

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.benches.queries import synthetic_scene
from prior_sg.schemas import queries as q
from prior_sg.schemas.foresight import ForeseenLabel, Foresight, MissingLabel, Opening
from prior_sg.services.scene_store.core.queries import unseen
from prior_sg.services.scene_store.core.queries.answering import answer
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig

SCENE = synthetic_scene(600, 50)
LABEL, OTHER = SCENE.labels[:2]


def opening(row, within, toward=0.0):
    x, y, z = SCENE.positions_m[row].tolist()
    return Opening(
        place_id=int(SCENE.place_ids[row]),
        position_m=(x, y, z),
        beyond_m=(x + 1, y, z),
        width_m=0.9,
        region=int(SCENE.place_regions[row]),
        same=0.1,
        labels=[ForeseenLabel(label=LABEL, next=within / 2, within=within, toward=toward)],
    )


def index_of(*openings):
    foresight = Foresight(
        openings=list(openings),
        missing=[MissingLabel(label=LABEL, probability=0.8)],
        steps=3,
        look_m=2.0,
        elsewhere_m=30.0,
    )
    return Index(msgspec.structs.replace(SCENE, foresight=foresight))


NEAR = index_of(opening(40, 0.3), opening(300, 0.3))
START = q.Spot(what="place", id=int(SCENE.place_ids[40]))


def ask(index, **fields):
    return answer(index, q.WhereToLook(**({"label": LABEL, "start": START} | fields)))


def test_of_equal_chances_the_nearer_comes_first_with_the_way_there():
    found = ask(NEAR, label=LABEL.upper())
    assert found.label == LABEL and found.reason == "" and found.probability == 0.8
    assert [one.opening.place_id for one in found.prospects] == [int(SCENE.place_ids[row]) for row in (40, 300)]
    assert found.prospects[0].way_m == 0 and found.prospects[0].expected_m < found.prospects[1].expected_m
    assert found.route.found and found.route.place_ids == [int(SCENE.place_ids[40])]


def test_a_surer_one_is_worth_a_walk_and_the_route_is_the_shortest_way():
    found = ask(index_of(opening(60, 0.02), opening(300, 0.95)))
    best = found.prospects[0]
    assert best.opening.place_id == int(SCENE.place_ids[300])
    way = answer(NEAR, q.RouteBetween(start=START, goal=q.Spot(what="place", id=best.opening.place_id)))
    assert found.route.place_ids == way.place_ids
    assert best.way_m == pytest.approx(way.length_m, abs=0.01)
    first = ask(index_of(opening(60, 0.02), opening(300, 0.95)), limit=1)
    assert first.prospects == [best] and first.total == 2


def test_what_leads_to_it_comes_before_what_it_begins_behind():
    """Behind a stair there is a whole storey; what was told before stairs were thought of goes by what begins there."""
    deep, shallow = opening(60, 0.1, toward=0.9), opening(300, 0.95, toward=0.1)
    found = ask(index_of(deep, shallow))
    assert [one.probability for one in found.prospects] == [0.1, 0.95]
    assert [one.toward for one in found.prospects] == [0.9, 0.1]
    by = [one.toward / (one.way_m + found.look_m) for one in found.prospects]
    assert [one.per_metre for one in found.prospects] == pytest.approx(by, abs=1e-3) and by[0] > by[1]
    assert [one.probability for one in ask(index_of(opening(60, 0.0, toward=0.9))).prospects] == [0.0]
    old = ask(index_of(opening(60, 0.1), opening(300, 0.95)))
    assert [one.probability for one in old.prospects] == [0.95, 0.1]


@pytest.mark.parametrize(
    ("index", "fields", "said"),
    [
        (NEAR, {"label": "xyzzy"}, "the task knows no region 'xyzzy'"),
        (NEAR, {"label": OTHER}, "no way leads to any opening"),
        (index_of(), {}, "no opening"),
        (NEAR, {"start": q.Spot(what="place", id=10**6)}, "there is no place"),
        (
            Index(msgspec.structs.replace(SCENE, labels=[], posteriors=np.zeros((600, 0), np.float16))),
            {},
            "no region is expected",
        ),
    ],
)
def test_why_there_is_no_answer(index, fields, said):
    found = ask(index, **fields)
    assert found.prospects == [] and said in found.reason


def test_only_what_is_told_is_thought_through(monkeypatch):
    thought = []
    monkeypatch.setattr(
        unseen, "expected_metres", lambda *args, firsts: thought.extend(firsts) or np.zeros(len(firsts))
    )
    found = ask(index_of(*(opening(row, 0.3) for row in range(40, 90))), limit=3)
    assert (len(found.prospects), found.total, len(thought)) == (3, 50, 3)


def test_an_opening_whose_place_is_gone_is_left_out():
    gone = msgspec.structs.replace(opening(40, 0.9), place_id=10**6)
    assert [one.opening.place_id for one in ask(index_of(gone, opening(300, 0.1))).prospects] == [
        int(SCENE.place_ids[300])
    ]


def test_what_is_missing_is_told_with_the_openings_it_may_be_behind():
    found = answer(NEAR, q.WhatIsMissing(limit=5))
    assert [one.label for one in found.labels] == [LABEL] and found.openings == 2
    bare = msgspec.structs.replace(SCENE, task="")
    assert "none was given" in answer(Index(bare), q.WhatIsMissing()).reason


@pytest.mark.parametrize("question", [q.WhatIsMissing(), q.WhereToLook(label=LABEL, start=START)])
def test_of_a_merged_map_it_is_foretold_or_said_whom_to_ask(question):
    merged = msgspec.structs.replace(SCENE, robot="home", merged_of=["r1", "r2"])
    reason = answer(Index(merged), question).reason
    assert reason == (
        "home is the merged map of r1, r2: what has not been seen, where robots follow several tasks or nothing is "
        "open, is known of a robot's own map (--robot r1)"
    )
    found = answer(Index(msgspec.structs.replace(merged, foresight=NEAR.scene.foresight)), question)
    assert found == answer(NEAR, question) and not found.reason


def test_what_a_merged_map_without_a_task_waits_for_is_said():
    bare = msgspec.structs.replace(SCENE, task="", regions=[], labels=[], merged_of=["r1", "r2"])
    told = answer(Index(bare), q.ById(what="region", id=1)).reason
    assert told.endswith("regions and names follow the tasks of r1, r2, and none of them was given any")


def test_where_no_look_is_paid_for_the_opening_that_one_stands_at_comes_first():
    foresight = msgspec.structs.replace(NEAR.scene.foresight, look_m=0.0)
    found = ask(Index(msgspec.structs.replace(SCENE, foresight=foresight)))
    assert [one.way_m == 0 for one in found.prospects] == [True, False]
    assert all(np.isfinite(one.per_metre) for one in found.prospects), "else nobody lets the answer in"


@pytest.mark.parametrize("within", [-0.5, 7.0, 1e300])
def test_a_chance_that_is_none_is_not_let_in(within):
    with pytest.raises(ValueError, match="is no probability"):
        opening(40, within)


@pytest.mark.parametrize("lengths", [{"look_m": -1.0}, {"look_m": 1e300}, {"elsewhere_m": -40.0}])
def test_a_way_that_is_none_is_neither_set_nor_let_in(lengths):
    for kind in (Foresight, ForesightConfig):
        with pytest.raises(ValueError, match=next(iter(lengths))):
            kind(**lengths)
