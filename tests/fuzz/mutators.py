"""Ways to damage an input: bytes of any kind, and trees of MessagePack and JSON, which stay well formed."""

import json
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import msgspec

Mutator = Callable[[Random, bytes, Sequence[bytes]], bytes]
LONGEST = 1 << 16  # bytes of an input
NUMBERS = (
    0,
    1,
    -1,
    7,
    127,
    128,
    255,
    256,
    32767,
    65535,
    2**31 - 1,
    -(2**31),
    2**32 - 1,
    2**53,
    2**62,
    2**63 - 1,
    2**64 - 1,
)
TEXTS = (
    "", " ", "a", "*", "**", "x//y", "../x", "fleet", "a#b", "$*", "{robot}", "\x00", "\x1b[2J", "\u202e", "\ufeff",
    "é", "e\u0301", "居間", "ß", "\U000e0041", "NaN", "1e999", "-0", "kitchen", "Kitchen", "x" * 90, "x" * 3000,
    "0" * 32, "9" * 5000, "%", "</think>",
)  # fmt: skip
REALS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e30, -1e300, float("inf"), float("nan"))
DEPTHS = (3, 3, 40, 40, 600, 5000)


def flipped(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16)) if changed else 0):
        at = rng.randrange(len(changed))
        changed[at] = rng.randrange(256) if rng.random() < 0.5 else changed[at] ^ (1 << rng.randrange(8))
    return bytes(changed)


def spliced(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    begin = rng.randrange(len(other) + 1)
    at, end = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
    return data[:at] + other[begin : begin + rng.randrange(200)] + data[rng.choice((at, end)) :]


def cut(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def lacking(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.randrange(1, 64) :]


def repeated(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    piece = data[at : at + rng.randrange(1, 64)]
    return data[:at] + piece * rng.choice((2, 3, 100)) + data[at + len(piece) :]


def with_a_number(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """A length, a count or a size becomes another one."""
    size, order = rng.choice((1, 2, 4, 8)), rng.choice(("little", "big"))
    at = rng.randrange(len(data) + 1)
    number = rng.choice(NUMBERS) % 2 ** (8 * size)
    return data[:at] + number.to_bytes(size, order) + data[at + size :]


def with_a_text(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1)
    text = rng.choice(TEXTS).encode("utf-8", "surrogatepass")
    return data[:at] + text + data[at + rng.choice((0, 1, len(text))) :]


BYTES: tuple[Mutator, ...] = (flipped, spliced, cut, lacking, repeated, with_a_number, with_a_text)


def mutated(rng: Random, data: bytes, others: Sequence[bytes], own: Sequence[Mutator] = ()) -> bytes:
    """One to three changes; half of the inputs of a decoder with a structure keep it."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        way = rng.choice(own) if own and rng.random() < 0.5 else rng.choice(BYTES)
        data = way(rng, data, others)[:LONGEST]
    return data


def grown(rng: Random, value: Any) -> Any:
    """A tree with one of its nodes replaced, doubled, left out, or packed in many layers."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        name = rng.choice(list(value))
        changed = dict(value)
        match rng.randrange(8):
            case 0:
                del changed[name]
            case 1:
                changed[rng.choice(TEXTS)] = value[name]
            case _:
                changed[name] = grown(rng, value[name])
        return changed
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        match rng.randrange(6):
            case 0:
                return value[:at] + value[at + 1 :]
            case 1:
                return value[:at] + [value[at]] * rng.choice((2, 70)) + value[at:]
            case _:
                return [*value[:at], grown(rng, value[at]), *value[at + 1 :]]
    return _other(rng, value)


def _other(rng: Random, value: Any) -> Any:
    match rng.randrange(9):
        case 0 | 1:
            return rng.choice(NUMBERS)
        case 2:
            return rng.choice(REALS)
        case 3 | 4:
            return rng.choice(TEXTS)
        case 5:
            return rng.choice((None, True, False, [], {}, [[]], b"", b"x"))
        case 6:
            for _ in range(rng.choice((1, 2, 50))):
                value = rng.choice(([value], {"a": value}))
            return value
        case 7 if isinstance(value, int | float) and not isinstance(value, bool):
            return -value
        case 8 if isinstance(value, msgspec.msgpack.Ext):
            return msgspec.msgpack.Ext(rng.choice((value.code, 1, 2)), mutated(rng, value.data, [value.data]))
        case _:
            return [value, value]


def nested(open_bytes: bytes, close_bytes: bytes = b"") -> Mutator:
    """Puts very many layers into each other somewhere."""

    def mutate(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
        at, deep = rng.randrange(len(data) + 1), rng.choice(DEPTHS)
        return data[:at] + open_bytes * deep + data[at:] + close_bytes * rng.choice((0, deep))

    return mutate


def of_messagepack(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """The tree behind a first line that says what it is."""
    head, line, body = data.partition(b"\n")
    try:
        return head + line + msgspec.msgpack.encode(grown(rng, msgspec.msgpack.decode(body)))
    except (msgspec.MsgspecError, ValueError, TypeError, OverflowError, RecursionError):
        return flipped(rng, data, others)


def of_json(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """The outermost object in a text."""
    text = data.decode(errors="replace")
    begin, end = text.find("{"), text.rfind("}") + 1
    try:
        tree = json.dumps(grown(rng, json.loads(text[begin:end])), default=str)
    except (ValueError, TypeError, RecursionError):
        return flipped(rng, data, others)
    if rng.random() < 0.1:
        tree = tree.replace(", ", ", ".join(("", *tree.split(", ")[:2], "")), 1)  # keys given twice
    return (text[:begin] + tree + text[end:]).encode(errors="surrogatepass")
