"""A scene in few words, for language models and people: the most useful first, within a budget of tokens (pure).

Tokens are counted without a tokenizer, and rather too many than too few: a word is a token for every three of its
letters begun, a digit, a sign and a line break are one each, and a letter outside ASCII is one for each of its bytes.
Tokenizers of language models join more than that, except in strings of letters that are no words.

Names and tasks come from outside: they are written on one line, without control characters, and shortened.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from prior_sg.schemas.foresight import Opening
from prior_sg.schemas.members import headline, said
from prior_sg.schemas.names import shown
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import pose_from_quaternion, rows_before

MOST_TOKENS, LEAST_TOKENS = 100_000, 200
USUAL_TOKENS = 2000
LONGEST_NAME, LONGEST_TASK = 15, 40  # tokens
FOR_OMISSIONS = 70  # tokens that are kept for saying what was left out
CANDIDATES, LEAST_BELIEF = 3, 0.05
MOST_IDS = 8  # of objects with one label in one region
FIRST_MARKERS = slice(10)  # whose lines leave room for what is expected and for openings, which the others follow
FIRST_EXPECTED, LEAST_EXPECTED = slice(6), 0.2  # labels that are expected and not seen, likewise
REGIONS = "Regions, with the width of the ways out of them:\n"
PIECES = re.compile(r"[A-Za-z]+|[^ ]")


@dataclass
class Budget:
    """Tokens that are left, and how many pieces of each kind found no room."""

    left: int
    omitted: dict[str, int] = field(default_factory=dict)

    def take(self, text: str, kind: str) -> bool:
        """Whether the text still fits; if so, it is paid for. `kind` is what it is, in the plural."""
        cost = tokens_of(text)
        if cost > self.left:
            self.omitted[kind] = self.omitted.get(kind, 0) + 1
            return False
        self.left -= cost
        return True


def scene_text(scene: Scene, budget_tokens: int = USUAL_TOKENS) -> str:
    """The scene as lines of text of at most `budget_tokens`. Raises ValueError below 200 and above 100 000."""
    if not LEAST_TOKENS <= budget_tokens <= MOST_TOKENS:
        raise ValueError(f"a budget lies between {LEAST_TOKENS} and {MOST_TOKENS} tokens, not at {budget_tokens}")
    head = "".join(_head(scene))
    budget = Budget(budget_tokens - tokens_of(head) - FOR_OMISSIONS)
    parts: tuple[Callable[[Scene, Budget], Iterable[str]], ...] = (
        _camera,
        _regions,
        _elsewhere,
        partial(_markers, rows=FIRST_MARKERS),
        partial(_expected, rows=FIRST_EXPECTED),
        _frontiers,
        partial(_markers, rows=slice(FIRST_MARKERS.stop, None)),
        partial(_expected, rows=slice(FIRST_EXPECTED.stop, None)),
    )
    body = [line for part in parts for line in part(scene, budget)]
    return head + "".join(body) + _omissions(budget.omitted)


def tokens_of(text: str) -> int:
    """How many tokens a text has, counted as above."""
    return sum(_cost(piece) for piece in PIECES.findall(text))


def _cost(piece: str) -> int:
    if piece.isascii():
        return -(-len(piece) // 3)
    return len(piece.encode())


def _head(scene: Scene) -> Iterator[str]:
    """What it is about; at most 130 tokens."""
    task, environment = _short(scene.task, LONGEST_TASK), _short(scene.environment, LONGEST_NAME)
    yield f'Task: "{task}" in "{environment}".\n' if task else f"{_no_task(scene)}.\n"
    yield f"{len(scene.regions)} regions, {len(scene.objects)} objects, {len(scene.place_ids)} places; "
    yield "positions (x, y, z) in metres, z up; # is an id, p a probability.\n"


def _no_task(scene: Scene) -> str:
    told = _short(headline("", scene.merged_of, scene.plain), LONGEST_TASK)
    return told[0].upper() + told[1:]


def _camera(scene: Scene, budget: Budget) -> Iterator[str]:
    if len(scene.trajectory) and budget.take(
        line := f"The camera was last at {_point(scene.trajectory[-1])}.\n", "other lines"
    ):
        yield line


def _regions(scene: Scene, budget: Budget) -> list[str]:
    """A line for each region that has room; then, as far as there is room, its ways out, contents and candidates."""
    if not scene.regions or not budget.take(REGIONS, "regions"):
        return []
    ranked = sorted(scene.regions, key=lambda region: (region.predicted, -region.area_m2 * region.probability))
    lines = {region.id: line for region in ranked if budget.take(line := _summary(region) + "\n", "regions")}
    listed = [region for region in ranked if region.id in lines]
    names = {region.id: _name(region) for region in scene.regions}
    objects = {item.id: item for item in scene.objects}
    parts: tuple[Callable[[Region], str], ...] = (
        lambda region: _ways(region, names),
        lambda region: _contents(region, objects),
        lambda region: _candidates(scene, region),
        _members,
    )
    for write in parts:
        for region in listed:
            if (part := write(region)) and budget.take(part, "details of regions"):
                lines[region.id] = lines[region.id].removesuffix("\n") + part + "\n"
    return [REGIONS, *lines.values()]


def _summary(region: Region) -> str:
    guess = " predicted from its surroundings" if region.predicted else ""
    zone = f" of {_short(region.parent)}" if region.parent else ""
    where = f"{region.area_m2:.1f} m2 around {_point(region.position_m)}"
    return f"- {_name(region)}{zone}: p {region.probability:.2f}{guess}, {where}"


def _ways(region: Region, names: dict[int, str]) -> str:
    """The widest way to each neighbour."""
    widest: dict[int, tuple[float, bool]] = {}
    for way in region.transitions:
        widest[way.region] = max(widest.get(way.region, (0.0, False)), (way.clearance_m, way.door))
    told = [
        f"{names[other]} ({'door' if door else 'opening'} {2 * clearance_m:.1f} m)"
        for other, (clearance_m, door) in sorted(widest.items())
        if other in names
    ]
    told += [names[other] for other in sorted(set(region.neighbour_ids) - set(widest)) if other in names]
    return f"; to {', '.join(told)}" if told else ""


def _contents(region: Region, objects: dict[int, SceneObject]) -> str:
    """The objects in it by label, those of most objects first."""
    held = [objects[number] for number in region.object_ids if number in objects]
    return f"; holds {_by_label(held)}" if held else ""


def _by_label(items: list[SceneObject]) -> str:
    found: dict[str, list[int]] = {}
    for item in items:
        found.setdefault(_short(item.label), []).append(item.id)
    unnamed, told = found.pop("", []), []
    for label, numbers in sorted(found.items(), key=lambda entry: -len(entry[1])):
        more = f" and {len(numbers) - MOST_IDS} more" if len(numbers) > MOST_IDS else ""
        told.append(f"{label} {' '.join(f'#{number}' for number in numbers[:MOST_IDS])}{more}")
    return ", ".join(told + ([f"{len(unnamed)} unnamed objects"] if unnamed else []))


def _candidates(scene: Scene, region: Region) -> str:
    """What else it may be, by the mean belief of its places."""
    rows = scene.place_regions == region.id
    if not rows.any():
        return ""
    beliefs = scene.posteriors[rows].astype(np.float32).mean(axis=0)
    best = [
        f"{_short(scene.labels[column])} {beliefs[column]:.2f}"
        for column in np.argsort(-beliefs, kind="stable")
        if scene.labels[column] != region.label and beliefs[column] >= LEAST_BELIEF
    ][:CANDIDATES]
    if region.unknown >= LEAST_BELIEF:
        best.append(f"unknown {region.unknown:.2f}")
    return f"; or {', '.join(best)}" if best else ""


def _members(region: Region) -> str:
    """What a merged region is made of."""
    told = [_short(said(member)) for member in region.members[:MOST_IDS]]
    more = f" and {len(region.members) - MOST_IDS} more" if len(region.members) > MOST_IDS else ""
    return f"; made of {', '.join(told)}{more}" if told else ""


def _elsewhere(scene: Scene, budget: Budget) -> Iterator[str]:
    """Objects in no region, and places without one."""
    held = {number for region in scene.regions for number in region.object_ids}
    loose = [item for item in scene.objects if item.id not in held]
    if loose and budget.take(line := f"In no region: {_by_label(loose)}.\n", "other lines"):
        yield line
    bare = int((scene.place_regions == NO_REGION).sum())
    if bare and budget.take(line := f"{bare} places belong to no region yet.\n", "other lines"):
        yield line


def _markers(scene: Scene, budget: Budget, rows: slice) -> Iterator[str]:
    """Printed markers: where each hangs, and what is doubtful about it."""
    names = {region.id: _name(region) for region in scene.regions}
    for marker in scene.markers[rows]:
        pose = pose_from_quaternion(np.array(marker.position_m), np.array(marker.quaternion_xyzw))
        places = rows_before(pose, scene.positions_m)
        gaps_m = np.linalg.norm(scene.positions_m[places] - pose[:3, 3], axis=1)
        holder = names.get(int(scene.place_regions[places[gaps_m.argmin()]]), "") if len(places) else ""
        where = f"{_point(marker.position_m)}{f' in {holder}' if holder else ''}"
        doubt = f", in doubt: {_short(marker.doubt, LONGEST_TASK)}" if marker.doubt else ""
        line = f"Printed marker {marker.id} ({_short(marker.dictionary)}) at {where}{doubt}\n"
        if budget.take(line, "markers"):
            yield line


def _expected(scene: Scene, budget: Budget, rows: slice) -> Iterator[str]:
    """What nobody has seen: labels that are probably still to be found, and the surest place to look for each."""
    for entry in scene.foresight.missing[rows]:
        behind = max(scene.foresight.openings, key=lambda opening: _chance(opening, entry.label), default=None)
        if behind is None or entry.probability < LEAST_EXPECTED:
            continue
        where = f"p {_chance(behind, entry.label):.2f} beyond {_point(np.array(behind.beyond_m))}"
        line = f"Expected, not seen: {_short(entry.label)} p {entry.probability:.2f}, most likely {where}\n"
        if budget.take(line, "expectations"):
            yield line


def _chance(opening: Opening, label: str) -> float:
    return next((entry.within for entry in opening.labels if entry.label == label), 0.0)


def _frontiers(scene: Scene, budget: Budget) -> Iterator[str]:
    """Openings to unobserved space, the largest first."""
    if not len(scene.frontier_ids) or not budget.take(title := "Openings to unobserved space:\n", "openings"):
        return
    yield title
    row_of = {place: row for row, place in enumerate(scene.place_ids.tolist())}
    region_of = {region.id: _name(region) for region in scene.regions}
    for column in np.argsort(-scene.frontier_areas_m2, kind="stable").tolist():
        row = row_of.get(int(scene.frontier_ids[column]))
        if row is None:
            continue
        holder = region_of.get(int(scene.place_regions[row]), "no region")
        towards = _point(scene.frontier_directions[column])
        line = f"- {scene.frontier_areas_m2[column]:.1f} m2 in {holder} at {_point(scene.positions_m[row])}"
        if budget.take(line := f"{line} towards {towards}\n", "openings"):
            yield line


def _omissions(omitted: dict[str, int]) -> str:
    """At most FOR_OMISSIONS tokens."""
    if not omitted:
        return ""
    left_out = ", ".join(f"{count} {kind}" for kind, count in omitted.items())
    return f"Left out: {left_out}; a larger budget tells more.\n"


def _name(region: Region) -> str:
    return f"{_short(region.label) or 'unnamed region'} #{region.id}"


def _short(text: str, tokens: int = LONGEST_NAME) -> str:
    """On one line, without what a terminal would obey, and no longer than so many tokens."""
    plain = shown(" ".join(text.split())).replace('"', "'")
    if tokens_of(plain) <= tokens:
        return plain
    kept = ""
    for piece in re.findall(r"[A-Za-z]{1,3}|.", plain):
        if tokens_of(kept + piece) > tokens - len("…".encode()):
            break
        kept += piece
    return kept.rstrip() + "…"


def _point(point_m: tuple[float, float, float] | np.ndarray) -> str:
    x, y, z = (round(float(value), 1) + 0.0 for value in point_m)
    return f"({x:.1f}, {y:.1f}, {z:.1f})"
