"""How rmw_zenoh names topics, types and who is there, and what it attaches to a message (pure).

data key      <domain>/<topic without its first slash>/<package>::msg::dds_::<Type>_/<hash of the type>
token         @ros2_lv/<domain>/<session>/<node's number>/<entity's number>/<kind>/<enclave>/<namespace>/<node>
              and, of all but a node, /<topic>/<type>/<hash>/<quality of service>; in names % stands for a slash
attachment    sequence, int64; stamp of sending, int64, ns; a length, 16; who sent it, 16 bytes; little-endian.
              Builds of 2024 put a name, with its length, before each of the three.
"""

import re
import struct
from dataclasses import dataclass, replace

ADMIN = "@ros2_lv"
NODE, PUBLISHER, SUBSCRIPTION, SERVER, CLIENT = "NN", "MP", "MS", "SS", "SC"
KINDS = (NODE, PUBLISHER, SUBSCRIPTION, SERVER, CLIENT)
UNHASHED = "TypeHashNotSupported"  # what ROS 2 Humble writes in place of a hash
HASH = re.compile(r"RIHS01_[0-9a-f]{64}")
NAME = re.compile(r"/?[A-Za-z_~][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")
DDS_TYPE = re.compile(r"(\w+)::(msg|srv|action)::dds_::(\w+)_")
LARGEST_DOMAIN = 232  # by which DDS numbers its ports; rmw_zenoh takes the same variable
GID_BYTES = 16
GID = struct.Struct(f"<qqB{GID_BYTES}s")
NAMED = tuple(bytes((len(name), *name)) for name in (b"sequence_number", b"source_timestamp", b"source_gid"))
NODE_PARTS, ENTITY_PARTS = 9, 13  # of a token, at least
DEFAULT_DEPTH = 42  # of rmw_zenoh: what a token leaves out
RELIABLE, BEST_EFFORT = "1", "2"
TRANSIENT_LOCAL = "1"


class WireError(ValueError):
    """What is on the wire, or what is to go there, cannot be; the text is one sentence's end."""


@dataclass(frozen=True)
class Quality:
    """What of a topic's quality of service matters here; all else is rmw_zenoh's default."""

    depth: int = 10
    latched: bool = False  # transient local: whoever comes late gets the last ones
    reliable: bool = True

    def written(self) -> str:
        """As tokens carry it: what equals rmw_zenoh's defaults is left out."""
        reliability = "" if self.reliable else BEST_EFFORT
        durability = TRANSIENT_LOCAL if self.latched else ""
        depth = "" if self.depth == DEFAULT_DEPTH else self.depth
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


@dataclass(frozen=True)
class Channel:
    """A topic or service as one who takes part declares it."""

    name: str
    type: str  # such as sensor_msgs/msg/Image
    hash: str
    quality: Quality = Quality()


@dataclass(frozen=True)
class Entity:
    """A node, publisher, subscription, server or client of a service."""

    kind: str
    domain: int
    session: str
    node_number: int
    number: int  # within its session; of a node the node's
    node: str
    namespace: str = "/"
    enclave: str = "/"
    channel: Channel | None = None  # its name with the first slash; none of a node

    def token(self) -> str:
        """The key of its liveliness token. Raises WireError."""
        if self.kind not in KINDS:
            raise WireError(f"{self.kind!r} is none of the kinds {', '.join(KINDS)}")
        numbers = (self.domain, self.session, self.node_number, self.number)
        names = (_mangled(self.enclave), _mangled(self.namespace), check_name(self.node))
        parts = [ADMIN, *numbers, self.kind, *names]
        if self.channel is not None:
            name, quality = _mangled(check_name(self.channel.name)), self.channel.quality.written()
            parts += [name, dds_type(self.channel.type), self.channel.hash, quality]
        return "/".join(map(str, parts))

    @property
    def full_node(self) -> str:
        """The node's name with its namespace."""
        return f"{self.namespace.rstrip('/')}/{self.node}"


def check_name(name: str) -> str:
    """The name of a topic, service or node, unchanged. Raises WireError."""
    if not NAME.fullmatch(name):
        raise WireError(f"{name[:60]!r} is no name of ROS: letters, digits and _ between slashes")
    return name


def check_domain(domain: int) -> int:
    """A ROS_DOMAIN_ID, unchanged. Raises WireError."""
    if not 0 <= domain <= LARGEST_DOMAIN:
        raise WireError(f"the domain {domain} is not from 0 to {LARGEST_DOMAIN}")
    return domain


