"""Priors revised by what robots have seen: what regions of maps are, what each robot counts, what a model may do."""

import json
import re

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.priors import (
    ModelReply,
    ModelRequest,
    ObjectPrior,
    Prior,
    PriorEvidence,
    PriorRevision,
    Provenance,
    RegionPrior,
)
from prior_sg.schemas.status import Tick
from prior_sg.services.prior_gateway.core import estimation, learning, revising, turns
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.estimation import EstimationConfig, robot_weights
from prior_sg.services.prior_gateway.core.learning import LearningConfig
from prior_sg.services.prior_gateway.outside import prompts
from tests.help.gateway import Gateway
from tests.help.model import fill

ROOMS, THINGS = ["kitchen", "bathroom", "hall"], ["stove", "toilet", "coat rack", "bench", "lathe", "saw"]
TRUE = np.array([[0.9, 0.02, 0.02], [0.02, 0.9, 0.02], [0.02, 0.02, 0.9]])
DAY_NS = 24 * 3600 * 10**9
PROMPTS = prompts.load("v2")


def stated(held: np.ndarray, vocabulary=()) -> Prior:
    """Three rooms; what they hold of the first three things."""
    containment = np.full((3, len(THINGS)), 0.02, np.float32)
    containment[:, :3] = held
    adjacency = np.full((3, 3), 0.3, np.float32)
    np.fill_diagonal(adjacency, 1.0)
    return Prior(
        environment="home", task="tidy up", vocabulary=list(vocabulary),
        regions=[RegionPrior(name=name, phrases=[name], existence=1 / 3) for name in ROOMS],
        objects=[ObjectPrior(name=name, phrases=[name]) for name in THINGS],
        containment=containment, adjacency=adjacency, provenance=Provenance(source="library"),
    )  # fmt: skip


def a_map(prior: Prior, robot: str, epoch: int, looks, things: list[list[str]], *, labels=None) -> PriorEvidence:
    """Regions in a row: what they look like (log P each), what they hold, and the labels that the prior gave them."""
    count, columns = len(things), [item.name for item in prior.objects]
    contents = np.zeros((count, len(columns)), np.float32)
    for row, names in enumerate(things):
        contents[row, [columns.index(name) for name in names]] = 1.0
    size = len(prior.regions)
    counted = np.bincount(labels if labels is not None else [0] * count, minlength=size).astype(np.float32)
    return PriorEvidence(
        robot=robot, epoch=epoch, stamp_ns=1, prior_digest=prior.digest(), environment=prior.environment,
        task=prior.task, vocabulary=prior.vocabulary, regions=[region.name for region in prior.regions],
        objects=columns, places=16 * counted, instances=counted, holding=np.zeros((size, len(columns)), np.float32),
        pairs=np.zeros((size, size), np.float32), touching=np.zeros((size, size), np.float32),
        sizes=np.full(count, 16, np.float32), looks=np.asarray(looks, np.float32), contents=contents,
        links=np.array([[i, i + 1] for i in range(count - 1)], np.int32).reshape(-1, 2),
    )  # fmt: skip


def looking_like(*rooms: int, by: float = 1.0) -> np.ndarray:
    """Log P of rooms that look like these, `by` against each other one."""
    return np.where(np.eye(3)[list(rooms)] > 0, -0.5, -0.5 - by)


HOME = [["stove"], ["toilet"], ["coat rack"]]


def test_a_prior_that_has_exchanged_two_rooms_does_not_confirm_itself():
    """Each map's labels follow the contents that the prior expects: they are wrong, and the looks are right."""
    wrong = stated(TRUE[[1, 0, 2]])
    maps = [a_map(wrong, f"r{i}", 1, looking_like(0, 1, 2), HOME, labels=[1, 0, 2]) for i in range(6)]
    seen = learning.estimate(wrong, maps, LearningConfig())
    assert [belief.argmax(axis=1).tolist() for belief in seen.beliefs] == [[0, 1, 2]] * 6
    after = learning.revised(wrong, seen.totals, 4.0, wrong.provenance)
    assert after.containment[0, 0] > 0.7 and after.containment[0, 1] < 0.3
    np.testing.assert_allclose(after.containment[2, :3], TRUE[2], atol=0.1)
    assert after.tested.regions == pytest.approx([6, 6, 6], abs=0.3)
    after.check()


