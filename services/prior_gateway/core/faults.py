"""What a model may answer, and what can be wrong with it (pure). Faults are sentences for the model to read."""

import math
from collections.abc import Sequence
from typing import Any

import msgspec

from prior_sg.schemas.names import LONGEST_NAME, fault_of_name, fault_of_text
from prior_sg.schemas.priors import LONGEST_PHRASE

MOST_LISTED = 16  # objects or phrases of one region
LEAST_SPREAD_DEG = 0.01
LARGEST_CM, HIGHEST_CM = 10_000, 2_000  # sides of an object, and its lower edge above the floor


class Described(msgspec.Struct):
    """What a model says of one region."""

    phrases: list[str]
    objects: list[str]
    inclination_deg: float
    inclination_spread_deg: float
    scale_cm: float


class Sized(msgspec.Struct):
    """What a model says of the size of one object."""

    longest_cm: float
    shortest_cm: float
    height_cm: float
    bottom_cm: float


class Placed(msgspec.Struct):
    """Zone and share of one region."""

    parent: str
    share: float


class Named(Placed):
    """A region that the model has chosen."""

    name: str


class NamedList(msgspec.Struct):
    """The answer to `regions`."""

    regions: list[Named]


def unknown(found: dict[str, Any], known: Sequence[str]) -> list[str]:
    """Names found that are none of those known."""
    return [name for name in found if name not in known]


def faults_of_keys(kind: str, found: dict[str, Any], wanted: list[str], where: str = "") -> list[str]:
    """Names that are missing, and names that nobody asked for."""
    faults = [f"there is no {kind} {name!r}{where}" for name in unknown(found, wanted)]
    return faults + [f"the {kind} {name!r}{where} is missing" for name in wanted if name not in found]


def faults_of_names(kind: str, names: Sequence[str]) -> list[str]:
    """Names that say nothing or too much."""
    faults = [
        f"a name of the kind {kind} has neither letter nor digit"
        for name in names
        if not any(c.isalnum() for c in name)
    ]
    faults += [f"the name {name[:LONGEST_NAME]!r}... is too long" for name in names if len(name) > LONGEST_NAME]
    return faults + list(
        filter(None, (fault_of_name(f"the {kind} name", name[:LONGEST_NAME]) for name in names if name))
    )


def faults_of_places(found: dict[str, Placed]) -> list[str]:
    """Shares that are no percentages of a whole, and zones without a proper name."""
    faults = [
        f"{name!r}: the share {at.share:g} is no percentage" for name, at in found.items() if not 0 <= at.share <= 100
    ]
    total = sum(at.share for at in found.values())
    if not faults and total <= 2:  # fractions, or nothing at all
        faults.append(f"the shares sum to {total:g}; they are percentages and sum to 100")
    return faults + faults_of_names("zone", [at.parent for at in found.values() if at.parent])


def faults_of_spans(row: str, given: dict[str, float], columns: dict[str, tuple[float, float]]) -> list[str]:
    """Percentages outside what was expected and what was observed, entry by entry."""
    return [
        f"{row!r}, {name!r}: {given[name]:g} lies outside {min(span):.0f} to {max(span):.0f}, "
        "which were expected and observed"
        for name, span in columns.items()
        if name in given and not math.floor(min(span)) <= given[name] <= math.ceil(max(span))
    ]


def faults_of_description(name: str, entry: Described) -> list[str]:
    """Counts, lengths and geometry of one region that cannot be."""
    faults = faults_of_names("object", entry.objects)
    if not entry.phrases:
        faults.append(f"{name!r}: there is no phrase")
    if not 1 <= len(entry.objects) <= MOST_LISTED or len(entry.phrases) > MOST_LISTED:
        faults.append(f"{name!r}: give 1 to {MOST_LISTED} objects and as many phrases at most")
    faults += filter(None, (fault_of_text(f"{name!r}: the phrase", phrase, LONGEST_PHRASE) for phrase in entry.phrases))
    if not (0 <= entry.inclination_deg <= 90 and LEAST_SPREAD_DEG <= entry.inclination_spread_deg <= 90):
        faults.append(f"{name!r}: inclination must be 0 to 90 degrees, its spread at least {LEAST_SPREAD_DEG:g}")
    if not 10 <= entry.scale_cm <= 10000:
        faults.append(f"{name!r}: scale_cm {entry.scale_cm:g} is no sensible distance in centimetres")
    return faults


def faults_of_size(name: str, entry: Sized) -> list[str]:
    """Sides and height of one object that cannot be."""
    sides = (entry.longest_cm, entry.shortest_cm, entry.height_cm)
    faults = []
    if min(sides) <= 0 or max(sides) > LARGEST_CM:
        faults.append(f"{name!r}: sides are centimetres between 0 and {LARGEST_CM}")
    if entry.shortest_cm > entry.longest_cm:
        faults.append(f"{name!r}: the shortest side is longer than the longest")
    if not 0 <= entry.bottom_cm <= HIGHEST_CM:
        faults.append(f"{name!r}: its lower edge is 0 to {HIGHEST_CM} centimetres above the floor")
    return faults


def faults_of_percentages(found: dict[str, dict[str, float]]) -> list[str]:
    """Entries of a matrix that are no percentages."""
    values = [value for row in found.values() for value in row.values()]
    faults = [
        f"{row!r}, {column!r}: {value:g} is no percentage"
        for row, columns in found.items()
        for column, value in columns.items()
        if not 0 <= value <= 100
    ]
    if any(value != round(value) for value in values) and max(values) <= 1:
        faults.append("the values look like fractions; give percentages from 0 to 100")
    return faults
