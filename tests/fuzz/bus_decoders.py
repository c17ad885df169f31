"""What comes over the bus: messages, older versions of them, headers, names and keys."""

from unittest.mock import patch

from prior_sg.schemas import names, topics
from prior_sg.schemas.codec import DecodeError, decode, encode, schema_name
from prior_sg.schemas.migrations import MIGRATIONS, received
from prior_sg.services.runtime.bus import key_matches, pack_header, unpack_header
from tests.fuzz.mutators import nested, of_messagepack
from tests.fuzz.trial import Decoder
from tests.help import reading
from tests.help.examples import EXAMPLES

BY_SCHEMA = {schema_name(type(example)): type(example) for example in EXAMPLES}
OLD = (reading.FIRST, reading.SECOND, reading.THIRD)
DEEP = (nested(b"\x91"), nested(b"\x81\xa1a"))


def _line(head: str, message) -> bytes:
    return head.encode() + b"\n" + encode(message)


def _messages() -> list[bytes]:
    return [_line(schema_name(type(example)), example) for example in EXAMPLES]


def _message(data: bytes) -> None:
    """A sample as the bus decodes it, by the schema in its encoding; what is taken can be sent on."""
    head, _, payload = data.partition(b"\n")
    schema = head.decode(errors="replace")
    kind = BY_SCHEMA.get(schema, type(EXAMPLES[len(payload) % len(EXAMPLES)]))
    message = decode(kind, received(kind, payload, schema))
    assert decode(kind, encode(message)) == message
    hash(message)


def _migrated(data: bytes) -> None:
    head, _, payload = data.partition(b"\n")
    with patch.dict(MIGRATIONS, reading.MIGRATIONS):
        decode(reading.Reading, received(reading.Reading, payload, head.decode(errors="replace")))


def _headers() -> list[bytes]:
    trace = f"00-{'1' * 32}-{'2' * 16}-01"
    return [
        pack_header("segmenter/s1/5", 7, 2**60),
        pack_header("place_graph/p", 0, -1, trace),
        pack_header("a", 2**64 - 1, 0),
    ]


def _header(data: bytes) -> None:
    writer, sequence, sent_ns, context = unpack_header(data)
    assert writer.isprintable() and -1 <= sequence < 2**64 and -(2**63) <= sent_ns < 2**63
    if not writer:
        raise ValueError("of an unknown writer")
    assert unpack_header(pack_header(writer, sequence, sent_ns, context)) == (writer, sequence, sent_ns, context)


def _names() -> list[bytes]:
    return [name.encode() for name in ("robot1", "Küche", "cafe\u0301", "居間", "a b  c")]


def _name(data: bytes) -> None:
    """What is let in is one part of a key and can be shown."""
    text = data.decode("utf-8", "surrogateescape")[:5000]
    faults = [names.fault_of_robot(text), names.fault_of_name("the name", text), names.fault_of_text("a task", text)]
    faults.append(names.fault_of_names("region", text.split("\n"), 64))
    assert names.normal(names.normal(text)) == names.normal(text) and names.same(names.same(text)) == names.same(text)
    names.shown(text).encode()
    if faults[0]:
        raise ValueError(faults[0])
    assert topics.PLACE_DELTA.pattern(names.key_part(text)).count("/") == 2


def _keys() -> list[bytes]:
    """A message with the key it came on, of every topic and question."""
    found = []
    for place in (*topics.TOPICS, *topics.QUERIES):
        kind = place.type if isinstance(place, topics.Topic) else place.request
        example = next(entry for entry in EXAMPLES if type(entry) is kind)
        found.append(_line(place.key_of(example), example))
    return found


def _key(data: bytes) -> None:
    head, _, payload = data.partition(b"\n")
    key = head.decode(errors="replace")
    called = topics.called_on(key)
    topics.called_with(key)
    known = [topic for topic in topics.TOPICS if key_matches(topic.pattern("*"), key)]
    place = called or (known[0] if known else topics.TOPICS[len(key) % len(topics.TOPICS)])
    message = decode(place.type if isinstance(place, topics.Topic) else place.request, payload)
    fault = place.fault_of(key, message)
    if isinstance(place, topics.Topic):
        place.budget_key(key)
        topics.fault_of_job(place, key, message)
    if fault:
        raise ValueError(fault)


DECODERS = (
    Decoder("messages", _messages, _message, (DecodeError,), (of_messagepack, of_messagepack, *DEEP), share=6),
    Decoder(
        "migrations",
        lambda: [_line(schema_name(type(old)), old) for old in OLD],
        _migrated,
        (DecodeError,),
        (of_messagepack, of_messagepack, *DEEP),
        share=6,
    ),
    Decoder("headers", _headers, _header, (ValueError,), share=24),
    Decoder("names", _names, _name, (ValueError,), share=3),
    Decoder("keys", _keys, _key, (DecodeError, ValueError), (of_messagepack, *DEEP), share=2),
)
