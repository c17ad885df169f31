"""The wire format, against the independent implementation `msgpack`."""

import copy
import math
import pickle
import struct
from typing import Annotated

import hypothesis
import hypothesis.extra.numpy as hnp
import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import strategies as st

from prior_sg.schemas import features, frames, levels, objects, places, priors, regions, scene, status
from prior_sg.schemas.codec import (
    ARRAY_EXT_CODE,
    DTYPES,
    DecodeError,
    Message,
    Shape,
    copied,
    decode,
    encode,
    schema_name,
)
from prior_sg.schemas.topics import ENCODE, KEYFRAME, QUERIES, TOPICS, topic_of
from tests.help import world

CAMERA = frames.Intrinsics(640, 480, 525.5, 526.5, 319.5, 239.5)
POSE = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2.5], [0, 0, 1, 3.5], [0, 0, 0, 1]])
FLOAT16 = np.float16
GOLDEN: list[Message] = [
    frames.Keyframe(
        robot="r",
        frame_id=7,
        stamp_ns=8,
        intrinsics=CAMERA,
        world_from_camera=POSE,
        color=b"c",
        depth=b"d",
        depth_scale_m=0.002,
        mask=b"m",
    ),
    places.PlaceDelta(
        robot="r",
        epoch=3,
        revision=4,
        stamp_ns=5,
        frame_id=6,
        snapshot=True,
        place_ids=np.array([1, 2]),
        positions_m=np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        radii_m=np.array([0.5, 0.75], np.float32),
        basis_points=np.array([2, 3], np.int16),
        removed_ids=np.array([9]),
        merged_ids=np.array([[8, 1]]),
        edges=np.array([[1, 2]]),
        clearances_m=np.array([0.4], np.float32),
        removed_edges=np.array([[2, 9]]),
        camera_m=(1.0, 2.0, 3.0),
        event="late",
        past_frame_ids=np.array([6]),
        past_cameras_m=np.array([[1, 2, 3]], np.float32),
        frontier_ids=np.array([2]),
        frontier_directions=np.array([[0, 0, 1]], np.float32),
        frontier_areas_m2=np.array([0.5], np.float32),
        surface_ids=np.array([1]),
        ellipses=np.array([[2, 1, 0.5]], np.float32),
        hull_counts=np.array([3]),
        hulls_m=np.array([[0, 0], [1, 0], [0, 1]], np.float32),
    ),
    features.Pyramid(
        robot="r",
        frame_id=1,
        stamp_ns=2,
        space="s",
        worker="w",
        intrinsics=CAMERA,
        world_from_camera=POSE,
        centers_px=np.array([[10, 20]], np.float32),
        sigmas_px=np.array([112], np.float32),
        layers=np.array([1], np.uint8),
        depths_m=np.array([2.5], np.float32),
        embeddings=np.array([[0.6, 0.8]], FLOAT16),
        surface_m=np.ones((2, 3), np.float32),
        crops_total=5,
    ),
    priors.Prior(
        environment="e",
        task="t",
        vocabulary=["kitchen"],
        regions=[
            priors.RegionPrior(name="kitchen", phrases=["a stove"], existence=1.0, query_radius_m=0.5, parent="zone")
        ],
        objects=[priors.ObjectPrior(name="stove", phrases=["a stove"])],
        containment=np.array([[0.9]], np.float32),
        adjacency=np.array([[1.0]], np.float32),
        provenance=priors.Provenance(
            source="m", note="n", question="q", samples=2, made_ns=3, signer="s", signature="00"
        ),
        spread=priors.Spread(
            existence=np.array([0.1], np.float32),
            containment=np.array([[0.2]], np.float32),
            adjacency=np.array([[0.3]], np.float32),
            support=np.array([1.0], np.float32),
        ),
        levels=[
            levels.LevelPrior(
                name="zone",
                entries=[levels.Entry(name="day zone", existence=1.0)],
                parents=np.array([[1.0]], np.float32),
                adjacency=np.array([[1.0]], np.float32),
            )
        ],
        tested=priors.Counts(regions=np.array([2.0], np.float32), looks=0.5),
    ),
    regions.RegionDelta(
        robot="r",
        epoch=1,
        revision=2,
        stamp_ns=3,
        prior_digest="d",
        environment="e",
        task="t",
        space="s",
        snapshot=True,
        labels=["kitchen"],
        regions=[
            regions.Region(
                id=4,
                label="kitchen",
                place_count=1,
                probability=0.5,
                position_m=(1.0, 2.0, 3.0),
                area_m2=4.0,
                unknown=0.5,
                predicted=True,
                hull_m=[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)],
                neighbour_ids=[5],
                transitions=[
                    regions.Transition(region=5, edge=(1, 2), position_m=(0.5, 0.0, 1.0), clearance_m=0.4, door=True)
                ],
                object_ids=[9],
                parent="day zone",
            )
        ],
        removed_ids=np.array([3]),
        place_ids=np.array([1]),
        place_regions=np.array([4]),
        posteriors=np.array([[1.0]], FLOAT16),
        unknown=np.array([0.25], FLOAT16),
        removed_place_ids=np.array([8]),
        energy=-1.5,
        predicted_ids=np.array([1]),
        events=[regions.RegionEvent(kind="split", region=4, label="kitchen", other=5, former_label="hall")],
    ),
    objects.Detections(
        robot="r",
        frame_id=1,
        stamp_ns=2,
        space="s",
        detector="segments",
        prompted=False,
        worker="w",
        intrinsics=CAMERA,
        world_from_camera=POSE,
        boxes_px=np.array([[10, 20, 50, 60]], np.float32),
        scores=np.array([0.5], np.float32),
        embeddings=np.array([[0.6, 0.8]], FLOAT16),
        point_counts=np.array([2], np.int32),
        points_camera_m=np.array([[0, 0, 1], [0.5, 0, 1]], FLOAT16),
        surface_m=np.ones((2, 3), FLOAT16),
    ),
    objects.ObjectDelta(
        robot="r",
        epoch=1,
        revision=2,
        stamp_ns=3,
        prior_digest="d",
        objects=[
            objects.SceneObject(
                id=4,
                label="stove",
                probability=0.5,
                known=0.75,
                position_m=(1.0, 2.0, 0.5),
                min_m=(0.5, 1.5, 0.0),
                max_m=(1.5, 2.5, 1.0),
                frames=3,
            )
        ],
        removed_ids=np.array([7]),
        merged_ids=np.array([[5, 4]]),
    ),
    status.Consumed(
        robot="r", service="s", instance="i", order=1, topic="T", frame_id=2, writer="w", sequence=3, inline=b"x"
    ),
    priors.PriorEvidence(
        robot="r",
        epoch=1,
        stamp_ns=2,
        prior_digest="d",
        environment="e",
        task="t",
        vocabulary=["kitchen"],
        regions=["kitchen"],
        objects=["stove"],
        places=np.array([3.0], np.float32),
        instances=np.array([1.0], np.float32),
        holding=np.array([[1.0]], np.float32),
        pairs=np.array([[2.0]], np.float32),
        touching=np.array([[1.0]], np.float32),
    ),
    priors.PriorClaim(question="q", holder="g", state="works"),
    priors.PriorRevision(environment="e", task="t", regions=["kitchen"], by_model=True),
    priors.ModelReply(
        conversation="c", turn=1, text="x", failure="f", reason="r", attempts=2, tokens_in=3, tokens_out=4
    ),
]


