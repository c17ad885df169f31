"""Priors from models: conversation, checks, averaging, learning, sharing; all without a network."""

import json
import re
from string import Template

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.schemas.priors import PriorClaim, PriorEvidence, Provenance, Task
from prior_sg.services.prior_gateway.core import compose, ensemble, estimation, learning, revising
from prior_sg.services.prior_gateway.core import turns as synthesis
from prior_sg.services.prior_gateway.core.claims import Claims
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.matching import same_region
from prior_sg.services.prior_gateway.outside import library, prompts
from prior_sg.services.runtime.service import ServiceError
from tests.help.model import REGIONS, fill, reply_to

PROMPTS = prompts.load("v2")
CFG = synthesis.SynthesisConfig(samples=1, reason=False)
LIBRARY = library.load()


def task(regions=(), environment="residential home", name="clean"):
    return Task(robot="r", stamp_ns=1, environment=environment, task=name, regions=list(regions))


def drive(dialogue, model=reply_to, limit=60):
    """The value of a dialogue with a function from schema to text, and the turns it took."""
    turns, turn = [], next(dialogue)
    for _ in range(limit):
        turns.append(turn)
        try:
            turn = dialogue.send(model(turn.schema))
        except StopIteration as end:
            return end.value, turns
    raise AssertionError("the dialogue does not end")


def broken_once(change, name):
    """A model whose first answer of that name is changed."""
    done = []

    def model(schema):
        answer = fill(schema)
        if schema is not None and name(answer) and not done:
            done.append(True)
            answer = change(answer) or answer
        return answer if isinstance(answer, str) else json.dumps(answer)

    return model


# The conversation


def test_a_form_is_told_in_few_words():
    item = synthesis.form_of({"name": synthesis.TEXT, "splits": {"type": "string", "enum": ["hall", "none"]}})
    form = synthesis.form_of({"regions": {"type": "array", "items": item, "maxItems": 2}, "share": {"type": "integer"}})
    form["properties"]["share"] |= {"minimum": 0, "maximum": 100, "enum": list(range(101))}
    assert synthesis.outline(form) == (
        '{"regions": [{"name": "text", "splits": "hall" or "none"}, 0 to 2 of these], "share": <0 to 100>}'
    )


def test_top_down_regions_objects_matrices():
    draft, turns = drive(synthesis.synthesise(task(), PROMPTS, CFG))
    assert [turn.name for turn in turns] == ["regions", "describe", "sizes", "containment", "adjacency"]
    assert draft.regions == list(REGIONS)
    assert draft.objects == ["door", "coat rack", "stove", "sink", "bed", "lamp", "bath"]
    assert draft.existence == pytest.approx([0.2, 0.3, 0.4, 0.1])
    assert draft.sizes_m[[0, 4, 5]] == pytest.approx(
        np.array([[0.9, 0.1, 2.05, 0], [2, 1.5, 0.6, 0], [0.3, 0.3, 0.5, 0.6]])
    )
    assert draft.containment[1, 2] == pytest.approx(0.9)
    assert draft.containment[2, 2] == pytest.approx(0.05)
    assert draft.adjacency[0] == pytest.approx([1, 0.6, 0.6, 0.6])
    assert np.array_equal(draft.adjacency, draft.adjacency.T)
    assert draft.query_radius_m == pytest.approx([0.8] * 4)


def test_fixed_vocabulary_keeps_names_and_asks_for_everything_else():
    names = ["Quiet Area", "games area", "sun lounge"]
    draft, turns = drive(synthesis.synthesise(task(names), PROMPTS, CFG))
    assert draft.regions == names
    assert [turn.name for turn in turns] == ["fixed_regions", "describe", "sizes", "containment", "adjacency"]
    assert "Quiet Area, games area, sun lounge" in turns[0].messages[-1][1]


def test_one_region_needs_no_adjacency():
    draft, turns = drive(synthesis.synthesise(task(["hall"]), PROMPTS, CFG))
    assert draft.adjacency.tolist() == [[1.0]]
    assert "adjacency" not in [turn.name for turn in turns]


