"""Old messages become ours step by step; newer ones, foreign ones and wrong ones are refused with the reason."""

import pytest

from prior_sg.schemas import migrations
from prior_sg.schemas.codec import DecodeError, Refused, decode, encode, message_types, schema_name
from prior_sg.schemas.frames import CameraState, Keyframe
from prior_sg.schemas.migrations import MIGRATIONS, SchemaError, current, journalled, received
from tests.help import reading
from tests.help.reading import FIRST, SECOND, THIRD, Reading


@pytest.fixture(autouse=True)
def reading_migrations(monkeypatch):
    for step, function in reading.MIGRATIONS.items():
        monkeypatch.setitem(MIGRATIONS, step, function)


@pytest.mark.parametrize("old", [FIRST, SECOND, THIRD], ids=lambda old: f"version {old.VERSION}")
def test_every_version_is_read_as_ours(old):
    assert decode(Reading, current(Reading, encode(old), schema_name(type(old)))) == THIRD
    assert decode(Reading, received(Reading, encode(old), schema_name(type(old)))) == THIRD
    assert journalled(Reading, encode(old), {"Reading": old.VERSION, "Keyframe": 9}) == THIRD


def test_a_journal_that_tells_no_version_is_of_the_first():
    assert journalled(Reading, encode(FIRST), {}) == THIRD


def test_our_own_version_is_passed_on_without_a_copy():
    payload = encode(THIRD)
    assert current(Reading, payload, "Reading/3") is payload
    assert current(Reading, payload, "") is payload


@pytest.mark.parametrize(
    ("schema", "why"),
    [
        ("Reading/4", "Reading/4 is newer than this program's Reading/3; update it"),
        ("Keyframe/1", "Keyframe/1 stands where a Reading/3 belongs: its writer puts another message there"),
        ("Reading", "Reading stands where a Reading/3 belongs: its writer puts another message there"),
        ("Reading/²", "Reading/² stands where a Reading/3 belongs: its writer puts another message there"),
        ("Reading/0", "Reading/0 is too old for this program's Reading/3; read it with the program that wrote it"),
    ],
)
def test_what_is_not_ours_is_refused_in_one_true_sentence(schema, why):
    payload = encode(THIRD)  # it would decode
    with pytest.raises(SchemaError) as refused:
        current(Reading, payload, schema)
    assert str(refused.value) == why
    with pytest.raises(DecodeError) as refused:
        decode(Reading, received(Reading, payload, schema))
    assert str(refused.value) == why


def test_a_gap_in_the_migrations_is_named(monkeypatch):
    monkeypatch.delitem(MIGRATIONS, ("Reading", 2))
    assert decode(Reading, current(Reading, encode(THIRD), "Reading/3")) == THIRD
    with pytest.raises(SchemaError, match="Reading/1 is too old"):
        current(Reading, encode(FIRST), "Reading/1")


@pytest.mark.parametrize("payload", [b"", b"\xc1", encode(FIRST)[:-3], encode(SECOND), b"\x80", b"\x93\x01\x02\x03"])
def test_wrong_bytes_of_an_old_version_never_do_worse_than_a_decode_error(payload):
    with pytest.raises(DecodeError, match="Reading/1"):
        current(Reading, payload, "Reading/1")
    assert isinstance(received(Reading, payload, "Reading/1"), Refused)


def test_ours_are_all_of_the_first_version_and_every_migration_leads_to_one():
    ours = {kind.__name__: kind for kind in message_types() if kind.__module__.startswith("prior_sg.schemas.")}
    assert {name: kind.VERSION for name, kind in ours.items() if kind.VERSION != 1} == {}
    steps = set(migrations.MIGRATIONS) - set(reading.MIGRATIONS)
    assert steps == {(name, before) for name, kind in ours.items() for before in range(1, kind.VERSION)}


def test_a_message_without_a_version_of_its_own_keeps_the_first():
    assert (schema_name(Keyframe), schema_name(CameraState)) == ("Keyframe/1", "CameraState/1")