def unpack_independently(payload):
    """Decode with msgpack alone, arrays by the description in schemas/codec.py."""

    def array(code, data):
        assert code == ARRAY_EXT_CODE
        dtype, ndim = DTYPES[data[0]], data[1]
        shape = struct.unpack_from(f"<{ndim}I", data, 2)
        return np.frombuffer(data[2 + 4 * ndim :], np.dtype(dtype).newbyteorder("<")).reshape(shape)

    return msgpack.unpackb(payload, ext_hook=array)


@pytest.mark.parametrize("message", GOLDEN, ids=lambda m: type(m).__name__)
def test_wire_is_plain_msgpack(message):
    fields = unpack_independently(encode(message))
    assert list(fields) == list(message.__struct_fields__)
    for name, value in fields.items():
        expected = getattr(message, name)
        if isinstance(expected, np.ndarray):
            assert value.dtype == expected.dtype
            np.testing.assert_array_equal(value, expected)
        elif isinstance(expected, (str, int, float, bytes)):
            assert value == expected


@pytest.mark.parametrize("message", GOLDEN, ids=lambda m: type(m).__name__)
def test_round_trip_and_truncation(message):
    payload = encode(message)
    assert decode(type(message), payload) == message
    assert copied(message) == message
    for cut in range(0, len(payload), max(1, len(payload) // 50)):
        with pytest.raises(DecodeError):
            decode(type(message), payload[:cut])


def test_files_are_views_into_what_was_received_and_of_their_own_in_a_copy():
    sent = GOLDEN[0]
    payload = encode(sent)
    received = decode(frames.Keyframe, payload)
    assert received.color.obj is received.depth.obj is received.mask.obj is payload
    assert (received.color, received.depth, received.mask) == (sent.color, sent.depth, sent.mask)
    assert received == sent and hash(received) == hash(sent) and encode(received) == payload
    without_color = copied(msgspec.structs.replace(received, color=b""))
    assert without_color.depth == sent.depth and len(without_color.depth.obj) == len(payload) - len(sent.color)


@pytest.mark.parametrize("message", GOLDEN, ids=lambda m: type(m).__name__)
def test_what_was_received_can_be_pickled_and_copied(message):
    received = decode(type(message), encode(message))
    assert pickle.loads(pickle.dumps(received)) == copy.deepcopy(received) == message


def test_arrays_from_memory_that_can_be_written_to_are_read_only():
    received = decode(frames.Keyframe, bytearray(encode(GOLDEN[0])))
    with pytest.raises(ValueError, match="read-only"):
        received.world_from_camera[0, 0] = 2.0


@hypothesis.given(
    hnp.arrays(
        st.sampled_from([np.dtype(name) for name in DTYPES]),
        hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
    )
)
def test_any_array_travels(array):
    class Any(Message, kw_only=True):
        value: np.ndarray

    back = decode(Any, encode(Any(value=array))).value
    assert back.dtype == array.dtype and back.shape == array.shape
    assert back.tobytes() == np.ascontiguousarray(array).tobytes()


def test_arrays_point_into_the_payload_and_are_read_only():
    payload = encode(GOLDEN[1])
    positions = decode(places.PlaceDelta, payload).positions_m
    start = np.frombuffer(payload, np.uint8).ctypes.data
    assert start <= positions.ctypes.data < start + len(payload)
    with pytest.raises(ValueError):
        positions[0, 0] = 1


class Shaped(Message, kw_only=True):
    a: Annotated[np.ndarray, Shape("float32", "n", 3)]
    b: Annotated[np.ndarray, Shape("int64", "n")]


@pytest.mark.parametrize(
    "a, b, why",
    [
        (np.zeros((2, 3), np.float64), np.zeros(2, np.int64), "dtype"),
        (np.zeros((2, 4), np.float32), np.zeros(2, np.int64), "shape"),
        (np.zeros((2, 3), np.float32), np.zeros(3, np.int64), "shape"),
        (np.zeros(6, np.float32), np.zeros(2, np.int64), "dimensions"),
        (np.full((2, 3), np.nan, np.float32), np.zeros(2, np.int64), "finite"),
    ],
)
def test_wrong_arrays_are_refused(a, b, why):
    with pytest.raises(ValueError, match=why):
        Shaped(a=a, b=b)
    fields = {"a": msgpack.ExtType(1, _pack(a)), "b": msgpack.ExtType(1, _pack(b))}
    with pytest.raises(DecodeError, match=why):
        decode(Shaped, msgpack.packb(fields))


def _pack(array):
    return struct.pack(f"<BB{array.ndim}I", DTYPES.index(array.dtype.name), array.ndim, *array.shape) + array.tobytes()


@hypothesis.given(st.binary(max_size=300))
@hypothesis.settings(max_examples=300)
def test_random_bytes_never_do_worse_than_decode_error(data):
    for topic in TOPICS:
        with pytest.raises(DecodeError):
            decode(topic.type, data + b"\xc1")


@hypothesis.given(st.data())
@hypothesis.settings(max_examples=200)
def test_flipped_bytes_decode_or_raise_decode_error(data):
    message = data.draw(st.sampled_from(GOLDEN))
    payload = bytearray(encode(message))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        decode(type(message), bytes(payload))
    except DecodeError as error:
        assert str(error)


def test_a_huge_announced_array_is_refused_without_being_made():
    lying = struct.pack("<BB2I", 1, 2, 2**31, 2**31)
    with pytest.raises(DecodeError, match="length"):
        decode(Shaped, msgpack.packb({"a": msgpack.ExtType(1, lying), "b": msgpack.ExtType(1, lying)}))


@pytest.mark.parametrize(
    "pose, why",
    [
        (np.diag([1.0, 1, -1, 1]), "mirrors"),
        (np.diag([2.0, 1, 1, 1]), "orthonormal"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_impossible_poses_are_refused(pose, why):
    with pytest.raises(ValueError, match=why):
        frames.CameraState(robot="r", stamp_ns=0, world_from_camera=pose)


@pytest.mark.parametrize("counts", [[1], [3], [2, 0]])
def test_detections_whose_counts_do_not_fit_their_points_are_refused(counts):
    good = next(message for message in GOLDEN if isinstance(message, objects.Detections))
    many = len(counts)
    fields = {name: getattr(good, name) for name in good.__struct_fields__} | {
        "boxes_px": np.repeat(good.boxes_px, many, axis=0),
        "scores": np.repeat(good.scores, many),
        "embeddings": np.repeat(good.embeddings, many, axis=0),
        "point_counts": np.array(counts, np.int32),
    }
    with pytest.raises(ValueError, match="point_counts"):
        objects.Detections(**fields)


def test_prior_check_names_the_fault():
    good = GOLDEN[3]
    for change, why in [
        ({"adjacency": np.array([[0.0]], np.float32)}, "adjacency"),
        ({"containment": np.array([[1.5]], np.float32)}, "containment"),
        ({"regions": []}, "at least one region"),
        ({"regions": [good.regions[0]] * 2, "containment": np.ones((2, 1), np.float32)}, "same name"),
    ]:
        fields = {name: getattr(good, name) for name in good.__struct_fields__} | change
        if why == "same name":
            fields["adjacency"] = np.ones((2, 2), np.float32)
        if why == "at least one region":
            fields |= {"containment": np.ones((0, 1), np.float32), "adjacency": np.ones((0, 0), np.float32)}
        with pytest.raises(ValueError, match=why):
            priors.Prior(**fields)


@pytest.mark.parametrize(
    ("field", "value", "why"),
    [
        ("existence", float("nan"), "not finite"),
        ("inclination_mean_rad", 2.0, "right angle"),
        ("inclination_std_rad", 0.0, "above 0"),
        ("inclination_std_rad", 1e-200, "above 0"),
        ("query_radius_m", float("inf"), "not finite"),
        ("query_radius_m", 0.0, "query radius"),
        ("phrases", ["x" * 1000], "longer than"),
        ("phrases", ["a\x1b[31m"], "control characters"),
        ("phrases", [""], "no phrases"),
        ("parent", "a\u202eb", "control characters"),
        ("name", "x" * 100, "longer than"),
        ("name", " ", "is empty"),
        ("name", "a\nb", "control characters"),
        ("name", "\x1b[2J", "control characters"),
    ],
)
def test_a_prior_is_checked_alike_wherever_it_comes_from(field, value, why):
    """Encoded without a check, as a faulty or hostile sender would."""
    good = GOLDEN[3]
    region = msgspec.structs.replace(good.regions[0], **{field: value})
    raw = msgpack.unpackb(encode(good), ext_hook=msgpack.ExtType)
    raw["regions"] = [msgspec.to_builtins(region)]
    with pytest.raises(DecodeError, match=why):
        decode(priors.Prior, msgpack.packb(raw))


@pytest.mark.parametrize(
    ("robots", "why"),
    [
        (["ada", world.ROBOT], "merged of itself"),
        ([f"s{number}" for number in range(257)], "at most 256"),
        (["a/b"], "holds '/'"),
        ([""], "is empty"),
    ],
)
def test_a_map_is_merged_of_other_robots_and_of_no_more_than_take_a_task_at_once(robots, why):
    with pytest.raises(ValueError, match=why):
        world.no_places(merged_of=robots)
    assert world.no_places(merged_of=[f"s{number}" for number in range(256)])


@pytest.mark.parametrize("names", [("Kitchen", "kitchen"), ("hall", " hall"), ("café", "cafe\u0301")])
def test_names_of_a_prior_that_are_the_same_are_refused_as_a_tasks_are(names):
    rooms = world.prior(["a", "b"])
    renamed = [msgspec.structs.replace(one, name=name) for one, name in zip(rooms.regions, names, strict=True)]
    with pytest.raises(ValueError, match="same name"):
        msgspec.structs.replace(rooms, regions=renamed)
    one, other = (levels.Entry(name=name, existence=0.5) for name in names)
    with pytest.raises(ValueError, match="same name"):
        levels.LevelPrior(
            name="zone",
            entries=[one, other],
            parents=np.eye(2, dtype=np.float32),
            adjacency=np.ones((2, 2), np.float32),
        )


@pytest.mark.parametrize("changes", [{"task": "x" * 3000}, {"environment": "home\x00"}, {"vocabulary": ["a", "A"]}])
def test_a_prior_answers_only_what_may_be_asked(changes):
    with pytest.raises(ValueError, match=r"longer than|control characters|same name"):
        msgspec.structs.replace(GOLDEN[3], **changes)


def test_a_signature_or_a_field_added_later_changes_no_digest():
    good = GOLDEN[3]
    signed = msgspec.structs.replace(good.provenance, signer="other", signature="ff")
    assert msgspec.structs.replace(good, provenance=signed).digest() == good.digest()
    moved = msgspec.structs.replace(good.provenance, note="another")
    assert msgspec.structs.replace(good, provenance=moved).digest() != good.digest()
    bare = priors.Provenance(source="library")
    assert msgspec.msgpack.encode(bare) == msgspec.msgpack.encode({"source": "library"})


def test_one_key_per_topic_and_type_names_are_versioned():
    keys = [entry.key for entry in (*TOPICS, *QUERIES)]
    assert len(set(keys)) == len(keys)
    assert schema_name(scene.Scene) == "Scene/1"


def test_a_message_type_names_the_topic_it_is_published_on():
    published = [topic for topic in TOPICS if topic is not ENCODE]
    assert [topic_of(topic.type) for topic in published] == published  # each type on one topic, beside its jobs
    assert topic_of(ENCODE.type) is KEYFRAME
    assert topic_of(scene.SceneRequest) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_part_of_a_message_holds_a_number_that_is_none(value):
    fields = {
        "id": 1,
        "label": "hall",
        "place_count": 1,
        "probability": 1.0,
        "position_m": (0.0, 0.0, 0.0),
        "area_m2": 1.0,
    }
    regions.Region(**fields, hull_m=[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
    with pytest.raises(ValueError, match="hull_m: not finite"):
        regions.Region(**fields, hull_m=[(0.0, 0.0), (1.0, value), (0.0, 1.0)])
