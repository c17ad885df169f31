"""Messages that are well formed and absurd, made from an example of their type."""

import types
import typing
from typing import Any

import msgspec
import numpy as np
from hypothesis import strategies as st

from prior_sg.schemas.codec import DTYPES, Message, Shape, decode, encode
from tests.help.examples import EXAMPLES

TEXTS = [
    "",
    " ",
    "kitchen",
    "Kitchen",
    "a" * 3000,
    "x//y",
    "../x",
    "[/]",
    "{0}",
    "%s",
    "'; DROP TABLE robots;--",
    "\x00",
]
TEXTS += ["\x1b[2J", "居間", "cafe\u0301", "preferred", "*", "conse/x", "0" * 32]
NUMBERS = [0, 1, 2, 3, -1, 7, 2**31, 2**53, 2**63 - 1, 2**64 - 1, -(2**63)]
FLOATS: list[float] = [0.0, 1.0, -1.0, 0.5, 1e-38, 1e30, -1e30, 3e38, 1e300, float("inf"), float("nan")]
IDENTITY = np.eye(4)


def absurd(kind: type[Message]) -> st.SearchStrategy[Message | None]:
    """Messages of a type with some of their fields replaced; None for those that no service would get to see."""
    example = next(entry for entry in EXAMPLES if type(entry) is kind)
    return st.composite(_message)(example)


def _message(draw: Any, example: Message) -> Message | None:
    hints = typing.get_type_hints(type(example), include_extras=True)
    names = draw(st.lists(st.sampled_from(example.__struct_fields__), max_size=4, unique=True))
    lengths: dict[str, int] = {}
    arrays = draw(st.booleans())
    fields = {}
    for name in example.__struct_fields__:
        shape = next((meta for meta in getattr(hints[name], "__metadata__", ()) if isinstance(meta, Shape)), None)
        if shape is not None and (arrays or name in names):
            fields[name] = _array(draw, shape, lengths)
        elif name in names and name != "robot":
            fields[name] = draw(_value(hints[name]))
    if "robot" in hints:
        fields["robot"] = draw(st.sampled_from(["r", "r", "other"]))
    try:
        message = msgspec.structs.replace(example, **fields)
        return decode(type(message), encode(message))
    except (ValueError, TypeError, OverflowError):
        return None


def _array(draw: Any, shape: Shape, lengths: dict[str, int]) -> np.ndarray:
    size = [d if isinstance(d, int) else lengths.setdefault(d, draw(st.integers(0, 3))) for d in shape.dims]
    if size[-2:] == [4, 4]:
        return np.broadcast_to(IDENTITY, size).astype(shape.dtype)
    assert shape.dtype.name in DTYPES
    if shape.dtype.kind == "f":
        values = [value for value in FLOATS if abs(value) <= float(np.finfo(shape.dtype).max)]
    else:
        info = np.iinfo(shape.dtype)
        values = [value for value in NUMBERS if info.min <= value <= info.max]
    flat = draw(st.lists(st.sampled_from(values), min_size=int(np.prod(size)), max_size=int(np.prod(size))))
    return np.array(flat, shape.dtype).reshape(size)


def _value(hint: Any) -> st.SearchStrategy[Any]:
    """Values of a type: plain ones at random, structs and messages with fields of their own at random."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return st.one_of(*(_value(argument) for argument in arguments))
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin is list:
        return st.lists(_value(arguments[0]), max_size=3) | st.lists(_value(arguments[0]), max_size=1).map(
            lambda values: values * 70
        )
    if origin is tuple:
        return st.tuples(*map(_value, arguments))
    if origin is dict:
        return st.dictionaries(_value(arguments[0]), _value(arguments[1]), max_size=2)
    if hint is type(None):
        return st.none()
    if isinstance(hint, type) and issubclass(hint, Message):
        return absurd(hint).filter(lambda message: message is not None)
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        parts = {name: _value(part) for name, part in typing.get_type_hints(hint, include_extras=True).items()}
        return st.builds(lambda **fields: fields, **parts).map(lambda fields: _built(hint, fields))
    plain = {str: TEXTS, int: NUMBERS, float: FLOATS, bool: [False, True], bytes: [b"", b"x"]}
    return st.sampled_from(plain.get(hint, [None]))


def _built(kind: type, fields: dict[str, Any]) -> Any:
    """None, which the boundary refuses, where the struct itself refuses."""
    try:
        return kind(**fields)
    except ValueError:
        return None
