"""Configuration in layers: defaults in the code, then a TOML file, then the environment, then the command line."""

import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from prior_sg.schemas.codec import REAL, AtLeastOne, Positive, Signed
from prior_sg.services.errors import PriorSgError, reason_of

LONGEST_LINE = 10_000  # characters; the time to read a name of many parts grows with their square
ENVIRONMENT_PREFIX = "PSG_"
IN_WORDS: Mapping[Any, str] = {  # what a field of a type takes
    str: "a text",
    bool: "true or false",
    int: "a whole number that is not negative",
    float: "a finite number that is not negative",
    AtLeastOne: "a whole number from 1 on",
    Positive: "a finite number above 0",
    Signed: "a finite number",
    NoneType: "null",
}
C = TypeVar("C", bound=msgspec.Struct)


class ConfigError(PriorSgError):
    """A setting is wrong; the message names it and says what is allowed."""


def read_file(path: str | Path | None) -> dict[str, dict[str, Any]]:
    """Sections of a TOML file: `[segmenter]` then `beta = 2.0`. No path gives no settings."""
    if not path:
        return {}
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        if (longest := max(map(len, text.splitlines()), default=0)) > LONGEST_LINE:
            raise ConfigError(f"cannot read the configuration {path}: break its line of {longest} characters")
        return tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"cannot read the configuration {path}: {reason_of(error)}") from error


