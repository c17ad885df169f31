"""What another release of the same minor version would have written: without the fields that are as they are by
default, which it did not know yet, or with one that we do not know."""

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, decode

OLDER, NEWER = "older", "newer"


def spoken(kind: type[Message], payload: bytes, dialect: str) -> bytes:
    """A message in a dialect; in none, as it is."""
    if not dialect:
        return payload
    fields = msgspec.msgpack.decode(payload)
    if dialect == NEWER:
        return msgspec.msgpack.encode(fields | {"of_the_next_release": 1})
    message = decode(kind, payload)
    unknown = [field.name for field in msgspec.structs.fields(kind) if _is_default(field, getattr(message, field.name))]
    return msgspec.msgpack.encode({name: value for name, value in fields.items() if name not in unknown})


def _is_default(field: msgspec.structs.FieldInfo, value: object) -> bool:
    if field.default_factory is not msgspec.NODEFAULT:
        default = field.default_factory()
    elif field.default is not msgspec.NODEFAULT:
        default = field.default
    else:
        return False
    if isinstance(value, np.ndarray):
        return np.array_equal(value, default)
    return bool(value == default)