def test_a_region_that_looks_like_another_is_named_by_what_all_maps_say_it_holds():
    prior = stated(np.full((3, 3), 0.3))
    maps = [a_map(prior, f"r{i}", 1, looking_like(0, 1, 2), HOME) for i in range(6)]
    lookalike = a_map(prior, "r", 1, np.vstack((looking_like(1, by=0.3), looking_like(1, 2))), HOME)
    seen = learning.estimate(prior, [*maps, lookalike], LearningConfig())
    assert seen.beliefs[-1].argmax(axis=1).tolist() == [0, 1, 2], "a stove makes it a kitchen"


@pytest.mark.parametrize(("mistaken", "most"), [(0, 1.0), (3, 0.7)])
def test_looks_that_are_as_sure_of_the_wrong_room_are_worth_less(mistaken, most):
    """In so many of ten maps the kitchen looks like a bathroom and the other way round, as firmly as in the rest."""
    prior = stated(TRUE)
    looks = [looking_like(*((1, 0, 2) if i < mistaken else (0, 1, 2)), by=2.0) for i in range(10)]
    maps = [a_map(prior, f"r{i}", 1, one, HOME) for i, one in enumerate(looks)]
    seen = learning.estimate(prior, maps, LearningConfig())
    assert seen.looks is not None and seen.looks <= most and (mistaken or seen.looks == 1.0)
    after = learning.revised(prior, seen.totals, 4.0, prior.provenance, seen.looks)
    assert decode(Prior, encode(after)).tested.looks == seen.looks


def test_without_objects_nobody_knows_what_looks_are_worth():
    prior = stated(TRUE)
    maps = [a_map(prior, f"r{i}", 1, looking_like(1, 0, 2, by=0.1), HOME) for i in range(10)]
    none = np.zeros((3, 0), np.float32)
    bare = [msgspec.structs.replace(seen, objects=[], holding=none, contents=none) for seen in maps]
    assert learning.estimate(prior, bare, LearningConfig()).looks is None


def test_a_prior_that_is_right_stays_right():
    right = stated(TRUE)
    maps = [a_map(right, f"r{i}", 1, looking_like(0, 1, 2), HOME) for i in range(10)]
    after = learning.revised(right, learning.estimate(right, maps, LearningConfig()).totals, 4.0, right.provenance)
    assert np.abs(after.containment - right.containment).max() < 0.1
    np.testing.assert_allclose([region.existence for region in after.regions], 1 / 3, atol=0.01)


def test_a_row_that_foretold_what_was_seen_is_worth_more_than_one_that_did_not():
    rows, trials = np.array([[0.9, 0.1], [0.9, 0.1]]), np.full((2, 2), 10.0)
    (firm, loose), _ = estimation.strengths(rows, trials, np.array([[9.0, 1.0], [1.0, 9.0]]), 4.0)
    assert firm >= 4.0 > loose
    assert estimation.strengths(rows, np.zeros((2, 2)), np.zeros((2, 2)), 4.0)[0].tolist() == [4.0, 4.0]


@pytest.mark.parametrize(
    ("amounts", "weights"),
    [
        ([5], [1]),
        ([5, 50], [1, 1]),  # of two nobody can tell which is right
        ([10] * 9 + [1000], [1] * 9 + [0.046363]),  # 0.34 (90 + x) = x
        ([1, 10, 10, 10], [1] * 4),
        ([], []),
    ],
)
def test_no_robot_brings_more_than_its_share(amounts, weights):
    prior = stated(TRUE)
    maps = [
        msgspec.structs.replace(a_map(prior, f"r{i}", epoch, looking_like(0), [["stove"]]))
        for i, amount in enumerate(amounts)
        for epoch in range(amount)
    ]
    found = robot_weights(maps, EstimationConfig().robot_share)
    assert list(found.values()) == pytest.approx(weights, abs=1e-4)


