"""Message base, array transport without copies, encode and decode.

A message is MessagePack of a frozen msgspec struct. Arrays travel inside it as extension type 1: one byte dtype code,
one byte number of dimensions, the dimensions as little-endian uint32, then the raw little-endian buffer. Decoding maps
the array onto the received buffer: no copy, and read-only. So are files, of fields that are declared as `File`.

A field declares its array with `Annotated[np.ndarray, Shape("float32", "place", 3)]`; a word names a dimension, and
equal names within one message must have equal length. Decoding checks all of it, so that a malformed message fails at
the boundary and nowhere else.
"""

import math
import struct
import threading
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from prior_sg.schemas.names import fault_of_robot

ARRAY_EXT_CODE = 1
DTYPES = (
    "float16",
    "float32",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
    "bool",
)
LITTLE = tuple(np.dtype(name).newbyteorder("<") for name in DTYPES)  # as they travel
CODES = {dtype: code for code, dtype in enumerate(LITTLE)}
REAL = float | int
FEW = 32  # numbers
MAX_DIMENSIONS = 8
LAST_NUMBER = 2**62  # so that the next one, and sums of two, fit 64 bits
Number = Annotated[int, msgspec.Meta(ge=0, le=LAST_NUMBER)]  # of a frame, an epoch or a revision; how many
NumberOrNone = Annotated[int, msgspec.Meta(ge=-1, le=LAST_NUMBER)]  # the same; -1 = none yet
Stamp = Annotated[int, msgspec.Meta(ge=-LAST_NUMBER, le=LAST_NUMBER)]  # nanoseconds of some clock
Positive = Annotated[float, msgspec.Meta(gt=0)]
AtLeastOne = Annotated[int, msgspec.Meta(ge=1)]
Signed = Annotated[float, msgspec.Meta(extra={"signed": True})]  # a setting that may be negative, as no other may

if TYPE_CHECKING:
    File = bytes | memoryview
else:
    File = memoryview  # what msgspec decodes without a copy; whoever makes a message gives either


class DecodeError(ValueError):
    """The payload is not a valid message of the expected type."""


class Refused(bytes):
    """In place of a payload that must not be decoded: empty, and `reason` says why in one sentence."""

    reason: str

    def __new__(cls, reason: str) -> "Refused":
        refused = super().__new__(cls)
        refused.reason = reason
        return refused


class Shape:
    """What an array field must look like: dtype, dimensions (names or lengths), and whether it must be finite."""

    __slots__ = ("dims", "dtype", "finite")

    def __init__(self, dtype: str, *dims: str | int, finite: bool = True) -> None:
        self.dtype, self.dims, self.finite = np.dtype(dtype), dims, finite and np.dtype(dtype).kind == "f"

    def check(self, field: str, array: Any, lengths: dict[str, int]) -> None:
        """Raise ValueError unless `array` fits; `lengths` collects the named dimensions of the whole message."""
        if not isinstance(array, np.ndarray):
            raise ValueError(f"{field}: expected an array")
        if array.dtype != self.dtype:
            raise ValueError(f"{field}: dtype {array.dtype.name}, expected {self.dtype.name}")
        if array.ndim != len(self.dims):
            raise ValueError(f"{field}: {array.ndim} dimensions, expected {len(self.dims)}")
        for length, dim in zip(array.shape, self.dims, strict=True):
            expected = dim if isinstance(dim, int) else lengths.setdefault(dim, length)
            if length != expected:
                raise ValueError(f"{field}: shape {array.shape}, expected {dim} = {expected}")
        if self.finite and not _all_finite(array):
            raise ValueError(f"{field}: not finite")


def _all_finite(array: np.ndarray) -> bool:
    """Plain numbers where there are few, as in a pose: NumPy would take twice as long."""
    if array.size <= FEW:
        return all(map(math.isfinite, array.ravel().tolist()))
    return bool(np.isfinite(array).all())


