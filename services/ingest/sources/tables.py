"""Lists and tables as spreadsheets, scripts and loggers write them: separators, byte-order marks, units of stamps."""

import csv
import json
import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.runtime.service import ServiceError

NS_PER = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
EPOCH_NS = (946_684_800 * 10**9, 4_102_444_800 * 10**9)  # 2000 to 2100: a stamp in between is a date
EPOCH_SPACING_NS = (500_000, 10**12)  # and then frames lie between half a millisecond and a quarter of an hour apart
SAID_SPACING_NS = (2_500_000, 5 * 10**9)  # a unit that is written down is believed from 400 Hz to one frame in 5 s
USUAL_SPACING_NS = (5_000_000, 5 * 10**9)  # else exactly one unit puts frames 5 ms to 5 s apart
RARE_SPACING_NS = 10**11  # and slower frames than these have no unit that can be told
FEW = 4  # fewer stamps tell no rate
NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf(?:inity)?)", re.IGNORECASE)
BOMS = ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))


class SourceError(ServiceError):
    """A source cannot be opened; the text is one sentence for the user."""


class LastingError(SourceError):
    """The same, of a fault of a running robot that waiting does not mend."""


def text_of(path: Path) -> str:
    """A text file's content without its byte-order mark. Raises SourceError."""
    try:
        data = path.read_bytes()
        return data.decode(next((encoding for mark, encoding in BOMS if data.startswith(mark)), "utf-8-sig"))
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} cannot be read: it is not a text in UTF-8 ({error.reason})") from error


def read_json(path: Path) -> Any:
    """A JSON file's content. Raises SourceError."""
    try:
        return json.loads(text_of(path))
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{path} cannot be read: {error}") from error


def table(path: Path, columns: int) -> list[list[str]]:
    """Rows of a text file of words, separated by blanks, commas or semicolons (then with decimal commas).

    Empty lines and lines that begin with # are left out. A short line stays, for whoever needs it to complain; when
    most are short the file is another one. Raises SourceError.
    """
    rows = [words_of(line) for line in lines_of(path)]
    short = [row for row in rows if len(row) < columns]
    if 2 * len(short) > len(rows):
        raise SourceError(
            f"{path} has a line with {len(short[0])} instead of {columns} columns: {' '.join(short[0])[:80]}"
        )
    return rows


