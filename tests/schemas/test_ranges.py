"""Numbers and texts from the bus are what their fields mean, at the one door: decoding, for every type of message."""

import typing

import msgpack
import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from prior_sg.schemas.codec import LAST_NUMBER, DecodeError, Number, NumberOrNone, Stamp, decode, encode
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.topics import QUERIES, TOPICS
from tests.help.absurd import absurd
from tests.help.examples import EXAMPLES

PLAIN = {"place_id", "region", "limit"}  # ids may be any number; the limit is checked with its own sentence
RANGES = [
    (example, name, hint)
    for example in EXAMPLES
    for name, hint in typing.get_type_hints(type(example), include_extras=True).items()
    if name in example.__struct_fields__ and hint in (Number, NumberOrNone, Stamp)
]
ODD = [
    "",
    "*",
    "**",
    "x//y",
    "fleet",
    "jobs",
    "../x",
    "a/b",
    "a\nb",
    "\x00",
    "$*",
    "@x",
    "x" * 65,
    "\u202e",
    "?",
    "{0}",
]


def packed(example, name, value):
    fields = msgpack.unpackb(encode(example), ext_hook=msgpack.ExtType)
    return msgpack.packb(fields | {name: value})


@pytest.mark.parametrize(("example", "name", "hint"), RANGES, ids=lambda v: type(v).__name__ if v in EXAMPLES else None)
def test_a_number_outside_what_its_field_means_is_refused(example, name, hint):
    least = {Number: 0, NumberOrNone: -1, Stamp: -LAST_NUMBER}[hint]
    for value in (least - 1, LAST_NUMBER + 1, 2**63 - 1, -(2**63), 1.5, "1", True):
        with pytest.raises(DecodeError):
            decode(type(example), packed(example, name, value))


def test_every_whole_number_has_a_range():
    bare = {
        f"{type(example).__name__}.{name}"
        for example in EXAMPLES
        for name, hint in typing.get_type_hints(type(example), include_extras=True).items()
        if hint is int and name not in PLAIN
    }
    assert bare == set() and len(RANGES) > 40


@pytest.mark.parametrize("robot", ODD)
def test_no_message_of_a_robot_with_an_odd_name_is_let_in(robot):
    for example in EXAMPLES:
        if "robot" in example.__struct_fields__ and type(example).OF_A_ROBOT:
            with pytest.raises(DecodeError):
                decode(type(example), packed(example, "robot", robot))


def test_what_is_let_in_has_one_plain_key_or_none():
    seen = {"refused": 0, "keyed": 0}

    @settings(max_examples=200, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def look(data):
        place = data.draw(st.sampled_from([*TOPICS, *QUERIES]))
        message = data.draw(absurd(getattr(place, "type", None) or place.request))
        if message is None:
            return
        for name in set(message.__struct_fields__) & {"robot", "question", "space", "topic", "keeper"}:
            message = msgspec.structs.force_setattr(message, name, data.draw(st.sampled_from([*ODD, "r"]))) or message
        try:
            key = place.key_of(message)
        except ValueError:
            seen["refused"] += 1
            return
        seen["keyed"] += 1
        assert key.startswith("psg/") and "//" not in key and not set(key) & set("*$#?{}\n\x00") and len(key) < 5000

    look()
    assert min(seen.values()) >= 10


def test_a_camera_that_no_scene_can_hold_is_refused():
    example = next(entry for entry in EXAMPLES if type(entry) is PlaceDelta)
    with pytest.raises(DecodeError, match="camera_m: does not fit 32 bits"):
        decode(PlaceDelta, packed(example, "camera_m", [0.0, -1e300, 0.0]))
