"""Reads a model's answer as tolerantly as is unambiguous (pure).

Around the JSON may stand thoughts, prose with braces of its own, or a code fence; the JSON may hold comments, trailing
commas and numbers in quotes; it may stand twice, in a list, or below one heading. Two different answers are none.
"""

import json
import re
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar, get_args, get_origin

import msgspec

from prior_sg.schemas.names import same

MOST_PIECES, MOST_MISSES = 64, 16  # brackets in one answer that hold JSON, and that turn out to hold none
DEEPEST = 32  # brackets in brackets
CUT_OFF = "the JSON object is cut off; answer more briefly"
_NUMBER = re.compile(
    r"\s*([+-]?\d{1,12}(?:\.\d{1,12})?)\s*(?:%|percent|cm|°|deg|degrees)?\s*", re.ASCII | re.IGNORECASE
)
_OPENING = re.compile(r"[{\[]")
_BEGUN = re.compile(r'\{\s*"')
_TOKEN = re.compile(r'"|//|/\*|[{}\[\]]')
_STRING = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
_CLOSING = {"{": "}", "[": "]"}

A = TypeVar("A")


class Ambiguous(ValueError):
    """An answer says two things about one; the message is a sentence for the model."""


def parse(text: str, kind: type[A], *wanted: Sequence[str]) -> tuple[A | None, list[str]]:
    """The JSON object in an answer, decoded and typed, or the one fault that prevents it; text in its place is no
    answer. `wanted` are the keys asked for, depth by depth: those that differ in case, spacing or Unicode form only are
    renamed to them."""
    said = text[text.rfind("</think>") + len("</think>") :] if "</think>" in text else text
    if "{" not in said:
        told = " ".join(said.split())[:120]
        return None, [f"there is no JSON object in it, but: {told!r}" if told else "it is empty"]
    try:
        found, why = _typed(said, kind, wanted)
    except Ambiguous as error:
        return None, [str(error)]
    asked = set(wanted[0]) if wanted else set()
    found = [pair for pair in found if asked & pair[0].keys()] or found
    if len(found) > 1:
        return None, [f"there are {len(found)} different JSON objects in it; give one"]
    return (found[0][1], []) if found else (None, [why])


def _typed(text: str, kind: type[A], wanted: Sequence[Sequence[str]]) -> tuple[list[tuple[dict, A]], str]:
    """The different objects that have the form asked for, each raw and typed, or why there is none. An empty one is an
    answer only where there is no other."""
    found: list[tuple[dict, A]] = []
    why = ""
    for raw, fault in _pieces(text):
        why = why or fault
        for reading in _readings(raw):
            try:
                value = _renamed(reading, wanted)
                typed = msgspec.convert(_with_numbers(value, kind), kind)
            except msgspec.ValidationError as error:
                why = f"it does not have the form asked for: {error}"
                continue
            if all(value != other for other, _ in found):
                found.append((value, typed))
            break
    return [pair for pair in found if pair[0]] or found, why or "it is not valid JSON"


def _pieces(text: str) -> Iterator[tuple[Any, str]]:
    """Every outermost piece of JSON that holds an object; for what only looks like one, None and its fault."""
    at, pieces, misses = 0, 0, 0
    while (opening := _OPENING.search(text, at)) is not None and misses < MOST_MISSES and pieces < MOST_PIECES:
        at, is_object = opening.end(), opening[0] == "{"
        piece = _piece(text, opening.start())
        if piece is None:
            misses += 1
            if is_object:
                yield None, CUT_OFF
            if _BEGUN.match(text, opening.start()):
                return
            continue
        try:
            value = _decoded(piece[1])
        except Ambiguous:
            raise
        except (ValueError, RecursionError) as error:
            misses += 1
            if is_object:
                at = piece[0]
                yield None, f"it is not valid JSON: {error}"
            continue
        at, pieces = piece[0], pieces + 1
        if isinstance(value, dict) or any(isinstance(entry, dict) for entry in value):
            yield value, ""


