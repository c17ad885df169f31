"""What a name may be, when two are the same, and that nothing else becomes part of a key."""

import unicodedata

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prior_sg.schemas import topics
from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.features import TextRequest
from prior_sg.schemas.names import fault_of_names, fault_of_robot, normal, same, shown
from prior_sg.schemas.priors import PriorClaim
from tests.help.examples import EXAMPLES

ROBOTS = ["x//y", "*", "", "a#b", "$*", "a?", "{digest}", "fleet", "a\x00b", "a" * 65]


@given(st.text(max_size=20))
def test_one_spelling_stays_the_same_in_every_form(text):
    assert normal(normal(text)) == normal(text)
    for form in ("NFC", "NFD"):
        assert same(unicodedata.normalize(form, f"  {text} ")) == same(text)


@given(st.lists(st.sampled_from(["kitchen", "Kitchen", "hall", "café", "cafe\u0301", "STRASSE", "straße"]), max_size=4))
def test_names_are_refused_exactly_when_one_comes_twice(names):
    twice = len({same(name) for name in names}) < len(names)
    assert bool(fault_of_names("region", names, 64)) == twice


@given(st.text(st.characters(), max_size=12))
def test_a_good_name_of_a_robot_is_one_part_of_a_key(name):
    if not fault_of_robot(name):
        key = topics.PLACE_DELTA.pattern(name)
        assert key.split("/") == ["psg", name, "places"] and not set(key) & set("*$#?{}") and shown(name) == name


@pytest.mark.parametrize("name", ROBOTS)
def test_messages_of_robots_that_cannot_be_are_malformed(name):
    """All that carry a robot, but for what a service of the fleet says of itself."""
    tried = 0
    for example in EXAMPLES:
        if "robot" in example.__struct_fields__ and example.OF_A_ROBOT:
            payload = msgspec.msgpack.decode(encode(example), ext_hook=msgspec.msgpack.Ext)
            with pytest.raises(DecodeError, match="robot's name"):
                decode(type(example), msgspec.msgpack.encode(payload | {"robot": name}))
            tried += 1
    assert tried > 15


def test_numbers_beyond_64_bits_and_endless_ones_are_malformed():
    for example in EXAMPLES:
        payload = msgspec.msgpack.decode(encode(example), ext_hook=msgspec.msgpack.Ext)
        for field in msgspec.structs.fields(type(example)):
            bad = {int: 2**64 - 1, float: float("nan")}.get(field.type)
            if bad is not None:
                with pytest.raises(DecodeError):
                    decode(type(example), msgspec.msgpack.encode(payload | {field.name: bad}))


def test_what_is_no_part_of_a_key_makes_none():
    for question in ("a/b", "**", "", "#"):
        with pytest.raises(ValueError, match="part of a key"):
            PriorClaim(question=question, holder="g", state="wants")
    assert topics.TEXT.key_of(TextRequest(space="open_clip/B/p", concepts=[])) == "psg/encoder/open_clip/B/p/text"
    for space in ("*", "a//b", "/a", "a#"):
        with pytest.raises(ValueError, match="part of a key"):
            topics.TEXT.key_of(TextRequest(space=space, concepts=[]))
