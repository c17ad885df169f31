"""How rmw_zenoh names things, read and written; the texts are those of its design document and of its tokens."""

import json
import struct
import time
from dataclasses import replace

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh import ext as zx

from prior_sg.services.runtime.ros import wire
from prior_sg.services.runtime.ros.session import RosError, RosSession
from prior_sg.services.runtime.ros.types import Types
from prior_sg.services.runtime.ros.wire import Attachment, Channel, Entity, Quality, WireError
from prior_sg.services.runtime.zenoh_session import client_config

STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD_TWO_INTS = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
CHATTER = Channel("/chatter", "std_msgs/msg/String", STRING)
TOKENS = (
    "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener",
    f"@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING}/::,7:,:,:,,",
    f"@ros2_lv/2/aac3178e/0/10/MS/%/%robot1%left/listener/%robot1%chatter/std_msgs::msg::dds_::String_/{STRING}/2:1:,:,:,:,,",
    f"@ros2_lv/0/f9980ee0/0/10/SS/%/%/server/%add/example_interfaces::srv::dds_::AddTwoInts_/{ADD_TWO_INTS}/::,10:,:,:,,",
)


def test_data_keys_are_those_of_the_design_document():
    assert wire.data_key(0, CHATTER) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING}"
    service = Channel("add_two_ints", "example_interfaces/srv/AddTwoInts", ADD_TWO_INTS)
    assert wire.data_key(2, service) == f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD_TWO_INTS}"


@pytest.mark.parametrize("token", TOKENS)
def test_tokens_are_read_and_written(token):
    assert wire.read_token(token).token() == token


def test_what_a_token_says():
    entity = wire.read_token(TOKENS[2])
    assert (entity.kind, entity.domain, entity.full_node) == (wire.SUBSCRIPTION, 2, "/robot1/left/listener")
    assert entity.channel == Channel("/robot1/chatter", "std_msgs/msg/String", STRING, Quality(42, True, False))
    assert wire.read_token(TOKENS[1] + "/backends:cpu:x").channel == Channel(
        "/chatter", "std_msgs/msg/String", STRING, Quality(7)
    )


@given(st.sampled_from(TOKENS), st.data())
def test_damaged_tokens_are_refused_or_read(token, data):
    parts = token.split("/")
    place = data.draw(st.integers(0, len(parts) - 1))
    parts[place] = data.draw(st.sampled_from(["", "x" * 300, "-1", "*", "%%", "a::b", "::", "7:7", "\x00", "☃", "1e9"]))
    try:
        wire.read_token("/".join(parts)).token()
    except WireError as error:
        assert len(str(error)) < 300


@pytest.mark.parametrize("name", ["/a/**", "a b", "/a//b", "", "/", "/1a", "$*", "a#b", "a?b", "/a/*/b", "é"])
def test_names_that_would_mean_something_else_in_a_key_are_refused(name):
    with pytest.raises(WireError):
        wire.data_key(0, Channel(name, "std_msgs/msg/String", "*"))


def test_attachments_are_those_that_zenohs_own_serialiser_writes():
    gid = bytes(range(16))
    now = [zx.Int64(5), zx.Int64(1_700_000_000_123_456_789), gid]
    written = b"".join(zx.z_serialize(part).to_bytes() for part in now)
    attachment = Attachment(5, 1_700_000_000_123_456_789, gid)
    assert attachment.written() == written and len(written) == 33
    assert wire.read_attachment(written) == attachment
    names = ("sequence_number", "source_timestamp", "source_gid")
    former = b"".join(zx.z_serialize(x).to_bytes() for pair in zip(names, now, strict=True) for x in pair)
    assert len(former) == 77 and wire.read_attachment(former) == attachment


WRONG_LENGTH, WRONG_NAMES = struct.pack("<qqB16s", 1, 2, 15, bytes(16)), b"\x0fsequence_number" + bytes(61)


@pytest.mark.parametrize("data", [None, b"", b"x", bytes(32), bytes(33), bytes(34), WRONG_LENGTH, WRONG_NAMES])
def test_wrong_attachments_are_told_in_a_sentence(data):
    with pytest.raises(WireError, match="attachment"):
        wire.read_attachment(data)


def test_hashes_of_messages_and_services():
    types = Types()
    assert types.hash("std_msgs/msg/String") == STRING
    assert types.hash("sensor_msgs/msg/Image").startswith("RIHS01_d31d41a9")
    types.add_service("example_interfaces/srv/AddTwoInts", "int64 a\nint64 b\n", "int64 sum\n")
    assert types.hash("example_interfaces/srv/AddTwoInts") == ADD_TWO_INTS
    with pytest.raises(WireError, match="not known"):
        types.hash("a/msg/B")


def wait_for(condition, timeout_s=30.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.01)