def test_a_robot_that_lies_in_a_hundred_maps_does_not_outvote_nine_that_do_not():
    right = stated(TRUE)
    honest = [a_map(right, f"r{i}", 1, looking_like(0, 1, 2), HOME) for i in range(9)]
    lies = [a_map(right, "liar", i, looking_like(0, 1, 2, by=9.0), [["toilet"], ["stove"], []]) for i in range(100)]

    def kitchen(maps) -> np.ndarray:
        totals = learning.estimate(right, maps, LearningConfig()).totals
        return learning.revised(right, totals, 4.0, right.provenance).containment[0, :2]

    stove, toilet = kitchen([*honest, *lies])
    assert stove > 0.6 and toilet < 0.4
    with_nobody_else = kitchen(lies)
    assert with_nobody_else[1] > 0.8, "the same lies, believed"


def test_maps_of_older_senders_count_by_their_labels():
    prior = stated(np.full((3, 3), 0.5))
    told = a_map(prior, "r", 1, looking_like(0), [["stove"]])
    old = msgspec.structs.replace(
        told,
        sizes=np.zeros(0, np.float32), looks=np.zeros((0, 0), np.float32), contents=np.zeros((0, 0), np.float32),
        links=np.zeros((0, 2), np.int32), instances=np.array([2, 0, 0], np.float32),
        holding=np.array([[1, 0, 0, 0, 0, 0], [0] * 6, [0] * 6], np.float32),
    )  # fmt: skip
    totals = learning.estimate(prior, [decode(PriorEvidence, encode(old))], LearningConfig()).totals
    assert (totals.instances[0, 0], totals.holding[0, 0], totals.shares.tolist()) == (2, 1, [1, 0, 0])


def test_a_prior_that_nobody_has_revised_is_written_as_before():
    written = encode(stated(TRUE))
    assert not [word for word in (b"tested", b"root_digest", b"contributors") if word in written]


# The gateway


def counting(**changes) -> Gateway:
    prior = stated(TRUE[[1, 0, 2]])
    return Gateway(Config(archive="", **changes), {"preferred": prior})


def revised_by(gateway: Gateway, by_model: bool = False) -> list[Prior]:
    return gateway.feed(
        PriorRevision(environment="home", task="tidy up", by_model=by_model), *[Tick(stamp_ns=n) for n in range(4)]
    )


def test_a_revised_prior_names_its_parents_and_who_contributed_and_a_new_robot_starts_with_it():
    gateway, wrong = counting(), stated(TRUE[[1, 0, 2]])
    gateway.feed(*[a_map(wrong, f"r{i % 2}", i, looking_like(0, 1, 2), HOME) for i in range(6)])
    [first] = revised_by(gateway)
    made = first.provenance
    assert (made.parent_digest, made.root_digest, made.contributors) == (wrong.digest(), wrong.digest(), ["r0", "r1"])
    assert made.note.startswith("revised by counting in 6 maps of 2 robots")
    gateway.feed(a_map(wrong, "r2", 1, looking_like(0, 1, 2), HOME))
    [second] = revised_by(gateway)
    made = second.provenance
    assert (made.parent_digest, made.root_digest, made.contributors) == (
        first.digest(),
        wrong.digest(),
        ["r0", "r1", "r2"],
    )
    assert first.containment[0, 0] > 0.6


# The model


STRANGE = [["bench", "lathe", "saw"], ["toilet"], ["coat rack"]]


def strange_maps(prior: Prior) -> list[PriorEvidence]:
    return [a_map(prior, f"r{i}", 1, looking_like(0, 1, 2, by=3.0), STRANGE) for i in range(4)]


