"""What a model may put around, into and instead of its JSON, as long as it can mean only one thing."""

import json
import time
import unicodedata

import pytest

from prior_sg.services.prior_gateway.core.answers import CUT_OFF, parse
from prior_sg.services.prior_gateway.core.faults import Described, NamedList, Placed, Sized

Matrix = dict[str, dict[str, float]]
WANTED = {"kitchen": {"stove": 90.0, "bed": 5.0}, "café": {"stove": 40.0, "bed": 1.0}}
PLAIN = json.dumps(WANTED, ensure_ascii=False)
KEYS = (list(WANTED), ["stove", "bed"])


def title(text: str) -> str:
    return text.replace("kitchen", "Kitchen").replace("café", "CAFÉ ").replace("stove", "Stove")


READABLE = {
    "fence": f"Here it is:\n```json\n{PLAIN}\n```\nHope this helps!",
    "braces before": f"I use the form {{region: value}} as asked [see 1].\n{PLAIN}",
    "braces after": f"{PLAIN}\n\nNote: adapt {{names}} as needed.",
    "an empty example": f"not {{}} but {PLAIN}",
    "an example of other keys": f'such as {{"hall": {{"lamp": 3}}}}; so:\n{PLAIN}',
    "thoughts": f'<think>try {{"kitchen": {{"stove": 1}}}} first?</think>\n{PLAIN}',
    "thoughts without a beginning": f'maybe {{"a":1}}?\n</think>\n\n{PLAIN}',
    "twice": f"{PLAIN}\n{PLAIN}",
    "twice in another order": PLAIN + json.dumps(dict(reversed(WANTED.items()))),
    "in a list": f"[{PLAIN}]",
    "a list of entries": json.dumps([{name: row} for name, row in WANTED.items()]),
    "below a heading": f'{{"containment": {PLAIN}}}',
    "comma": PLAIN.replace("5.0", "5.0,").replace("}}", "} , }"),
    "comments": PLAIN[:-1] + " // done: {all}\n /* and } more */ }",
    "numbers in quotes": PLAIN.replace("90.0", '"90"').replace("5.0", '" 5.0 %"'),
    "case and spaces": title(PLAIN),
    "another Unicode form": unicodedata.normalize("NFD", PLAIN),
}


@pytest.mark.parametrize("case", READABLE)
def test_what_can_mean_only_one_thing_is_read(case):
    assert parse(READABLE[case], Matrix, *KEYS) == (WANTED, [])


REFUSED = {
    "nothing": ("", "it is empty"),
    "a refusal": ("I cannot help with that.", "no JSON object in it, but: 'I cannot"),
    "cut off": (PLAIN[:-5], CUT_OFF),
    "two answers": (PLAIN + PLAIN.replace("90.0", "80.0"), "2 different JSON objects"),
    "a key twice": ('{"kitchen": {"stove": 1, "stove": 2}}', "'stove' is given twice, differently"),
    "two spellings": ('{"kitchen": {"stove": 1}, "Kitchen": {"stove": 2}}', "'kitchen' and 'Kitchen' both name"),
    "null": (PLAIN.replace("90.0", "null"), "does not have the form asked for"),
    "true": (PLAIN.replace("90.0", "true"), "does not have the form asked for"),
    "not a number": (PLAIN.replace("90.0", "NaN"), "not valid JSON"),
    "too large a number": (PLAIN.replace("90.0", '"1' + "0" * 400 + '"'), "does not have the form asked for"),
    "another unit": (PLAIN.replace("90.0", '"90 m"'), "does not have the form asked for"),
    "half a character": (PLAIN.replace("kitchen", "kitchen\\ud83d"), "not valid JSON"),
    "too deep": ('{"a":' * 100_000 + "1" + "}" * 100_000, CUT_OFF),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_is_a_sentence(case):
    text, says = REFUSED[case]
    found, faults = parse(text, Matrix, *KEYS)
    assert found is None and len(faults) == 1 and says in faults[0], faults
    assert faults[0].isprintable()


def test_numbers_are_read_as_numbers_only_where_numbers_are_asked_for():
    text = '{"hall": {"phrases": ["40"], "objects": ["7"], "inclination_deg": "4°", "inclination_spread_deg": "5", '
    found, faults = parse(text + '"scale_cm": "150 cm"}}', dict[str, Described], ["hall"])
    assert not faults and found is not None
    assert (found["hall"].phrases, found["hall"].objects) == (["40"], ["7"])
    assert (found["hall"].inclination_deg, found["hall"].scale_cm) == (4.0, 150.0)


def test_a_region_named_like_a_field_renames_no_field():
    text = '{"Phrases": {"parent": "home", "share": 40}}'
    assert parse(text, dict[str, Placed], ["phrases"])[1] == []
    size = '{"OBJECTS": {"longest_cm": 4, "shortest_cm": 2, "height_cm": 1, "bottom_cm": 0}}'
    assert list(parse(size, dict[str, Sized], ["objects"])[0] or ()) == ["objects"]


def test_a_bare_list_of_regions_is_the_list_of_regions():
    rows = [{"name": name, "parent": "home", "share": "40%"} for name in ("a", "b", "c")]
    for text in (json.dumps(rows), json.dumps({"regions": rows}), json.dumps({"Regions": rows})):
        found, faults = parse(text, NamedList, ["regions"])
        assert not faults and found is not None
        assert [(row.name, row.share) for row in found.regions] == [("a", 40), ("b", 40), ("c", 40)]


@pytest.mark.parametrize("piece", ["{", "[", '{"', "{/*", "{//\n", '{"a":[', "}", '"', "{}", "[{}]", "\\"])
def test_hostile_text_costs_little(piece):
    started_s = time.monotonic()
    parse(piece * (400_000 // len(piece)), Matrix, *KEYS)
    assert time.monotonic() - started_s < 20