def test_small_models_are_asked_region_by_region():
    cfg = msgspec.structs.replace(CFG, regions_per_call=1)
    draft, turns = drive(synthesis.synthesise(task(), PROMPTS, cfg))
    assert [turn.name for turn in turns] == ["regions", *["describe"] * 4, "sizes", *["containment"] * 4, "adjacency"]
    assert draft.containment.shape == (4, 7)


def test_sides_are_chosen_from_geometric_steps_where_the_server_knows_no_bounds():
    cfg = msgspec.structs.replace(CFG, steps=10)
    _, turns = drive(synthesis.synthesise(task(), PROMPTS, cfg))
    form = next(turn.schema for turn in turns if turn.name == "sizes")["properties"]["door"]["properties"]
    assert form["height_cm"]["enum"] == [2, 4, 8, 16, 32, 63, 126, 251, 501, 1000]
    assert form["bottom_cm"]["enum"][0] == 0
    many = msgspec.structs.replace(CFG, steps=200).length["enum"]
    assert len(many) == len(set(many))


def test_reasoning_comes_before_the_answer():
    cfg = msgspec.structs.replace(CFG, reason=True)
    _, turns = drive(synthesis.synthesise(task(), PROMPTS, cfg))
    assert [turn.schema is None for turn in turns] == [True, False] * 5
    roles = [role for role, _ in turns[1].messages]
    assert roles == ["system", "user", "assistant", "user"]
    assert turns[1].messages[2][1] == "Let me think about this place."


def is_matrix(answer):
    return isinstance(answer, dict) and isinstance(next(iter(answer.values())), dict)


def is_adjacency(answer):
    return is_matrix(answer) and "kitchen" in answer.get("hall", {})


def is_containment(answer):
    return is_matrix(answer) and "stove" in answer.get("hall", {})


def is_regions(answer):
    return isinstance(answer, dict) and isinstance(answer.get("regions"), list)


def is_description(answer):
    return is_matrix(answer) and "phrases" in answer.get("hall", {})


def is_sizes(answer):
    return is_matrix(answer) and "height_cm" in answer.get("door", {})


def put(*path, value=None, drop=False):
    def change(answer):
        at = answer
        for key in path[:-1]:
            at = at[key]
        if drop:
            del at[path[-1]]
        else:
            at[path[-1]] = value

    return change