def from_environment(environment: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Settings such as PSG_SEGMENTER__BETA=2.0."""
    sections: dict[str, dict[str, str]] = {}
    for name, value in environment.items():
        if name.startswith(ENVIRONMENT_PREFIX) and "__" in name:
            section, field = name[len(ENVIRONMENT_PREFIX) :].lower().split("__", 1)
            sections.setdefault(section, {})[field] = value
    return sections


def from_arguments(arguments: Sequence[str]) -> dict[str, dict[str, str]]:
    """Settings such as `segmenter.beta=2.0`."""
    sections: dict[str, dict[str, str]] = {}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        section, dot, field = name.partition(".")
        if not (equals and dot and section and field):
            raise ConfigError(f"--set takes SERVICE.FIELD=VALUE, for example segmenter.beta=2.0; got {argument!r}")
        sections.setdefault(section, {})[field] = value
    return sections


def merge(*layers: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Later layers win, field by field."""
    merged: dict[str, dict[str, Any]] = {}
    for layer in layers:
        for section, fields in layer.items():
            if not isinstance(fields, Mapping):
                raise ConfigError(f"{section} stands outside any section; write [{section}] and its fields below")
            merged.setdefault(section, {}).update(fields)
    return merged


def check_sections(layers: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise ConfigError when a section names no service."""
    for section in layers:
        if section not in known:
            raise ConfigError(f"there is no service {section!r}; known: {', '.join(known)}")


def resolve(config_type: type[C], section: str, layers: Mapping[str, Mapping[str, Any]]) -> C:
    """The config of one service. Text values are read as the field's type; lists and groups as JSON.

    `tracking.cell_m` (in the environment `TRACKING__CELL_M`) names a field inside a group. A config with `PRESETS` has
    a setting `preset`, which names the defaults that all others change.
    """
    values = dict(layers.get(section, {}))
    values = getattr(config_type, "PRESETS", {}).get(values.get("preset"), {}) | values
    values = _checked(config_type, section, values)
    try:
        return msgspec.convert(values, config_type, strict=False)
    except (msgspec.ValidationError, ValueError) as error:
        raise ConfigError(f"{section}: {error}") from error


def recorded(config_type: type[C], section: str, data: bytes) -> tuple[C, list[str]]:
    """The config that a journal holds as JSON, perhaps of another version: settings it lacks get their defaults, and
    those this program does not have are left out. Also what became of each of them, one sentence each. Raises
    ConfigError when a value no longer fits."""
    try:
        values = msgspec.json.decode(data, type=dict[str, Any])
        notes = list(_kept(config_type, section, values))
        return msgspec.json.decode(msgspec.json.encode(values), type=config_type), notes
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise ConfigError(f"the recorded config of {section} does not fit this program: {error}") from error


def _kept(config_type: type, section: str, values: dict[str, Any]) -> Iterator[str]:
    """Leave only what the config has, in its groups too; yields a sentence for each setting that is gone or new."""
    fields = {field.name: field.type for field in msgspec.structs.fields(config_type)}
    for name in sorted(values.keys() - fields.keys()):
        yield f"{section}.{name} = {values.pop(name)!r} was recorded, and is no setting any more: it is left out"
    for name, kind in fields.items():
        if name not in values:
            yield f"{section}.{name} was not a setting yet: it gets its default"
        elif _is_group(kind) and isinstance(values[name], dict):
            yield from _kept(kind, f"{section}.{name}", values[name])


def _checked(config_type: type, section: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values by field, groups as mappings, every name known."""
    fields = {field.name: field.type for field in msgspec.structs.fields(config_type)}
    inner: dict[str, dict[str, Any]] = {}
    found: dict[str, Any] = {}
    for name, value in values.items():
        field, dot, rest = name.replace("__", ".").partition(".")
        if field not in fields or (dot and not _is_group(fields[field])):
            raise ConfigError(f"{section} has no setting {name!r}; it has: {', '.join(sorted(fields))}")
        if dot:
            inner.setdefault(field, {})[rest] = value
        else:
            found[field] = _decoded(f"{section}.{field}", value, fields[field])
            _check_fits(f"{section}.{field}", found[field], fields[field])
    for field, rest_values in inner.items():
        found[field] = {**found.get(field, {}), **rest_values}
    for field, value in found.items():
        if _is_group(fields[field]) and isinstance(value, Mapping):
            found[field] = _checked(fields[field], f"{section}.{field}", value)
    return found


def _check_fits(name: str, value: Any, kind: Any) -> None:
    """Raise ConfigError, which says what the field takes, unless the value is of its type and its numbers can be
    meant: all are finite, and none is negative unless its type is Signed. Groups are looked at field by field."""
    if _is_group(kind):
        if not isinstance(value, Mapping | kind):
            raise ConfigError(f"{name} is a group of settings; name one of them, as {name}.{kind.__struct_fields__[0]}")
        return
    try:
        fits = _can_be_meant(msgspec.convert(value, kind, strict=False), _holds_signed(kind))
    except msgspec.ValidationError:
        fits = False
    if not fits:
        given = repr(value)
        raise ConfigError(f"{name} takes {_said(kind)}; got {given if len(given) <= 80 else given[:77] + '...'}")


def _can_be_meant(value: Any, signed: bool) -> bool:
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return all(_can_be_meant(one, signed) for one in value)
    return not isinstance(value, REAL) or (math.isfinite(value) and (signed or value >= 0))


def _holds_signed(kind: Any) -> bool:
    return kind == Signed or any(map(_holds_signed, get_args(kind)))


def _said(kind: Any) -> str:
    """What a field of this type takes, in words."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(map(_said, parts))
    if origin is Literal:
        return f"one of {', '.join(map(repr, parts))}"
    if origin is dict:
        return f"names, each with {_said(parts[1])}"
    if origin in (list, tuple):
        count = f" of {len(parts)}" if origin is tuple and ... not in parts else ""
        return f"a list{count}, of which each is {_said(parts[0])}"
    return IN_WORDS[kind]


def _is_group(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _takes_text(kind: Any) -> bool:
    """Whether a field of this type can hold a text as it is."""
    if get_origin(kind) in (Union, UnionType):
        return any(map(_takes_text, get_args(kind)))
    return kind is str or get_origin(kind) is Literal


def _decoded(name: str, value: Any, kind: Any) -> Any:
    """A text as the type of its field reads it: as JSON where that is a list or a group, else as it is."""
    if isinstance(value, str) and ("\0" in value or any("\ud800" <= c <= "\udfff" for c in value)):
        raise ConfigError(f"{name}: {value!a} is not valid text: give it in UTF-8")
    if not (isinstance(value, str) and value.startswith(("[", "{"))) or _takes_text(kind):
        return value
    try:
        return msgspec.json.decode(value)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ConfigError(f"{name}: {value[:40]!r} is not valid JSON: {error}") from error
