"""Messages and services of ROS 2 as bytes and as objects, and the hashes of their definitions, by rosbags."""

from functools import cache
from typing import Any

from prior_sg.services.runtime import extras
from prior_sg.services.runtime.ros.wire import WireError

SERVICE_EVENT = "service_msgs/msg/ServiceEventInfo"
SERVICE_EVENT_TEXT = "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number\n"
LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # what a message of CDR begins with


class Types:
    """The definitions of ROS 2 Jazzy, and services that were added."""

    def __init__(self) -> None:
        """Raises ExtraMissing where rosbags is not installed."""
        extras.require("ros", "a topic of ROS")
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)
        del self.store.fielddefs[SERVICE_EVENT]  # there with a char, which ROS 2 hashes as the uint8 it stands for
        self.add_message(SERVICE_EVENT, SERVICE_EVENT_TEXT)

    def add_message(self, name: str, text: str) -> None:
        """Define a message as a .msg file does."""
        from rosbags.typesys import get_types_from_msg

        self.store.register(get_types_from_msg(text, name))

    def add_service(self, name: str, request: str, reply: str) -> None:
        """Define a service as a .srv file does, by the halves before and after ---."""
        from rosbags.typesys import get_types_from_msg

        as_message = name.replace("/srv/", "/msg/")  # rosbags knows no others, and looks beside it for short names
        parts = {f"{as_message}{end}": f"{name}{end}" for end in ("_Request", "_Response", "_Event", "")}
        asked, answered, told, _ = parts
        texts = (
            request,
            reply,
            f"{SERVICE_EVENT} info\n{asked}[<=1] request\n{answered}[<=1] response\n",
            f"{asked} request_message\n{answered} response_message\n{told} event_message\n",
        )
        for part, text in zip(parts, texts, strict=True):
            self.store.register(_renamed(get_types_from_msg(text, part), parts))

    def knows(self, name: str) -> bool:
        """Whether a type is defined here."""
        return name in self.store.fielddefs

    def hash(self, name: str) -> str:
        """RIHS01_… of a message or service. Raises WireError."""
        if not self.knows(name):
            raise WireError(f"the type {name[:60]!r} is not known here")
        return str(self.store.hash_rihs01(name))

    def make(self, name: str, *values: Any) -> Any:
        """A message of its fields' values, in order."""
        return self.store.types[name](*values)

    def encode(self, message: Any) -> bytes:
        """A message as CDR with its header of four bytes."""
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))

    def decode(self, data: bytes, name: str) -> Any:
        """A message of CDR. Raises WireError."""
        try:
            return self.store.deserialize_cdr(data, name)
        except Exception as error:  # rosbags says nothing of what it raises for damaged data
            said = " ".join(str(error).split())[:120].rstrip(".") or type(error).__name__
            raise WireError(f"its {len(data)} bytes are no {name}: {said}") from error


def _renamed(parsed: Any, names: dict[str, str]) -> Any:
    """Definitions as rosbags parses them, with other names of types."""
    if isinstance(parsed, dict):
        return {_renamed(name, names): _renamed(fields, names) for name, fields in parsed.items()}
    if isinstance(parsed, list | tuple):
        return type(parsed)(_renamed(part, names) for part in parsed)
    return names.get(parsed, parsed) if isinstance(parsed, str) else parsed


@cache
def shared_types() -> Types:
    """The definitions without anything added. Raises ExtraMissing."""
    return Types()