def dds_type(name: str) -> str:
    """sensor_msgs::msg::dds_::Image_ of sensor_msgs/msg/Image. Raises WireError."""
    if not TYPE.fullmatch(name):
        raise WireError(f"{name[:60]!r} is no type of ROS such as sensor_msgs/msg/Image")
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(dds: str) -> str:
    """sensor_msgs/msg/Image of sensor_msgs::msg::dds_::Image_. Raises WireError."""
    match = DDS_TYPE.fullmatch(dds)
    if match is None:
        raise WireError(f"{dds[:80]!r} is no type of ROS such as sensor_msgs::msg::dds_::Image_")
    return "/".join(match.groups())


def data_key(domain: int, channel: Channel) -> str:
    """The key of a topic's messages or of a service's calls; the hash `*` takes every one. Raises WireError."""
    return f"{check_domain(domain)}/{check_name(channel.name).strip('/')}/{dds_type(channel.type)}/{channel.hash}"


def hash_in(key: str) -> str:
    """The hash that a data key ends with."""
    return key.rpartition("/")[2]


def check_hash(key: str, expected: str) -> None:
    """That a message's type is defined as ours is, or that its publisher cannot say. Raises WireError."""
    found = hash_in(key)
    if found not in (expected, UNHASHED):
        raise WireError(f"its type is defined in another way: its hash is {found[:20]}…, not {expected[:20]}…")


def token_pattern(domain: int) -> str:
    """All tokens of a domain: `**` alone would not match the chunk that begins with @."""
    return f"{ADMIN}/{check_domain(domain)}/**"


def read_token(key: str) -> Entity:
    """Who a token speaks of. Raises WireError."""
    parts = key.split("/")
    if len(parts) < NODE_PARTS or parts[0] != ADMIN or parts[5] not in KINDS or "" in parts:
        raise WireError(f"{key[:120]!r} is no token of rmw_zenoh")
    try:
        domain, node_number, number = (int(parts[position]) for position in (1, 3, 4))
    except ValueError as error:
        raise WireError(f"{key[:120]!r} is no token of rmw_zenoh: its numbers are none") from error
    enclave, namespace, node = (part.replace("%", "/") for part in parts[6:9])
    entity = Entity(parts[5], domain, parts[2], node_number, number, node, namespace, enclave)
    if entity.kind == NODE:
        return entity
    if len(parts) < ENTITY_PARTS:
        raise WireError(f"{key[:120]!r} names no topic")
    name = check_name(parts[9].replace("%", "/"))
    return replace(entity, channel=Channel(name, ros_type(parts[10]), parts[11], _quality(parts[12])))


@dataclass(frozen=True)
class Attachment:
    """What comes with every message, request and reply."""

    sequence: int
    sent_ns: int
    gid: bytes  # 16 bytes: who sent it; of a reply, who asked

    def written(self) -> bytes:
        """In today's form: a C++ peer dies of any other. Raises WireError."""
        if len(self.gid) != GID_BYTES:
            raise WireError(f"a gid has {GID_BYTES} bytes, not {len(self.gid)}")
        return GID.pack(self.sequence, self.sent_ns, GID_BYTES, self.gid)


def read_attachment(data: bytes | None) -> Attachment:
    """Of both forms. Raises WireError."""
    if data is None:
        raise WireError("it has no attachment, so its sender does not speak rmw_zenoh")
    held = data
    if data.startswith(NAMED[0]):
        sequence, stamp, gid = NAMED
        second, third = len(sequence) + 8, len(sequence) + 8 + len(stamp) + 8
        if not (data[second:].startswith(stamp) and data[third:].startswith(gid)):
            raise WireError("its attachment names other fields than rmw_zenoh's")
        held = data[len(sequence) : second] + data[second + len(stamp) : third] + data[third + len(gid) :]
    if len(held) != GID.size:
        raise WireError(f"its attachment has {len(data)} bytes, which no rmw_zenoh writes")
    sequence_number, sent_ns, length, sender = GID.unpack(held)
    if length != GID_BYTES:
        raise WireError(f"its attachment tells of a sender of {length} bytes instead of {GID_BYTES}")
    return Attachment(sequence_number, sent_ns, sender)


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def _quality(written: str) -> Quality:
    """Of a token. Raises WireError."""
    parts = written.split(":")
    history = parts[2].split(",") if len(parts) > 2 else []
    if len(history) < 2 or not re.fullmatch(r"[0-9]{0,9}", history[1]):
        raise WireError(f"{written[:40]!r} is no quality of service")
    depth = int(history[1]) if history[1] else DEFAULT_DEPTH
    return Quality(depth, parts[1] == TRANSIENT_LOCAL, parts[0] != BEST_EFFORT)