def test_two_nodes_talk_find_each_other_and_remember_latched_messages(endpoint):
    types = Types()
    types.add_service("example_interfaces/srv/AddTwoInts", "int64 a\nint64 b\n", "int64 sum\n")
    latched = Channel("/map_name", "std_msgs/msg/String", STRING, Quality(1, latched=True))
    adding = Channel("/add", "example_interfaces/srv/AddTwoInts", ADD_TWO_INTS)
    heard, faults, seen = [], [], []

    def add(request):
        asked = types.decode(request, "example_interfaces/srv/AddTwoInts_Request")
        return types.encode(types.make("example_interfaces/srv/AddTwoInts_Response", asked.a + asked.b))

    def said(text):
        return types.encode(types.make("std_msgs/msg/String", text))

    with RosSession(endpoint, "talker", domain=7) as talker, RosSession(endpoint, "listener", domain=7) as listener:
        talker.publisher(latched).publish(said("first"))
        talker.publisher(latched).publish(said("house"))
        talker.serve(adding, add, lambda *fault: faults.append(fault))
        chatting = talker.publisher(CHATTER)
        listener.watch(lambda entity, alive: seen.append((entity.full_node, entity.kind, alive)))
        for channel in (latched, CHATTER):
            listener.subscribe(channel, heard.append, lambda *fault: faults.append(fault))
        wait_for(lambda: {types.decode(m.payload, CHATTER.type).data for m in heard} == {"first", "house"})
        wait_for(lambda: chatting.publish(said("hello")) or "/chatter" in {message.topic for message in heard})
        assert heard[-1].attachment.sequence >= 1 and abs(heard[-1].attachment.sent_ns - heard[-1].received_ns) < 10e9
        client = listener.client(adding)
        request = types.encode(types.make("example_interfaces/srv/AddTwoInts_Request", 40, 2))
        reply = types.decode(client.call(request), "example_interfaces/srv/AddTwoInts_Response")
        assert reply.sum == 42
        with pytest.raises(RosError, match="/add gives no answer: its 2 bytes are no"):
            client.call(b"xy")
        wait_for(lambda: sorted(one.kind for one in listener.entities()) == ["MP", "MP", "MP", "NN", "SS"])
        assert ("/talker", wire.SERVER, True) in seen
        assert [service for service, _ in faults] == ["/add"]


PEER = {  # what of rmw_zenoh's own settings of a session matters on the way through a router
    "mode": "peer",
    "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
    "timestamping": {"enabled": True},
}


def test_a_peer_with_the_settings_of_rmw_zenoh_is_heard_and_hears(endpoint):
    settings = zenoh.Config.from_json5(json.dumps(PEER | {"connect": {"endpoints": [endpoint]}}))
    types, heard, answered = Types(), [], []
    good = Attachment(1, 2, bytes(16)).written()
    with zenoh.open(settings) as peer, RosSession(endpoint, domain=9) as node:
        latching = zx.declare_advanced_publisher(
            peer,
            wire.data_key(9, CHATTER),
            cache=zx.CacheConfig(1),
            publisher_detection=True,
            sample_miss_detection=zx.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
        )
        latching.put(types.encode(types.make("std_msgs/msg/String", "before")), attachment=good)
        node.subscribe(replace(CHATTER, quality=Quality(1, latched=True)), heard.append, print)
        wait_for(lambda: heard)
        assert types.decode(heard[0].payload, CHATTER.type).data == "before"
        hearing = peer.declare_subscriber("9/back/**", answered.append)
        publisher = node.publisher(Channel("/back", "std_msgs/msg/String", STRING))
        wait_for(lambda: publisher.publish(heard[0].payload) or answered)
        assert len(answered[0].attachment.to_bytes()) == 33
        hearing.undeclare()
        latching.undeclare()


def test_strangers_messages_are_told_and_passed_over(endpoint):
    heard, faults = [], []
    types = Types()
    payload = types.encode(types.make("std_msgs/msg/String", "hi"))

    with RosSession(endpoint, domain=8) as node, zenoh.open(client_config(endpoint)) as stranger:
        node.subscribe(CHATTER, heard.append, lambda *fault: faults.append(fault))
        key = "8/chatter/std_msgs::msg::dds_::String_/"
        good = Attachment(1, 2, bytes(16)).written()
        wait_for(lambda: stranger.put(key + STRING, payload, attachment=good) or heard)  # until it has been found
        heard.clear()
        stranger.put(key + STRING, payload)
        stranger.put(key + STRING, payload, attachment=b"what")
        stranger.put(key + "RIHS01_" + "0" * 64, payload, attachment=good)
        stranger.put(key + wire.UNHASHED, payload, attachment=good)
        wait_for(lambda: len(faults) == 3 and heard)
    assert [name for name, _ in faults] == ["/chatter"] * 3
    assert [word for (_, said), word in zip(faults, ("no attachment", "4 bytes", "hash"), strict=True) if word in said]


def test_a_token_of_a_depth_without_end_is_refused():
    token = f"@ros2_lv/0/a/0/1/MP/%/%/n/%t/std_msgs::msg::dds_::String_/{STRING}/::,{{}}:,:,:,,"
    assert wire.read_token(token.format(7)).channel.quality.depth == 7
    with pytest.raises(WireError, match="no quality of service"):
        wire.read_token(token.format("9" * 5000))  # Python itself refuses to read so long a number


def test_an_entity_of_no_kind_has_no_token():
    with pytest.raises(WireError, match="none of the kinds"):
        Entity("XX", 0, "a", 0, 0, "node").token()
