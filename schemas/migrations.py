"""Messages of other versions: what is written under another schema name is brought to ours, or refused with the reason.

Within a version a message only gains fields with defaults. Whatever else changes raises `VERSION` of the message and of
every message that holds it, and adds a row to `MIGRATIONS`: how data of the version before becomes data of this one.
"""

from collections.abc import Callable
from typing import Any

from prior_sg.schemas.codec import DecodeError, M, Message, Refused, decode, decode_plain, encode_plain, schema_name
from prior_sg.schemas.names import LONGEST_NAME

NEWER, OLDER = "is newer than this program's", "is too old for this program's"
LONGEST_NUMBER = 6  # digits of a version; Python reads none of more than 4300
Migration = Callable[[dict[str, Any]], dict[str, Any]]

# (name of the message, version before): fields by name, arrays as arrays, to the fields of the next version.
MIGRATIONS: dict[tuple[str, int], Migration] = {}


class SchemaError(DecodeError):
    """The schema name is not one this program can read; the text says what to do."""


def current(message_type: type[Message], payload: bytes, schema: str) -> bytes:
    """The payload in this program's version of the message; `schema` is the name it was written under, such as
    `Keyframe/1`, and empty when the writer did not say. Raises SchemaError, DecodeError."""
    if schema in ("", schema_name(message_type)):
        return payload
    steps = _steps(message_type, schema)
    data = decode_plain(payload, schema)
    try:
        for step in steps:
            data = step(data)
        return encode_plain(data)
    except Exception as error:  # a payload is anybody's: what a migration makes of a wrong one must end no reader
        raise DecodeError(f"{schema} cannot be brought to {schema_name(message_type)}: {error!r}") from error


def journalled(message_type: type[M], payload: bytes, versions: dict[str, int]) -> M:
    """A message that a journal holds inline, of the version its `Started` tells. Raises SchemaError, DecodeError."""
    name = message_type.__name__
    return decode(message_type, current(message_type, payload, f"{name}/{versions.get(name, 1)}"))


def received(message_type: type[Message], payload: bytes, schema: str) -> bytes:
    """As `current`, for whoever cannot raise: what cannot be read becomes a payload that says why when decoded."""
    try:
        return current(message_type, payload, schema)
    except DecodeError as error:
        return Refused(str(error))


def tells_of_versions(sentence: str) -> bool:
    """Whether a sentence holds what is said here of a message of another version."""
    return any(words in sentence for words in (NEWER, OLDER))


def _steps(message_type: type[Message], schema: str) -> list[Migration]:
    """The migrations from `schema` up to our version."""
    ours, (name, _, number) = schema_name(message_type), schema.rpartition("/")
    is_number = number.isascii() and number.isdigit() and len(number) <= LONGEST_NUMBER
    if name != message_type.__name__ or not is_number:
        told = schema[:LONGEST_NAME]
        raise SchemaError(f"{told} stands where a {ours} belongs: its writer puts another message there")
    version = int(number)
    if version > message_type.VERSION:
        raise SchemaError(f"{schema} {NEWER} {ours}; update it")
    steps = [MIGRATIONS.get((name, step)) for step in range(version, message_type.VERSION)]
    found = [step for step in steps if step is not None]
    if version < 1 or len(found) < len(steps):
        raise SchemaError(f"{schema} {OLDER} {ours}; read it with the program that wrote it")
    return found
