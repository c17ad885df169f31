"""The bytes of every message type, as files that no later program may read or write otherwise: one per version.

`PYTHONPATH=src python -m tests.schemas.test_golden` writes those that are missing; a file that is there stays.
"""

import struct
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import ARRAY_EXT_CODE, DTYPES, Message, decode, encode, message_types
from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.migrations import current
from prior_sg.schemas.queries import Spot
from tests.help.examples import EXAMPLES, unset_fields

GOLDEN = Path(__file__).parent / "golden"
MESSAGE_TYPES = [kind for kind in message_types() if kind.__module__.startswith("prior_sg.schemas.")]


def file_of(kind: type[Message], version: int = 0) -> Path:
    return GOLDEN / f"{kind.__name__}-{version or kind.VERSION}.msgpack"


def by_name(message):
    return type(message).__name__


def test_every_message_type_has_one_example_and_every_file_a_type():
    assert sorted(map(by_name, EXAMPLES)) == sorted(kind.__name__ for kind in MESSAGE_TYPES)
    wanted = [file_of(kind, version) for kind in MESSAGE_TYPES for version in range(1, kind.VERSION + 1)]
    assert sorted(GOLDEN.iterdir()) == sorted(wanted), "see the head of this file"


@pytest.mark.parametrize("kind", MESSAGE_TYPES, ids=lambda kind: kind.__name__)
def test_every_version_ever_written_can_be_read(kind):
    for version in range(1, kind.VERSION + 1):
        golden = file_of(kind, version).read_bytes()
        assert isinstance(decode(kind, current(kind, golden, f"{kind.__name__}/{version}")), kind)


@pytest.mark.parametrize("name", ["IngestState", "ServiceStatus"])
def test_what_was_written_before_losses_were_counted_has_none(name):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["losses"]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, losses=[])


@pytest.mark.parametrize("name", ["Keyframe", "PlaceDelta", "Scene"])
def test_what_was_written_before_worlds_had_an_offset_has_none(name):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["origin_m"]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, origin_m=(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("name", "defaults"),
    [("Scene", {"revision": -1}), ("SceneRequest", {"revision": None, "stamp_ns": None})],
)
def test_what_was_written_before_the_store_kept_history_means_the_present(name, defaults):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    for field in defaults:
        del fields[field]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, **defaults)


def test_what_was_foreseen_before_it_was_told_what_openings_lead_to_tells_none():
    foresight = next(example for example in EXAMPLES if by_name(example) == "Scene").foresight
    fields = msgspec.to_builtins(foresight)
    assert fields["openings"][0]["labels"][0].pop("toward") > 0
    assert msgspec.convert(fields, Foresight).openings[0].labels[0].toward == 0


@pytest.mark.parametrize(("name", "default"), [("RegionDelta", None), ("Scene", Foresight())])
def test_what_was_written_before_anything_was_foreseen_foresees_nothing(name, default):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["foresight"]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, foresight=default)


def test_what_was_written_before_robots_had_several_cameras_is_of_the_only_one():
    message = next(example for example in EXAMPLES if by_name(example) == "Keyframe")
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["camera"]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, camera="")


def test_what_was_written_before_a_long_step_was_told_has_none():
    message = next(example for example in EXAMPLES if by_name(example) == "ServiceStatus")
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["step_s"], fields["step_compiling_s"]
    before = msgspec.structs.replace(message, step_s=0.0, step_compiling_s=0.0)
    assert decode(type(message), msgpack.packb(fields)) == before


def test_what_was_written_before_processes_told_their_clock_and_release_tells_none():
    message = next(example for example in EXAMPLES if by_name(example) == "ServiceStatus")
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["clock_ns"], fields["release"]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, clock_ns=0, release="")


def test_what_was_wished_before_wishes_were_numbered_has_no_number():
    message = next(example for example in EXAMPLES if by_name(example) == "Backfill")
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["epoch"], fields["number"]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, epoch=0, number=0)


def test_what_was_written_before_messages_were_limited_counts_none():
    message = next(example for example in EXAMPLES if by_name(example) == "ServiceStatus")
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["topics"][0]["limited"]
    assert decode(type(message), msgpack.packb(fields)).topics[0].limited == 0


@pytest.mark.parametrize("name", ["Prior", "RegionDelta", "Scene"])
def test_what_was_written_before_there_were_levels_has_none(name):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    added = {"levels", "nodes", "removed_nodes"} & fields.keys()
    for field in added:
        del fields[field]
    assert added
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, **{f: [] for f in added})


def test_what_was_counted_before_looks_were_weighed_leaves_them_at_their_face_value():
    message = next(example for example in EXAMPLES if by_name(example) == "Counts")
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["looks"]
    bare = msgspec.structs.replace(message, looks=None)
    assert decode(type(message), msgpack.packb(fields)) == bare
    assert b"looks" not in encode(bare), "digests stay"


@pytest.mark.parametrize(("name", "lists"), [("RegionDelta", ["regions"]), ("Scene", ["regions", "objects"])])
def test_what_was_written_before_merged_maps_named_their_members_names_none(name, lists):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    for held in lists:
        del fields[held][0]["members"]
    bare = {held: [msgspec.structs.replace(getattr(message, held)[0], members=[])] for held in lists}
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, **bare)