def lines_of(path: Path) -> list[str]:
    """Lines that say something. Raises SourceError."""
    lines = (line.strip() for line in text_of(path).splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def words_of(line: str) -> list[str]:
    """The words of one line."""
    if ";" in line:
        return [word.strip().replace(",", ".") for word in line.split(";")]
    return [word.strip() for word in line.split(",")] if "," in line else line.split()


def named(line: str) -> tuple[str, str]:
    """The first word of a line and the rest, which may be a file's name with blanks."""
    if ";" in line:
        first, _, rest = line.partition(";")
        return first.strip().replace(",", "."), rest.strip()
    match = re.match(rf"({NUMBER.pattern})\s*[,\s]\s*(.*)", line, re.IGNORECASE)
    if match is None:
        first, _, rest = line.partition(" ")
        return first, rest.strip()
    return match[1], match[2].strip().strip('"')


def csv_rows(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Rows of a CSV file by column, names in small letters without blanks. Raises SourceError.

    Columns may be separated by commas, tabs, blanks, or semicolons with decimal commas.
    """
    lines = [line for line in text_of(path).splitlines() if line.strip(" ,;\t")]
    head = lines[0] if lines else ""
    separator = next((mark for mark in (";", "\t", ",") if mark in head), " ")
    lines = [re.sub(r" +", " ", line.strip()) for line in lines] if separator == " " else lines
    try:
        first, *rest = list(csv.reader(lines, delimiter=separator, skipinitialspace=True)) or [[]]
    except csv.Error as error:
        raise SourceError(f"{path} cannot be read: {error}") from error
    names = [re.sub(r"\s+", "_", name.strip().lstrip("#").strip().lower()) for name in first]
    missing = [name for name in columns if name not in names]
    if missing:
        held = ", ".join(name[:20] for name in names[:12]) or "nothing"
        raise SourceError(f"{path} lacks the columns {', '.join(missing)}; its first line is {held}")
    swapped = separator == ";"
    cells = rest  # a million rows take seconds: touched only where something is to be mended
    if swapped or any(blank in line for line in lines for blank in " \t"):
        cells = [[cell.strip().replace(",", ".") if swapped else cell.strip() for cell in row] for row in rest]
    return [dict(zip(names, row + [""] * (len(names) - len(row)), strict=False)) for row in cells]


def whole_number(word: str) -> int:
    """A number without a fraction, also as `12.0` or `1.2e1`, exact. Raises ValueError."""
    try:
        return int(word)
    except ValueError:
        pass
    try:
        value = Decimal(word.strip())
        if value == value.to_integral_value():
            return int(value)
    except (InvalidOperation, OverflowError):
        pass
    raise ValueError(f"not a whole number: {word!r}")


def stamps_ns(words: Sequence[str], path: Path, said: str, wanted: str = "") -> tuple[list[int | None], str]:
    """Nanoseconds, exact, of written stamps (None where one cannot be read), and a note when they are not in `said`.

    `said` is the unit that the format or the column's name tells, `wanted` the user's, which is believed. Else size
    (dates) and spacing decide. Raises SourceError when they tell nothing.
    """
    values = [_decimal(word) for word in words]
    readable = [value for value in values if value is not None]
    unit = wanted or (unit_of(np.array(readable, float), said) if readable else said)
    if not unit:
        raise SourceError(
            f"{path} has stamps whose unit cannot be told from their spacing: give --stamp-unit s, ms, us or ns, "
            "or the frame rate with --rate"
        )
    found = [None if value is None else round(value * NS_PER[unit]) for value in values]
    found = [stamp if stamp is not None and abs(stamp) < 2**63 else None for stamp in found]
    if words and all(stamp is None for stamp in found):
        unit_name = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}[unit]
        raise SourceError(f"{path} has a line that does not begin with a stamp in {unit_name}: {words[0][:40]}")
    note = f"the stamps of {path.name} are read as {unit}, not {said}, by their spacing" if unit != said else ""
    return found, note if not wanted else f"the stamps of {path.name} are read as {unit}, as told"


def unit_of(values: np.ndarray, said: str) -> str:
    """The unit of stamps, by their size and spacing; empty when these tell nothing."""
    levels = np.unique(values)
    if len(values) < FEW or len(levels) < 2:
        return said
    spacing = float(np.median(np.diff(levels)))
    for unit, factor in NS_PER.items():
        dated = EPOCH_NS[0] <= levels[0] * factor and levels[-1] * factor <= EPOCH_NS[1]
        if dated and EPOCH_SPACING_NS[0] <= spacing * factor <= EPOCH_SPACING_NS[1]:
            return unit
    if SAID_SPACING_NS[0] <= spacing * NS_PER[said] <= SAID_SPACING_NS[1]:
        return said
    low, high = USUAL_SPACING_NS
    usual = next((unit for unit, factor in NS_PER.items() if low <= spacing * factor < high), "")
    return usual or (said if high <= spacing * NS_PER[said] <= RARE_SPACING_NS else "")


def _decimal(word: str) -> Decimal | None:
    try:
        value = Decimal(word.strip())
    except InvalidOperation:
        return None
    return value if value.is_finite() and abs(value) < Decimal(10) ** 19 else None


def order_of(frame_ids: Sequence[int | None], stamps: Sequence[int | None]) -> tuple[list[int], list[str]]:
    """Positions of rows in the order of recording, and what was done to get there.

    Where the numbers rise the order is left, also when stamps go back: a clock was set. Else rows are sorted by stamp,
    then number; by number where only that makes numbers rise. Of rows with one number the first is taken; rows without
    number or stamp keep their place where nothing is sorted, and come last otherwise.
    """
    notes: list[str] = []
    seen: set[int] = set()
    kept: list[int] = []
    for position, number in enumerate(frame_ids):
        if number is None or number not in seen:
            kept.append(position)
        seen |= {number} if number is not None else set()
    if len(kept) < len(frame_ids):
        notes.append(f"{len(frame_ids) - len(kept)} rows repeat a frame: the first of each is taken")
    whole = [p for p in kept if frame_ids[p] is not None and stamps[p] is not None]
    if _rises([frame_ids[p] for p in whole]):
        return kept, notes
    by_stamp = sorted(whole, key=lambda p: (stamps[p], frame_ids[p]))
    by_number = sorted(whole, key=lambda p: frame_ids[p])  # type: ignore[arg-type,return-value]
    stamped = _rises([frame_ids[p] for p in by_stamp])
    notes.append(f"the rows are sorted by {'stamp' if stamped else 'frame number'}")
    return (by_stamp if stamped else by_number) + [p for p in kept if p not in set(whole)], notes


def _rises(numbers: Sequence[int | None]) -> bool:
    return all(a < b for a, b in pairwise(numbers))  # type: ignore[operator]


def check_stamps(stamps: Sequence[int | None], path: Path) -> None:
    """Raise SourceError when most frames have the stamp of the one before."""
    known = [stamp for stamp in stamps if stamp is not None]
    repeats = sum(a == b for a, b in pairwise(known))
    if len(known) >= FEW and 2 * repeats > len(known):
        raise SourceError(f"most stamps of {path} repeat the one before: give the frame rate with --rate")