class Message(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Base of everything that crosses the bus. New fields get defaults; what else changes is a new `VERSION`, see
    schemas/migrations.py."""

    VERSION: ClassVar[int] = 1
    OF_A_ROBOT: ClassVar[bool] = True  # its field `robot`, if it has one, never means the fleet

    def __post_init__(self) -> None:
        _check_plain(self)
        if self.OF_A_ROBOT and (fault := fault_of_robot(getattr(self, "robot", "robot"))):
            raise ValueError(fault)
        lengths: dict[str, int] = {}
        for field, shape in _array_fields(type(self)):
            shape.check(field, getattr(self, field), lengths)
        self.check()

    def check(self) -> None:
        """Raise ValueError when the fields contradict each other; overridden where a type alone does not say enough."""

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and encode(self) == encode(other)

    def __hash__(self) -> int:
        return hash(encode(self))

    def __reduce__(self) -> tuple[Any, ...]:  # views cannot be pickled
        return decode, (type(self), encode(self))


M = TypeVar("M", bound=Message)


def _check_plain(value: msgspec.Struct) -> None:
    """Whole numbers fit 64 bits, as arrays and databases hold them; all others are finite."""
    whole, real = _numbers(type(value))
    for field in whole:
        number = getattr(value, field)
        if isinstance(number, int) and not -(2**63) <= number < 2**63:
            raise ValueError(f"{field}: does not fit 64 bits")
    for field in real:
        if not _is_finite(getattr(value, field)):
            raise ValueError(f"{field}: not finite")


def _is_finite(value: Any) -> bool:
    """Whether a number, or every one in lists, tuples and dictionaries of them, is finite."""
    if isinstance(value, REAL):
        return math.isfinite(value)
    if isinstance(value, list | tuple):
        return all(map(_is_finite, value))
    return not isinstance(value, dict) or all(map(_is_finite, value.values()))


def _holds_reals(hint: Any) -> bool:
    return hint is float or any(map(_holds_reals, get_args(hint)))


@cache
def _numbers(kind: type[msgspec.Struct]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the fields that hold a whole number, and of those that hold real ones."""
    hints = get_type_hints(kind)
    whole = tuple(name for name, hint in hints.items() if hint is int or int in get_args(hint))
    return whole, tuple(name for name, hint in hints.items() if _holds_reals(hint))


class Part(msgspec.Struct, frozen=True, kw_only=True):
    """Base of what messages are made of."""

    def __post_init__(self) -> None:
        _check_plain(self)


@cache
def _array_fields(message_type: type[Message]) -> tuple[tuple[str, Shape], ...]:
    hints = get_type_hints(message_type, include_extras=True)
    return tuple(
        (name, meta)
        for name, hint in hints.items()
        if get_origin(hint) is Annotated
        for meta in get_args(hint)[1:]
        if isinstance(meta, Shape)
    )


def schema_name(message_type: type[Message]) -> str:
    """Name and version that travel in the sample's encoding, for example `PlaceDelta/1`."""
    return f"{message_type.__name__}/{message_type.VERSION}"


def message_types(base: type[Message] = Message) -> Iterator[type[Message]]:
    """Every message type that is defined so far."""
    for kind in base.__subclasses__():
        yield kind
        yield from message_types(kind)


def versions() -> dict[str, int]:
    """Version by name of the message types that are beyond the first."""
    return {kind.__name__: kind.VERSION for kind in message_types() if kind.VERSION > 1}


@cache
def _head(dimensions: int) -> struct.Struct:
    """What stands before an array's numbers."""
    return struct.Struct(f"<BB{dimensions}I")


def _pack_array(array: np.ndarray) -> msgspec.msgpack.Ext:
    code = CODES.get(array.dtype)
    if code is None:
        if array.dtype.name not in DTYPES:
            raise TypeError(f"arrays of dtype {array.dtype} do not travel; use one of {', '.join(DTYPES)}")
        return _pack_array(array.astype(array.dtype.newbyteorder("<")))
    little = np.ascontiguousarray(array)
    head = _head(array.ndim).pack(code, array.ndim, *array.shape)
    return msgspec.msgpack.Ext(ARRAY_EXT_CODE, b"".join((head, little.data.cast("B") if little.size else b"")))


def _unpack_array(data: memoryview) -> np.ndarray:
    if len(data) < 2:
        raise ValueError("array header cut off")
    code, ndim = data[0], data[1]
    start = 2 + 4 * ndim
    if code >= len(DTYPES) or ndim > MAX_DIMENSIONS or len(data) < start:
        raise ValueError("array header damaged")
    _, _, *shape = _head(ndim).unpack_from(data)
    dtype = LITTLE[code]
    if len(data) - start != math.prod(shape) * dtype.itemsize:
        raise ValueError("array length does not fit its shape")
    return np.ndarray(shape, dtype, data if data.readonly else data.toreadonly(), start)


def _enc_hook(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _pack_array(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _ext_hook(code: int, data: memoryview) -> Any:
    if code != ARRAY_EXT_CODE:
        raise ValueError(f"unknown extension type {code}")
    return _unpack_array(data)


_encoder = msgspec.msgpack.Encoder(enc_hook=_enc_hook)


_decoders: dict[Any, msgspec.msgpack.Decoder[Any]] = {}
_building = threading.Lock()  # msgspec's descriptions of types, which decoders share, are not safe to build at once


def _decoder(message_type: Any) -> msgspec.msgpack.Decoder[Any]:
    found = _decoders.get(message_type)
    if found is None:
        with _building:
            found = _decoders.get(message_type)
            if found is None:
                found = msgspec.msgpack.Decoder(message_type, ext_hook=_ext_hook)
                _decoders[message_type] = found
    return found


def prepare() -> None:
    """Build now what decoding needs of every message type defined so far, those inside others included."""
    for kind in message_types():
        _array_fields(kind)
        _numbers(kind)
        _decoder(kind)
    for part in Part.__subclasses__():
        _numbers(part)


def encode(message: Message) -> bytes:
    """MessagePack of one message."""
    return _encoder.encode(message)


def decode(message_type: type[M], payload: bytes | memoryview) -> M:
    """The message in `payload`, validated; its arrays and files point into `payload`. Raises DecodeError."""
    if isinstance(payload, Refused):
        raise DecodeError(payload.reason)
    try:
        message: M = _decoder(message_type).decode(payload)
    except (msgspec.MsgspecError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DecodeError(f"{schema_name(message_type)}: {error}") from error
    return message


def decode_plain(payload: bytes | memoryview, schema: str) -> dict[str, Any]:
    """The fields in `payload` by name, whatever they are; its arrays point into it. Raises DecodeError, which names
    `schema`."""
    try:
        fields: dict[str, Any] = _decoder(dict[str, Any]).decode(payload)
    except (msgspec.MsgspecError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DecodeError(f"{schema}: {error}") from error
    return fields


def encode_plain(fields: dict[str, Any]) -> bytes:
    """MessagePack of fields by name, arrays as in a message."""
    return _encoder.encode(fields)


def copied(message: M) -> M:
    """The same message with arrays and files of its own, for state that must not keep a whole received buffer alive."""
    return decode(type(message), encode(message))