@pytest.mark.parametrize("name", ["Detections", "ObjectDelta", "Scene"])
def test_what_was_written_before_markers_were_looked_for_has_none(name):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    added = {field for field in fields if "marker" in field}
    assert added
    found = decode(type(message), msgpack.packb({field: fields[field] for field in fields if field not in added}))
    bare = {"markers": []} if name != "Detections" else {field: getattr(found, field) for field in added}
    assert found == msgspec.structs.replace(message, **bare)
    assert not any(len(getattr(found, field)) for field in added if field != "marker_size_m")


@pytest.mark.parametrize("name", ["PlaceDelta", "Scene"])
def test_what_was_written_before_merged_maps_named_their_robots_is_a_robots_own(name):
    message = next(example for example in EXAMPLES if by_name(example) == name)
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    del fields["merged_of"]
    assert decode(type(message), msgpack.packb(fields)) == msgspec.structs.replace(message, merged_of=[])


def test_what_was_asked_before_routes_could_begin_here_begins_elsewhere():
    asked = msgpack.packb({"point_m": [1.0, 2.0, 3.0], "what": None, "id": None, "label": ""})
    assert msgspec.msgpack.decode(asked, type=Spot) == Spot(point_m=(1.0, 2.0, 3.0))


def test_the_digest_of_a_prior_stays():
    prior = next(example for example in EXAMPLES if by_name(example) == "Prior")
    made = msgspec.structs.replace(prior.provenance, root_digest="", contributors=[])
    before = msgspec.structs.replace(prior, tested=None, provenance=made, levels=[])
    assert before.digest() == "eab9114663fcaab470acb71942c653fc"


def test_what_was_written_before_maps_told_of_single_regions_tells_of_none():
    message = next(example for example in EXAMPLES if by_name(example) == "PriorEvidence")
    fields = msgpack.unpackb(encode(message), ext_hook=msgpack.ExtType)
    for field in ("sizes", "looks", "contents", "links"):
        del fields[field]
    read = decode(type(message), msgpack.packb(fields))
    assert (len(read.sizes), read.looks.shape, read.contents.shape, read.links.shape) == (0, (0, 0), (0, 0), (0, 2))


@pytest.mark.parametrize("message", EXAMPLES, ids=by_name)
def test_an_example_leaves_no_field_at_its_default(message):
    assert list(unset_fields(message)) == []


@pytest.mark.parametrize("message", EXAMPLES, ids=by_name)
def test_the_bytes_are_read_and_written_as_ever(message):
    golden = file_of(type(message)).read_bytes()
    assert encode(message) == golden
    assert decode(type(message), golden) == message
    assert encode(decode(type(message), golden)) == golden


@pytest.mark.parametrize("message", EXAMPLES, ids=by_name)
def test_the_bytes_say_the_same_to_an_independent_reader(message):
    unpacked = msgpack.unpackb(file_of(type(message)).read_bytes(), ext_hook=array)
    assert list(unpacked) == list(message.__struct_fields__)
    same(unpacked, message)


def array(code, data):
    """An array by the description in schemas/codec.py."""
    assert code == ARRAY_EXT_CODE
    dtype, ndim = DTYPES[data[0]], data[1]
    shape = struct.unpack_from(f"<{ndim}I", data, 2)
    return np.frombuffer(data[2 + 4 * ndim :], np.dtype(dtype).newbyteorder("<")).reshape(shape)


def same(unpacked, value):
    if isinstance(value, msgspec.Struct):
        config = value.__struct_config__
        assert config.tag is None or unpacked.pop(config.tag_field) == config.tag
        assert list(unpacked) == list(value.__struct_fields__)
        for name, inner in unpacked.items():
            same(inner, getattr(value, name))
    elif isinstance(value, dict):
        assert list(unpacked) == list(value)
        for name, inner in unpacked.items():
            same(inner, value[name])
    elif isinstance(value, np.ndarray):
        assert unpacked.dtype == value.dtype
        np.testing.assert_array_equal(unpacked, value)
    elif isinstance(value, list | tuple):
        assert len(unpacked) == len(value)
        for one, other in zip(unpacked, value, strict=True):
            same(one, other)
    else:
        assert type(unpacked) is type(value) and unpacked == value


def test_a_field_left_at_its_default_is_found():
    deltas = next(example for example in EXAMPLES if by_name(example) == "RegionDelta")
    bare = msgspec.structs.replace(deltas.regions[0], parent="", transitions=[])
    assert list(unset_fields(msgspec.structs.replace(deltas, regions=[bare], snapshot=False))) == [
        ".snapshot",
        ".regions[].transitions",
        ".regions[].parent",
    ]


def write_missing():
    GOLDEN.mkdir(exist_ok=True)
    for message in EXAMPLES:
        if not file_of(type(message)).exists():
            file_of(type(message)).write_bytes(encode(message))


if __name__ == "__main__":
    write_missing()
