"""A prior revised by a language model that sees what was expected and what was observed (pure).

First the percentages in which the two disagree, entry by entry. Then, where the task left the regions to the prior and
robots have met places that none explains, the regions: a model may name those that are missing, or a part of one
that is a region of its own. It describes each as it describes those of a new prior.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.schemas.levels import LevelPrior
from prior_sg.schemas.names import normal
from prior_sg.schemas.priors import MOST_OBJECTS, MOST_REGIONS, ObjectPrior, Prior, Provenance, RegionPrior
from prior_sg.services.prior_gateway.core.answers import parse
from prior_sg.services.prior_gateway.core.faults import Described, faults_of_keys, faults_of_names, faults_of_spans
from prior_sg.services.prior_gateway.core.learning import corrected
from prior_sg.services.prior_gateway.core.turns import (
    LEAST,
    TEXT,
    Dialogue,
    Schema,
    Talk,
    Unusable,
    containment,
    describe,
    form_of,
    probability,
    read_matrix,
)

MOST_NEW = 2  # regions in one revision
MOST_ASKED = 12  # objects of a new region whose frequency is asked for
LARGEST_SHARE = 50.0  # percent
LEAST_LEFT = 0.3  # of the share of a region that is split
NONE = "none"
KEPT_PHRASES = 8

Entries = dict[str, dict[str, dict[str, float]]]  # {matrix: {row: {column: percent}}}
Form = dict[str, dict[str, dict[str, tuple[float, float]]]]  # the same, of (expected, observed)


class Missing(msgspec.Struct):
    """A region that a model misses."""

    name: str
    splits: str
    share: float


class MissingList(msgspec.Struct):
    """The answer to `revise_regions`."""

    regions: list[Missing]


@dataclass(frozen=True)
class Addition:
    """A region that the prior lacks."""

    name: str
    splits: str  # name of a region of the prior, or empty
    share: float  # of the environment
    described: Described
    held: dict[str, float]  # P(o | r) of some objects
    touching: dict[str, float]  # P(r <-> ri) of all regions of the prior


@dataclass(frozen=True)
class Revision:
    """What a model makes of observations."""

    entries: Entries
    additions: tuple[Addition, ...] = ()
    remark: str = ""  # why regions were not revised, where that failed


def revision(prior: Prior, told: str, form: Form, strange: tuple[str, Sequence[str]], talk: Talk) -> Dialogue[Revision]:
    """Percentages, then regions; either may have nothing to be asked about. `strange` are lines about places that no
    region explains, and the objects found there. Raises Unusable where percentages stay faulty."""
    entries: Entries = {}
    if form:
        entries = yield from revise(prior, told, form, talk)
    lines, objects = strange
    if not lines:
        return Revision(entries)
    try:
        return Revision(entries, tuple((yield from missing_regions(prior, lines, objects, talk))))
    except Unusable as why:
        if not form:
            raise
        return Revision(entries, remark=f"regions as they were, for {why}")


def revise(prior: Prior, told: str, form: Form, talk: Talk) -> Dialogue[Entries]:
    """New percentages for the entries in which expectation and observation disagree.

    `form` is {matrix: {row: {column: (expected, observed)}}} in percent. An answer must not leave the span between the
    two: evidence may be weighed, not contradicted.
    """
    schema = form_of(
        {kind: form_of({row: _within(talk, of) for row, of in rows.items()}) for kind, rows in form.items()}
    )
    talk.fields |= {"environment": prior.environment, "task": prior.task}
    talk.fields["regions"] = ", ".join(region.name for region in prior.regions)
    names = [*(region.name for region in prior.regions), *(item.name for item in prior.objects)]

    def read(text: str) -> tuple[dict[str, dict[str, dict[str, float]]], list[str]]:
        found, faults = parse(text, dict[str, dict[str, dict[str, float]]], list(form), names, names)
        if found is None:
            return {}, faults
        faults = faults_of_keys("matrix", found, list(form))
        for kind, rows in form.items():
            faults += faults_of_keys("region", found.get(kind, {}), list(rows), f" of {kind}")
            for row, columns in rows.items():
                given = found.get(kind, {}).get(row, {})
                faults += faults_of_keys("entry", given, list(columns), f" of {row!r}")
                faults += faults_of_spans(row, given, columns)
        return found, faults

    return (yield from talk.ask("revise", schema, read, disagreements=told))


def _within(talk: Talk, spans: dict[str, tuple[float, float]]) -> Schema:
    """The form of a row of percentages, each from what was expected to what was observed."""
    return form_of(
        {column: talk.cfg.number(math.floor(min(span)), math.ceil(max(span))) for column, span in spans.items()}
    )


def missing_regions(prior: Prior, strange: str, objects: Sequence[str], talk: Talk) -> Dialogue[list[Addition]]:
    """Regions that the prior lacks. Raises Unusable."""
    names = [region.name for region in prior.regions]
    room = min(MOST_NEW, MOST_REGIONS - len(names))
    talk.fields |= {"environment": prior.environment, "task": prior.task, "regions": ", ".join(names)}
    form = form_of({"name": TEXT, "splits": {"type": "string", "enum": [*names, NONE]}, "share": talk.cfg.percent})
    schema = form_of({"regions": {"type": "array", "items": form, "maxItems": room}})

    def read(text: str) -> tuple[list[Missing], list[str]]:
        answer, faults = parse(text, MissingList, ["regions"])
        if answer is None:
            return [], faults
        for one in answer.regions:
            one.name, one.splits = normal(one.name.lower()), normal(one.splits)
        return answer.regions, _faults_of_missing(answer.regions, names, room)

    found = yield from talk.ask("revise_regions", schema, read, strange=strange, most=str(room))
    additions = []
    for one in found:
        additions.append((yield from _described(prior, one, objects, talk)))
    return additions


def _faults_of_missing(found: list[Missing], names: list[str], room: int) -> list[str]:
    new = [one.name for one in found]
    faults = faults_of_names("region", new)
    if len(new) > room:
        faults.append(f"name at most {room} regions; there are {len(new)}")
    faults += [f"the region {name!r} is expected already" for name in new if name in names]
    faults += [f"the region {name!r} is named more than once" for name in sorted({*new}) if new.count(name) > 1]
    faults += [f"there is no region {one.splits!r} to split" for one in found if one.splits not in (*names, NONE)]
    return faults + [
        f"{one.name!r}: the share {one.share:g} must lie between 0 and {LARGEST_SHARE:g} percent"
        for one in found
        if not 0 < one.share <= LARGEST_SHARE
    ]


def _described(prior: Prior, one: Missing, objects: Sequence[str], talk: Talk) -> Dialogue[Addition]:
    """Appearance, objects and neighbours of a missing region."""
    names = [region.name for region in prior.regions]
    described = (yield from describe(talk, [one.name]))[one.name]
    asked = list(dict.fromkeys([*described.objects, *objects]))[:MOST_ASKED]
    talk.fields["objects"] = ", ".join(asked)
    held = yield from containment(talk, [one.name], asked)
    schema = form_of({one.name: form_of(dict.fromkeys(names, talk.cfg.percent))})

    def read(text: str) -> tuple[dict[str, dict[str, float]], list[str]]:
        return read_matrix(text, {one.name: names}, ("region", "region"))

    beside = yield from talk.ask("neighbours", schema, read, batch=one.name)
    return Addition(
        one.name,
        "" if one.splits == NONE else one.splits,
        one.share / 100,
        described,
        dict(zip(asked, probability([held[one.name][name] for name in asked]).tolist(), strict=True)),
        dict(zip(names, probability([beside[one.name][name] for name in names]).tolist(), strict=True)),
    )


def applied(prior: Prior, found: Revision, with_name: Callable[[str], list[str]], made: Provenance) -> Prior:
    """The prior as the model revises it. `with_name` gives the phrases that a name itself makes."""
    after = corrected(prior, found.entries, made)
    for addition in found.additions:
        after = extended(after, addition, with_name)
    return after


def extended(prior: Prior, new: Addition, with_name: Callable[[str], list[str]]) -> Prior:
    """The prior with one more region. What is said of one that it splits holds for both where nothing else is said; its
    share is taken of that region, else of all."""
    names, things = [region.name for region in prior.regions], [item.name for item in prior.objects]
    origin = names.index(new.splits) if new.splits else None
    unknown = [name for name in new.held if name not in things][: MOST_OBJECTS - len(things)]
    held = np.full((len(names) + 1, len(things) + len(unknown)), LEAST)
    held[:-1, : len(things)] = prior.containment
    if origin is not None:
        held[-1] = held[origin]
    for name, probability_of in new.held.items():
        if name in things or name in unknown:
            held[-1, [*things, *unknown].index(name)] = probability_of
    touching = np.eye(len(names) + 1)
    touching[:-1, :-1] = prior.adjacency
    touching[-1, :-1] = touching[:-1, -1] = [new.touching.get(name, LEAST) for name in names]
    zone = prior.regions[origin].parent if origin is not None else ""
    regions = [*_shared(prior.regions, origin, new.share), _region(new, zone, with_name)]
    total = sum(region.existence for region in regions)
    return msgspec.structs.replace(
        prior,
        regions=[msgspec.structs.replace(region, existence=region.existence / total) for region in regions],
        objects=[*prior.objects, *(ObjectPrior(name=name, phrases=with_name(name)) for name in unknown)],
        containment=held.astype(np.float32),
        adjacency=touching.astype(np.float32),
        spread=None,  # nobody has said how far generations would differ about the new region
        levels=_with_child(prior.levels, origin),
        tested=prior.tested
        and msgspec.structs.replace(prior.tested, regions=np.append(prior.tested.regions, np.float32(0.0))),
    )


def _with_child(levels: list[LevelPrior], origin: int | None) -> list[LevelPrior]:
    """The levels with one more region, which is where the one that it splits is, else anywhere."""
    if not levels:
        return levels
    lowest = levels[0]
    anywhere = np.array([entry.existence for entry in lowest.entries], np.float32)
    row = anywhere / anywhere.sum() if origin is None else lowest.parents[origin]
    return [msgspec.structs.replace(lowest, parents=np.vstack((lowest.parents, row))), *levels[1:]]


def _shared(regions: list[RegionPrior], origin: int | None, share: float) -> list[RegionPrior]:
    """The former regions after one of them, or all, have given `share` to a new one."""
    if origin is None:
        kept = [region.existence * (1 - share) for region in regions]
    else:
        kept = [region.existence for region in regions]
        kept[origin] = max(kept[origin] - share, LEAST_LEFT * kept[origin])
    return [msgspec.structs.replace(region, existence=of) for region, of in zip(regions, kept, strict=True)]


def _region(new: Addition, zone: str, with_name: Callable[[str], list[str]]) -> RegionPrior:
    return RegionPrior(
        name=new.name,
        phrases=list(dict.fromkeys([*with_name(new.name), *new.described.phrases]))[:KEPT_PHRASES],
        existence=new.share,
        inclination_mean_rad=float(np.radians(new.described.inclination_deg)),
        inclination_std_rad=float(np.radians(new.described.inclination_spread_deg)),
        query_radius_m=new.described.scale_cm / 100,
        parent=zone,
    )