SIDES = ("longest_cm", "shortest_cm", "height_cm", "bottom_cm")
FAULTS = {
    "a name twice": (is_regions, put("regions", 1, "name", value="Hall"), "'hall' is named more than once"),
    "no name": (is_regions, put("regions", 1, "name", value=" ?"), "neither letter nor digit"),
    "an endless name": (is_regions, put("regions", 1, "name", value="x" * 99), "too long"),
    "too few": (is_regions, put("regions", value=[]), "between 3 and 12"),
    "shares as fractions": (
        is_regions,
        lambda a: [at.update(share=0.25) for at in a["regions"]] and None,
        "percentages and sum to 100",
    ),
    "no phrase": (is_description, put("hall", "phrases", value=["", " "]), "there is no phrase"),
    "an endless phrase": (is_description, put("hall", "phrases", value=["x" * 999]), "longer than"),
    "a vertical spread": (is_description, put("hall", "inclination_spread_deg", value=0), "its spread at least"),
    "a spread beyond numbers": (is_description, put("hall", "inclination_spread_deg", value=1e-200), "at least 0.01"),
    "size in metres": (
        is_sizes,
        lambda answer: {name: {side: value / 100 for side, value in row.items()} for name, row in answer.items()},
        "look like metres",
    ),
    "sides swapped": (is_sizes, put("door", "shortest_cm", value=95), "shortest side is longer"),
    "no height": (is_sizes, put("door", "height_cm", value=0), "between 0 and"),
    "size of an unknown object": (is_sizes, put("moon", value=dict.fromkeys(SIDES, 9)), "no object 'moon'"),
    "size left out": (is_sizes, put("bed", drop=True), "'bed' is missing"),
    "below the floor": (is_sizes, put("bed", "bottom_cm", value=-20), "lower edge"),
    "scale in metres": (is_description, put("hall", "scale_cm", value=0.75), "no sensible distance"),
    "another shape": (is_description, put("hall", "phrases", value="a door"), "form asked for"),
    "an object missing": (is_containment, put("hall", "stove", drop=True), "the object 'stove' of 'hall' is missing"),
    "a region missing": (is_containment, put("hall", drop=True), "the region 'hall' is missing"),
    "an unknown region": (is_containment, put("attic", value={}), "there is no region 'attic'"),
    "out of range": (is_containment, put("hall", "stove", value=120), "120 is no percentage"),
    "negative": (is_containment, put("hall", "stove", value=-1), "-1 is no percentage"),
    "fractions": (
        is_containment,
        lambda a: [row.update(dict.fromkeys(row, 0.5)) for row in a.values()] and None,
        "look like fractions",
    ),
    "not a number": (is_containment, lambda a: json.dumps(a).replace("90", "NaN", 1), "not valid JSON"),
    "a pair missing": (is_adjacency, put("hall", "kitchen", drop=True), "'hall' and 'kitchen' is missing"),
    "asymmetric": (is_adjacency, put("kitchen", "hall", value=5), "60 the other; it is one pair"),
    "an unknown neighbour": (is_adjacency, put("hall", "attic", value=5), "there is no region 'attic'"),
    "cut off": (is_adjacency, lambda a: json.dumps(a)[:40], "cut off|not valid JSON"),
    "a refusal": (is_regions, lambda a: "I'm sorry, I can't help with that.", "no JSON object in it, but: \"I'm sorry"),
    "nothing": (is_regions, lambda a: "  ", "it is empty"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_faulty_answer_goes_back_with_its_faults(case):
    which, change, says = FAULTS[case]
    draft, turns = drive(synthesis.synthesise(task(), PROMPTS, CFG), broken_once(change, which))
    assert len(turns) == 6, "one repair"
    repair = next(turn for turn in turns if "cannot be used" in turn.messages[-1][1])
    assert re.search(says, repair.messages[-1][1]), repair.messages[-1][1]
    assert repair.messages[-2][0] == "assistant"
    assert draft.regions == list(REGIONS)


def test_both_directions_of_a_pair_are_averaged_when_they_agree():
    model = broken_once(put("kitchen", "hall", value=70), is_adjacency)
    draft, _ = drive(synthesis.synthesise(task(), PROMPTS, CFG), model)
    assert draft.adjacency[0, 1] == draft.adjacency[1, 0] == pytest.approx(0.65)


def test_after_the_last_repair_the_answer_is_unusable():
    cfg = msgspec.structs.replace(CFG, repairs=2)
    asked = []

    def model(schema):
        asked.append(schema)
        return "I'm sorry."

    with pytest.raises(synthesis.Unusable, match=r"regions was still faulty after 2 repairs: there is no JSON"):
        drive(synthesis.synthesise(task(), PROMPTS, cfg), model)
    assert len(asked) == 3


@pytest.mark.parametrize(
    "text",
    [
        '```json\n{"a": {"b": 1}}\n```',
        'Here you are: {"a": {"b": 1}}',
        '<think>{"x"}</think>{"a": {"b": 1}} Anything else?',
    ],
)
def test_json_is_found_in_what_surrounds_it(text):
    assert synthesis.parse(text, dict[str, dict[str, float]]) == ({"a": {"b": 1.0}}, [])


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=6) | st.integers(-5, 120),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from([*REGIONS, "regions", "phrases", "x"]), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(max_examples=150)
@given(answers=st.lists(JSON.map(json.dumps) | st.text(max_size=30), min_size=4, max_size=4), after=st.integers(0, 3))
def test_whatever_a_model_says_the_dialogue_ends_in_a_draft_or_unusable(answers, after):
    said = []

    def model(schema):
        said.append(schema)
        return answers[len(said) % 4] if len(said) > after else reply_to(schema)

    try:
        draft, _ = drive(synthesis.synthesise(task(), PROMPTS, CFG), model)
    except synthesis.Unusable:
        return
    assert np.isfinite(draft.containment).all()
    assert np.isfinite(draft.adjacency).all()


def test_prompts_have_a_version_and_wrong_ones_are_named(tmp_path):
    assert PROMPTS.version.startswith("v2-")
    with pytest.raises(ServiceError, match=r"v9.*v1"):
        prompts.load("v9")
    for name, template in PROMPTS.texts.items():
        (tmp_path / f"{name}.txt").write_text(template.template)
    assert prompts.load(str(tmp_path)).version.split("-")[-1] == PROMPTS.version.split("-")[-1]
    (tmp_path / "regions.txt").write_text("$environment $nonsense")
    with pytest.raises(ServiceError, match=r"regions.txt may use \$environment, \$most_regions, \$task"):
        prompts.load(str(tmp_path))
    assert all(isinstance(template, Template) for template in PROMPTS.texts.values())


# Averaging


def draft_of(regions, objects, held, touching, **changes):
    count = len(regions)
    fields = {
        "regions": regions,
        "parents": ["home"] * count,
        "existence": np.full(count, 1 / count),
        "phrases": [[f"inside {name}"] for name in regions],
        "inclination_deg": np.tile((0.0, 5.0), (count, 1)),
        "query_radius_m": np.full(count, 0.75),
        "objects": objects,
        "sizes_m": np.ones((len(objects), 4)),
        "containment": np.array(held, dtype=float),
        "adjacency": np.array(touching, dtype=float),
    }
    return synthesis.Draft(**(fields | changes))


def combined(drafts, regions=()):
    return ensemble.combine(
        task(regions),
        drafts,
        lambda one, other: same_region(one, other, LIBRARY.environments),
        lambda name: compose.phrases_of(name, Config()),
        Provenance(source="m"),
    )


def test_samples_are_aligned_over_synonyms_and_averaged():
    one = draft_of(
        ["lounge", "kitchen", "attic"], ["sofa", "oven"], [[0.9, 0.1], [0.1, 0.8], [0.1, 0.1]], np.full((3, 3), 0.4)
    )
    two = draft_of(["kitchen", "living room"], ["oven"], [[0.6], [0.3]], [[1, 0.8], [0.8, 1]])
    three = draft_of(["living room", "kitchen"], ["oven", "sofa"], [[0.2, 0.7], [0.7, 0.1]], [[1, 0.6], [0.6, 1]])
    prior = combined([one, two, three])
    prior.check()
    assert [region.name for region in prior.regions] == ["living room", "kitchen"], "the attic is one sample's whim"
    names = [item.name for item in prior.objects]
    oven, sofa = names.index("oven"), names.index("sofa")
    assert prior.containment[0, oven] == pytest.approx((0.1 + 0.3 + 0.2) / 3)
    assert prior.containment[0, sofa] == pytest.approx((0.9 + 0.7) / 2), "over the samples that speak of it"
    assert prior.adjacency[0, 1] == pytest.approx((0.4 + 0.8 + 0.6) / 3)
    assert prior.spread.adjacency[0, 1] == pytest.approx(np.std([0.4, 0.8, 0.6]), abs=1e-6)
    assert prior.spread.containment[0, sofa] == pytest.approx(0.1, abs=1e-6)
    assert prior.spread.support.tolist() == [1.0, 1.0]
    assert prior.regions[0].phrases[:2] == ["a living room", "inside lounge"]


def test_sizes_are_geometric_means_and_their_differences_widen_the_spread():
    one = draft_of(["a"], ["x", "y"], [[0.2, 0.2]], [[1]], sizes_m=np.array([[1.0, 0.5, 0.8, 0.0], [2, 1, 3, 0.4]]))
    two = draft_of(["a"], ["y", "x"], [[0.2, 0.2]], [[1]], sizes_m=np.array([[2.0, 1.0, 3.0, 0.8], [4, 0.5, 0.8, 0]]))
    x, y = combined([one, two]).objects
    assert x.size_m == pytest.approx((2.0, 0.5, 0.8)) and x.bottom_m == 0.0
    # logarithms of the longest side: 0 and log 4, variance (log 2)^2; mean over three sides
    assert x.size_spread == pytest.approx(np.sqrt(0.35**2 + np.log(2) ** 2 / 3))
    assert y.size_m == pytest.approx((2.0, 1.0, 3.0)) and y.bottom_m == pytest.approx(0.6)
    assert y.size_spread == pytest.approx(0.35)


def test_one_sample_has_no_spread_and_keeps_everything():
    one = draft_of(["a", "b"], ["x"], [[0.2], [0.3]], [[1, 0.5], [0.5, 1]], existence=np.array([0.9, 0.1]))
    prior = combined([one])
    assert [region.existence for region in prior.regions] == pytest.approx([0.9, 0.1])
    assert float(prior.spread.containment.max()) == 0


def test_two_names_of_one_sample_stay_two_regions():
    two = draft_of(["lounge", "living room"], ["x"], [[0.2], [0.4]], [[1, 0.5], [0.5, 1]])
    prior = combined([two, two])
    assert [region.name for region in prior.regions] == ["lounge", "living room"]
    assert prior.containment[:, 0] == pytest.approx([0.2, 0.4])


def test_inclinations_are_a_mixture():
    flat = draft_of(["a", "b"], ["x"], [[0.2], [0.3]], np.ones((2, 2)))
    steep = draft_of(["a", "b"], ["x"], [[0.2], [0.3]], np.ones((2, 2)), inclination_deg=np.tile((30.0, 5.0), (2, 1)))
    region = combined([flat, steep]).regions[0]
    # mean 15; variance 25 + 15^2 = 250
    assert np.degrees(region.inclination_mean_rad) == pytest.approx(15)
    assert np.degrees(region.inclination_std_rad) == pytest.approx(np.sqrt(250))


def test_samples_that_agree_on_nothing_still_give_a_prior():
    drafts = [draft_of([f"{x}{i}" for x in "ab"], ["o"], [[0.2], [0.3]], np.ones((2, 2))) for i in range(3)]
    combined(drafts).check()


# Learning, by numbers worked by hand


def library_prior(regions=("kitchen", "bathroom", "hallway")):
    return LIBRARY.answer(task(regions), Config())


def evidence(prior, epoch, **counts):
    regions, objects = [r.name for r in prior.regions], [o.name for o in prior.objects]
    shape = {"places": (3,), "instances": (3,), "holding": (3, len(objects)), "pairs": (3, 3), "touching": (3, 3)}
    arrays = {name: np.zeros(size, dtype=np.float32) for name, size in shape.items()}
    for name, entries in counts.items():
        for at, value in entries.items():
            arrays[name][at] = value
    return PriorEvidence(
        robot="r", epoch=epoch, stamp_ns=1, prior_digest=prior.digest(), environment=prior.environment, task=prior.task,
        vocabulary=prior.vocabulary, regions=regions, objects=objects, **arrays,
    )  # fmt: skip


def counted(prior, seen):
    return learning.estimate(prior, seen, learning.LearningConfig()).totals


def test_counts_are_added_as_pseudo_counts():
    prior = library_prior()
    toilet = [item.name for item in prior.objects].index("toilet")
    seen = [
        evidence(
            prior,
            epoch,
            places={0: 30, 1: 10},
            instances={0: 1, 1: 2},
            holding={(1, toilet): 1},
            pairs={(0, 1): 2, (1, 0): 2},
            touching={(0, 1): 2, (1, 0): 2},
        )
        for epoch in (1, 2)
    ]
    totals = counted(prior, seen)
    after = learning.revised(prior, totals, 4.0, Provenance(source="s"))
    stated, rows = estimation.likeliest_rows(prior.containment, totals.instances, totals.holding, 4.0)
    assert after.containment[1, toilet] == pytest.approx((rows[1, 0] * stated[1, toilet] + 2) / (rows[1, 0] + 4))
    assert after.containment[2] == pytest.approx(prior.containment[2].clip(0.01, 0.99)), "never seen, never changed"
    ends = estimation.strengths(prior.adjacency, totals.pairs, totals.touching, 4.0)[0]
    worth = min(ends[0], ends[1])
    assert after.adjacency[0, 1] == pytest.approx((worth * float(prior.adjacency[0, 1]) + 4) / (worth + 4))
    share = (4 * prior.regions[0].existence + 2 * 0.75) / (4 + 2)
    assert after.regions[0].existence == pytest.approx(share, abs=1e-4)
    after.check()


def test_evidence_of_other_names_is_left_out():
    prior = library_prior()
    other = evidence(
        library_prior(("garage", "bedroom", "hallway")), 1, places={0: 9, 2: 1}, pairs={(0, 2): 1, (2, 0): 1}
    )
    seen = counted(prior, [other])
    assert seen.maps == 1
    assert seen.shares.tolist() == [0, 0, 1]
    assert seen.pairs.sum() == 0


def test_disagreements_come_with_the_most_surprising_first():
    prior = library_prior()
    names = [item.name for item in prior.objects]
    stove, toilet = names.index("stove"), names.index("toilet")
    held = {(i, j): round(8 * float(p)) for (i, j), p in np.ndenumerate(prior.containment) if i < 2}
    held |= {(0, stove): 6, (1, toilet): 0}
    seen = counted(prior, [evidence(prior, 1, places={0: 1}, instances={0: 8, 1: 8}, holding=held)])
    first = learning.disagreements(prior, seen, 5)[0]
    assert (first.matrix, first.row, first.column, first.observed, first.trials) == (
        "containment",
        "bathroom",
        "toilet",
        0,
        8,
    )
    lines, form = learning.told([first])
    assert lines == "- bathroom holds toilet: expected 90 %, observed 0 % of 8"
    assert form == {"containment": {"bathroom": {"toilet": (pytest.approx(90), 0)}}}


@pytest.mark.parametrize(("given", "says"), [(40, ""), (95, "outside 0 to 90"), (None, "is missing")])
def test_a_model_may_weigh_evidence_but_not_contradict_it(given, says):
    prior, form = library_prior(), {"containment": {"bathroom": {"toilet": (90.0, 0.0)}}}
    dialogue = revising.revise(prior, "- ...", form, synthesis.Talk(PROMPTS, msgspec.structs.replace(CFG, repairs=0)))
    next(dialogue)
    said = json.dumps({"containment": {"bathroom": {"toilet": given} if given is not None else {}}})
    if says:
        with pytest.raises(synthesis.Unusable, match=says):
            dialogue.send(said)
        return
    with pytest.raises(StopIteration) as end:
        dialogue.send(said)
    after = learning.corrected(prior, end.value.value, Provenance(source="m"))
    assert after.containment[1, [item.name for item in prior.objects].index("toilet")] == pytest.approx(0.4)


@pytest.mark.parametrize("wrong", [{"instances": {0: -1}}, {"holding": {(0, 0): 2}}, {"touching": {(0, 1): 1}}])
def test_evidence_that_contradicts_itself_is_refused(wrong):
    with pytest.raises(ValueError, match=r"negative|more hits"):
        evidence(library_prior(), 1, **wrong)


# Sharing


def test_of_two_who_want_the_first_by_name_works():
    one, two = Claims(), Claims()
    one.hear(PriorClaim(question="q", holder="b", state="wants"))
    two.hear(PriorClaim(question="q", holder="a", state="wants"))
    assert not one.may_work("q", "a", 1), "not before everybody can have heard it"
    assert one.may_work("q", "a", 2)
    assert not two.may_work("q", "b", 99)


def test_whoever_works_is_left_to_it_until_its_lease_ends():
    claims = Claims()
    claims.hear(PriorClaim(question="q", holder="z", state="works"))
    assert not claims.may_work("q", "a", 99)
    assert claims.may_work("other", "a", 99)
    for _ in range(3):
        claims.tick(3)
    assert not claims.may_work("q", "a", 99)
    claims.hear(PriorClaim(question="q", holder="z", state="works"))
    for _ in range(4):
        claims.tick(3)
    assert claims.may_work("q", "a", 99)
    assert claims.heard == {}


def test_whoever_gives_up_holds_nobody_up():
    claims = Claims()
    claims.hear(PriorClaim(question="q", holder="a", state="works"))
    claims.hear(PriorClaim(question="q", holder="a", state="gave up"))
    assert claims.may_work("q", "b", 2)


def test_regions_that_mean_the_same():
    environments = LIBRARY.environments
    assert same_region("Lounge", "sitting room", environments)
    assert same_region("dining area", "dining room", environments)
    assert not same_region("kitchen", "bathroom", environments)