def answering(schema: dict, name: str) -> str:
    """A model that misses a workshop in the kitchen."""
    if name == "revise_regions":
        return json.dumps({"regions": [{"name": "workshop", "splits": "kitchen", "share": 10}]})
    answer = fill(schema)
    if name == "describe":
        answer["workshop"]["objects"] = ["lathe", "vice"]
    if name == "containment":
        answer = {"workshop": {thing: 80 for thing in answer["workshop"]}}
    return json.dumps(answer)


def talk(**changes) -> turns.Talk:
    return turns.Talk(PROMPTS, turns.SynthesisConfig(samples=1, reason=False, repairs=0, **changes))


def concluded(dialogue, model) -> tuple[revising.Revision, list[turns.Turn]]:
    asked, turn = [], next(dialogue)
    while True:
        asked.append(turn)
        try:
            turn = dialogue.send(model(turn.schema, turn.name))
        except StopIteration as end:
            return end.value, asked


def test_places_that_hold_other_things_than_their_region_are_told_to_the_model():
    prior = stated(TRUE)
    lines, objects = learning.unexplained(prior, learning.estimate(prior, strange_maps(prior), LearningConfig()))
    assert lines == "- 4 of 4 places taken for kitchen hold other things: bench (4), lathe (4), saw (4)"
    assert objects == ["bench", "lathe", "saw"]
    usual = [a_map(prior, f"r{i}", 1, looking_like(0, 1, 2), HOME) for i in range(4)]
    assert learning.unexplained(prior, learning.estimate(prior, usual, LearningConfig())) == ("", [])


def test_a_model_adds_the_region_that_it_misses():
    prior = stated(TRUE)
    strange = ("- 4 of 4 places ...", ["bench", "lathe", "saw"])
    found, asked = concluded(revising.revision(prior, "", {}, strange, talk()), answering)
    assert [turn.name for turn in asked] == ["revise_regions", "describe", "containment", "neighbours"]
    assert "- 4 of 4 places ..." in asked[0].messages[-1][1]
    after = revising.applied(prior, found, lambda name: [f"a {name}"], Provenance(source="m"))
    after.check()
    assert [region.name for region in after.regions] == [*ROOMS, "workshop"]
    assert [item.name for item in after.objects] == [*THINGS, "vice"]
    row = dict(zip([item.name for item in after.objects], after.containment[3].tolist(), strict=True))
    assert row["lathe"] == row["vice"] == pytest.approx(0.8) and row["stove"] == pytest.approx(0.9), "as the kitchen"
    assert after.regions[3].phrases[0] == "a workshop"
    assert sum(region.existence for region in after.regions) == pytest.approx(1)
    assert after.regions[0].existence == pytest.approx(1 / 3 - 0.1), "its share is the kitchen's"


@pytest.mark.parametrize(
    ("said", "fault"),
    [
        ({"name": "kitchen", "splits": "none", "share": 5}, "expected already"),
        ({"name": "attic", "splits": "cellar", "share": 5}, "no region 'cellar' to split"),
        ({"name": "attic", "splits": "none", "share": 80}, "between 0 and 50 percent"),
    ],
)
def test_regions_that_cannot_be_are_refused_and_percentages_kept(said, fault):
    form = {"containment": {"kitchen": {"stove": (90.0, 10.0)}}}

    def model(schema, name):
        return (
            json.dumps({"regions": [said]})
            if name == "revise_regions"
            else json.dumps({"containment": {"kitchen": {"stove": 40}}})
        )

    found, _ = concluded(revising.revision(stated(TRUE), "- ...", form, ("- ...", []), talk()), model)
    assert found.entries == {"containment": {"kitchen": {"stove": 40}}}
    assert found.additions == () and fault in found.remark