def _piece(text: str, start: int) -> tuple[int, str] | None:
    """Where the bracket at `start` is closed, and the text up to there without comments and without commas before a
    closing bracket; None when it is not closed, or holds more brackets in each other than any answer."""
    parts: list[str] = []
    closing: list[str] = []
    at = kept = start
    while (token := _TOKEN.search(text, at)) is not None:
        mark, at = token[0], token.end()
        if mark == '"':
            if (string := _STRING.match(text, token.start())) is None:
                return None
            at = string.end()
        elif mark in ("//", "/*"):
            parts.append(text[kept : token.start()])
            end = text.find("\n" if mark == "//" else "*/", at)
            if end < 0:
                return None
            at = kept = end + (2 if mark == "/*" else 0)
        elif mark in _CLOSING:
            closing.append(_CLOSING[mark])
            if len(closing) > DEEPEST:
                return None
        else:
            if mark != closing.pop():
                return None
            parts.append(text[kept : token.start()])
            _drop_comma(parts)
            parts.append(mark)
            kept = at
            if not closing:
                return at, "".join(parts)
    return None


def _drop_comma(parts: list[str]) -> None:
    while parts and not parts[-1].strip():
        parts.pop()
    if parts:
        parts[-1] = parts[-1].rstrip().removesuffix(",")


def _decoded(piece: str) -> Any:
    """JSON as Python has it. Raises ValueError, Ambiguous, RecursionError."""
    value = json.loads(piece, object_pairs_hook=_once, parse_constant=_no_number)
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError("it holds half a character (a lone surrogate)") from error
    return value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if found.setdefault(name, value) != value:
            raise Ambiguous(f"{name!r} is given twice, differently")
    return found


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


def _readings(value: Any) -> Iterator[dict]:
    """What a piece can mean: itself, what stands below its only heading, or the entries of a list together."""
    if value is None:
        return
    if isinstance(value, dict):
        yield value
        inner = next(iter(value.values())) if len(value) == 1 else None
        if isinstance(inner, dict):
            yield inner
        return
    entries = [entry for entry in value if isinstance(entry, dict)]
    if len(entries) != len(value):
        return
    if len(entries) == 1:
        yield from _readings(entries[0])
    names = [name for entry in entries for name in entry]
    if len(set(names)) == len(names):
        yield {name: inner for entry in entries for name, inner in entry.items()}
    yield {"regions": entries}


def _renamed(value: Any, wanted: Sequence[Sequence[str]]) -> Any:
    """Keys as they were asked for. Raises Ambiguous when two keys mean the same and say different things."""
    if not (wanted and isinstance(value, dict)):
        return value
    names = {same(name): name for name in wanted[0]} | {name: name for name in wanted[0]}
    given: dict[str, str] = {}
    renamed: dict[str, Any] = {}
    for key, inner in value.items():
        name: str = names.get(key) or names.get(same(key)) or key
        within = _renamed(inner, wanted[1:])
        if renamed.setdefault(name, within) != within:
            raise Ambiguous(f"{given[name]!r} and {key!r} both name {name!r} and differ; give one")
        given[name] = key
    return renamed


def _with_numbers(value: Any, kind: Any) -> Any:
    """Where the form wants a number, a number in quotes becomes one."""
    if kind is float and isinstance(value, str):
        found = _NUMBER.fullmatch(value)
        return float(found[1]) if found else value
    if get_origin(kind) is dict and isinstance(value, dict):
        return {key: _with_numbers(inner, get_args(kind)[1]) for key, inner in value.items()}
    if get_origin(kind) is list and isinstance(value, list):
        return [_with_numbers(inner, get_args(kind)[0]) for inner in value]
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and isinstance(value, dict):
        forms = {field.name: field.type for field in msgspec.structs.fields(kind)}
        return {key: _with_numbers(inner, forms.get(key)) for key, inner in value.items()}
    return value
