"""Names and texts that come from outside: what one may be, and when two are the same (pure).

A robot's name becomes part of keys, a region's of tables, pictures and prompts. Nothing else in the system decides what
is a name.
"""

import re
import unicodedata
from collections.abc import Iterable
from functools import lru_cache

LONGEST_ROBOT = 64  # characters
LONGEST_NAME = 80  # of a region or an object
LONGEST_TEXT = 2000  # of a task or an environment
RESERVED = ("alive", "encoder", "fleet", "jobs", "status")  # stand in keys where the name of a robot stands
DIRECTIONS = "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # turn how others read
HIDDEN = "\U000e0000", "\U000e007f"  # letters that nobody sees and language models read
_IN_KEYS = re.compile(r"[/*$#?{}]")


def normal(text: str) -> str:
    """One spelling of a text: Unicode composed (NFC), single spaces, none around it."""
    return " ".join(unicodedata.normalize("NFC", text).split())


def same(text: str) -> str:
    """What names that are the same have in common: composed, single spaces, without case."""
    return normal(normal(text).casefold())


def shown(text: str) -> str:
    """A text for a terminal or a log: what would move the cursor, turn the reading or cannot be encoded is `?`."""
    return text if text.isprintable() else "".join("?" if _unprintable(c) else c for c in text)


def fault_of_text(kind: str, text: str, longest: int = LONGEST_TEXT) -> str:
    """What is wrong with a text of this kind, as a sentence; empty when nothing is."""
    odd = "" if text.isprintable() else text  # characters one by one only where some are
    if any("\ud800" <= c <= "\udfff" for c in odd):
        return f"{kind} {_quoted(text)} is not valid Unicode: give it as UTF-8"
    if any(_unprintable(c) for c in odd):
        return f"{kind} {_quoted(text)} holds control characters: leave them out"
    if len(text) > longest:
        return f"{kind} {_quoted(text)} is longer than {longest} characters: shorten it"
    return ""


def fault_of_name(kind: str, name: str, longest: int = LONGEST_NAME) -> str:
    """As `fault_of_text`, of a name, which says something and stands on one line."""
    if "\n" in name or "\t" in name:
        return f"{kind} {_quoted(name)} holds control characters: leave them out"
    if not name.strip():
        return f"{kind} is empty: name it"
    return fault_of_text(kind, name, longest)


@lru_cache(256)
def fault_of_robot(name: str) -> str:
    """What is wrong with the name of a robot, as a sentence; empty when nothing is."""
    if fault := fault_of_name("the robot's name", name, LONGEST_ROBOT):
        return fault
    if found := _IN_KEYS.search(name):
        return f"the robot's name {_quoted(name)} holds {found[0]!r}: choose one without any of / * $ # ? {{ }}"
    if name in RESERVED or name.startswith("@"):
        return f"the robot's name {_quoted(name)} is reserved: choose another"
    return ""


def fault_of_names(kind: str, names: Iterable[str], most: int) -> str:
    """What is wrong with a list of names, as a sentence: too many, unusable, or the same one twice."""
    first: dict[str, str] = {}
    names = list(names)
    if len(names) > most:
        return f"{len(names)} {kind} names are given: at most {most} are taken"
    for name in names:
        if fault := fault_of_name(f"the {kind} name", name):
            return fault
        if (other := first.get(same(name))) is not None:
            return f"{kind} names: {_quoted(other)} and {_quoted(name)} are the same name; give each once"
        first[same(name)] = name
    return ""


def key_part(text: str) -> str:
    """`text` as part of a key. Raises ValueError when it is none."""
    if not text or _IN_KEYS.search(text) or any(_unprintable(c) or c in "\n\t" for c in text):
        raise ValueError(f"{_quoted(text)} cannot be part of a key")
    return text


def _unprintable(c: str) -> bool:
    unseen = c in DIRECTIONS or c == "\ufeff" or HIDDEN[0] <= c <= HIDDEN[1]
    return unseen or (unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") and c not in "\n\t")


def _quoted(text: str) -> str:
    """In quotes and short; what must not reach a terminal is escaped."""
    short = text if len(text) <= 40 else f"{text[:39]}…"
    return "'" + "".join(ascii(c)[1:-1] if _unprintable(c) or c in "\n\t" else c for c in short) + "'"