def as_expected(text: str) -> str:
    """A model that stays with what it was told that it expected."""
    said: dict = {"containment": {}, "adjacency": {}}
    for row, verb, column, percent in re.findall(r"^- (.+) (holds|touches) (.+): expected (\d+) %", text, re.MULTILINE):
        said["containment" if verb == "holds" else "adjacency"].setdefault(row, {})[column] = int(percent)
    return json.dumps({matrix: rows for matrix, rows in said.items() if rows})


class Modelled(Gateway):
    """A gateway whose model is `answering`, and what that was asked."""

    def __init__(self, vocabulary=(), **limits) -> None:
        self.asked: list[str] = []
        cfg = Config(
            archive="", provider="openai", endpoint="http://127.0.0.1:1/v1", model="m",
            learning=LearningConfig(**limits), synthesis=turns.SynthesisConfig(samples=1, reason=False, repairs=0),
        )  # fmt: skip
        super().__init__(cfg, {"preferred": stated(TRUE, vocabulary)})
        prior = stated(TRUE, vocabulary)
        self.feed(*strange_maps(prior))

    def do(self, errand, request):
        if not isinstance(request, ModelRequest):
            return super().do(errand, request)
        self.asked.append(request.schema_name)
        question = request.messages[-1][1]
        named = request.schema_name
        text = as_expected(question) if named == "revise" else answering(json.loads(request.schema), named)
        return ModelReply(conversation=request.conversation, turn=request.turn, text=text, tokens_in=100, tokens_out=50)

    def revise(self, by_model: bool, day: int = 0, vocabulary=()) -> list[Prior]:
        ticks = [Tick(stamp_ns=day * DAY_NS + n) for n in range(4)]
        return self.feed(
            PriorRevision(environment="home", task="tidy up", regions=list(vocabulary), by_model=by_model), *ticks
        )


ALL = ["revise", "revise_regions", "describe", "containment", "neighbours"]


def test_the_model_revises_regions_and_maps_go_on_revising_what_it_added():
    gateway = Modelled()
    [first] = gateway.revise(by_model=True)
    assert gateway.asked == ALL
    assert first.provenance.note.endswith("with workshop as a part of kitchen")
    gateway.feed(a_map(first, "r9", 1, [[-3.0, -3, -3, -0.1]], [["lathe"]]))
    [second] = gateway.revise(by_model=False)
    assert [region.name for region in second.regions] == [*ROOMS, "workshop"]
    assert second.provenance.parent_digest == first.digest()
    assert second.tested.regions[3] > 0.9


def test_regions_that_the_task_has_fixed_stay():
    gateway = Modelled(vocabulary=ROOMS)
    [prior] = gateway.revise(by_model=True, vocabulary=ROOMS)
    assert gateway.asked == ["revise"]
    assert [region.name for region in prior.regions] == ROOMS


def test_observations_outvote_a_model_that_stays_with_what_was_expected():
    gateway, wrong = Modelled(vocabulary=ROOMS), stated(TRUE[[1, 0, 2]], ROOMS)
    gateway.found = {"preferred": wrong}
    gateway.feed(*[a_map(wrong, f"r{i}", 1, looking_like(0, 1, 2), HOME) for i in range(6)])
    [prior] = gateway.revise(by_model=True, vocabulary=ROOMS)
    assert gateway.asked == ["revise"]
    assert prior.containment[0, 0] > 0.6 and prior.containment[0, 1] < 0.4


@pytest.mark.parametrize(("limits", "calls"), [({"calls_per_day": 3}, 3), ({"tokens_per_day": 300}, 2)])
def test_what_a_model_may_cost_for_an_environment_a_day_is_kept(limits, calls):
    gateway = Modelled(**limits)
    [prior] = gateway.revise(by_model=True)
    assert gateway.asked == ALL[:calls]
    assert "are spent" in prior.provenance.note, "what was revised before that is kept"
    assert [region.name for region in prior.regions] == ROOMS
    assert gateway.revise(by_model=True) == [] and len(gateway.asked) == calls
    gateway.revise(by_model=True, day=1)
    assert len(gateway.asked) > calls, "another day"
