"""A prior graph from a language model, as a conversation (paper, Prior Graph Extraction; pure).

Top-down: regions, then the objects that are relevant and discriminative with geometry and appearance of each region,
then the objects' sizes, then P(o | r), then P(ri <-> rj). The conversation is a generator: it yields what to say and is
sent what was answered; whoever drives it owns network, retries and time. Every answer is checked; a faulty one goes
back with its faults.
"""

import json
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from string import Template
from typing import Any, TypeVar

import msgspec
import numpy as np

from prior_sg.schemas.names import normal
from prior_sg.schemas.priors import MOST_REGIONS, Task
from prior_sg.services.prior_gateway.core.answers import CUT_OFF, parse
from prior_sg.services.prior_gateway.core.faults import (
    LARGEST_CM,
    Described,
    NamedList,
    Placed,
    Sized,
    faults_of_description,
    faults_of_keys,
    faults_of_names,
    faults_of_percentages,
    faults_of_places,
    faults_of_size,
    unknown,
)

PROMPT_FIELDS: dict[str, set[str]] = {
    "system": set(),
    "regions": {"environment", "task", "most_regions"},
    "fixed_regions": {"environment", "task", "regions"},
    "describe": {"environment", "task", "regions", "batch"},
    "sizes": {"environment", "objects", "batch"},
    "containment": {"environment", "task", "regions", "objects", "batch"},
    "adjacency": {"environment", "task", "regions"},
    "revise": {"environment", "task", "regions", "disagreements"},
    "revise_regions": {"environment", "task", "regions", "strange", "most"},
    "neighbours": {"environment", "regions", "batch"},
    "reason": set(),
    "answer": {"form"},
    "faults": {"faults"},
}
MOST_FAULTS = 12  # told at once
LONGEST_ECHO = 8000  # characters of a faulty answer that go back to the model
ASYMMETRY = 15.0  # percent by which two statements about one pair may differ; their mean counts
OBJECTS_PER_REGION = 8  # asked for
LEAST, MOST = 0.01, 0.99  # no estimate of a model is certain

RAISE = "raise prior_gateway.synthesis.max_tokens"

Schema = dict[str, Any]
A = TypeVar("A")
Dialogue = Generator["Turn", str, A]


class SynthesisConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How a model is asked for a prior."""

    samples: int = 3  # generations averaged (K)
    reason: bool = True  # let the model think in plain text before each answer
    repairs: int = 2  # times a faulty answer goes back (N)
    most_regions: int = 12
    regions_per_call: int = 0  # described in one call; 0 = all. Small models do better with 1
    max_tokens: int = 4096  # of one answer
    steps: int = 0  # let numbers be chosen from so many, for servers that enforce no minimum and maximum; 0 = any

    def __post_init__(self) -> None:
        if not 1 <= self.samples <= 16 or self.max_tokens < 1:
            raise ValueError("samples (1 to 16) or max_tokens is out of range")
        if min(self.repairs, self.regions_per_call, self.steps) < 0 or self.steps == 1:
            raise ValueError("repairs and regions_per_call must not be negative; steps is 0 or at least 2")
        if not 3 <= self.most_regions <= MOST_REGIONS:
            raise ValueError(f"most_regions must lie between 3 and {MOST_REGIONS}")

    def number(self, low: int, high: int) -> Schema:
        """The form of a whole number."""
        form: Schema = {"type": "integer", "minimum": low, "maximum": high}
        steps = np.unique(np.linspace(low, high, self.steps).round().astype(int)).tolist()
        return form | {"enum": steps} if self.steps else form

    @property
    def length(self) -> Schema:
        """The form of a side in centimetres; steps, if any, are geometric, up to the size of a room."""
        form: Schema = {"type": "integer", "minimum": 1, "maximum": LARGEST_CM}
        steps = np.unique(np.geomspace(2, 1000, self.steps).round().astype(int)).tolist()
        return form | {"enum": steps} if self.steps else form

    @property
    def percent(self) -> Schema:
        """The form of a percentage."""
        return self.number(0, 100)


@dataclass(frozen=True)
class Prompts:
    """The texts of one version."""

    version: str
    texts: dict[str, Template]

    def __call__(self, name: str, **fields: str) -> str:
        return self.texts[name].substitute(fields)


@dataclass(frozen=True)
class Turn:
    """What to say: the conversation so far, ending with the user's text, and the form of the answer (None = free)."""

    messages: tuple[tuple[str, str], ...]  # (role, text)
    schema: Schema | None = None
    name: str = "thoughts"


@dataclass(frozen=True)
class Draft:
    """One generation, complete. Matrices are probabilities; rows are regions."""

    regions: list[str]
    parents: list[str]
    existence: np.ndarray  # (region,), sums to one
    phrases: list[list[str]]
    inclination_deg: np.ndarray  # (region, 2): mean, standard deviation
    query_radius_m: np.ndarray  # (region,)
    objects: list[str]
    sizes_m: np.ndarray  # (object, 4): longest and shortest horizontal side, height, lower edge above the floor
    containment: np.ndarray  # (region, object)
    adjacency: np.ndarray  # (region, region), diagonal 1


class Unusable(Exception):
    """The model's answer still had faults after all repairs; the message is one sentence."""


@dataclass
class Talk:
    """Who asks: the prompts, the settings and the fields that many prompts share."""

    prompts: Prompts
    cfg: SynthesisConfig
    fields: dict[str, str] = field(default_factory=dict)

    def ask(self, name: str, schema: Schema, read: Callable[[str], tuple[A, list[str]]], **more: str) -> Dialogue[A]:
        """One question: thought about, answered as JSON, sent back with its faults. Raises Unusable."""
        fields = {key: value for key, value in (self.fields | more).items() if key in PROMPT_FIELDS[name]}
        question, form = self.prompts(name, **fields), self.prompts("answer", form=outline(schema))
        messages = [("system", self.prompts("system"))]
        if self.cfg.reason:
            messages.append(("user", f"{question}\n\n{self.prompts('reason')}"))
            thoughts = yield Turn(tuple(messages))
            messages += [("assistant", thoughts.strip()[:LONGEST_ECHO] or "-"), ("user", form)]
        else:
            messages.append(("user", f"{question}\n\n{form}"))
        for _ in range(self.cfg.repairs + 1):
            text = yield Turn(tuple(messages), schema, name)
            answer, faults = read(text)
            if not faults:
                return answer
            told = "\n".join(f"- {fault}" for fault in faults[:MOST_FAULTS])
            messages += [("assistant", text[:LONGEST_ECHO] or "-"), ("user", self.prompts("faults", faults=told))]
        times = f"{self.cfg.repairs} repair{'s' if self.cfg.repairs != 1 else ''}"
        why = f"it is cut off at {self.cfg.max_tokens} tokens, {RAISE}" if faults[0] == CUT_OFF else faults[0]
        raise Unusable(f"its answer about {name.replace('_', ' ')} was still faulty after {times}: {why}")


def synthesise(task: Task, prompts: Prompts, cfg: SynthesisConfig) -> Dialogue[Draft]:
    """One generation of a prior for a task. Raises Unusable."""
    talk = Talk(prompts, cfg, {"environment": task.environment or "any", "task": task.task or "find the way around"})
    if task.regions:
        regions = list(task.regions)
        placed = yield from place_regions(talk, regions)
    else:
        regions, placed = yield from choose_regions(talk)
    talk.fields["regions"] = ", ".join(regions)
    described: dict[str, Described] = {}
    for batch in batches(regions, cfg.regions_per_call):
        described |= yield from describe(talk, batch)
    objects = list(dict.fromkeys(name for region in regions for name in described[region].objects))
    talk.fields["objects"] = ", ".join(objects)
    sized: dict[str, Sized] = {}
    for batch in batches(objects, OBJECTS_PER_REGION * cfg.regions_per_call):
        sized |= yield from sizes(talk, batch)
    held: dict[str, dict[str, float]] = {}
    for batch in batches(regions, cfg.regions_per_call):
        held |= yield from containment(talk, batch, objects)
    touching = yield from adjacency(talk, regions)
    shares = np.maximum([placed[region].share for region in regions], 1.0)
    one_by_one = [described[region] for region in regions]
    return Draft(
        regions=regions,
        parents=[normal(placed[region].parent) for region in regions],
        existence=shares / shares.sum(),
        phrases=[entry.phrases for entry in one_by_one],
        inclination_deg=np.array([(entry.inclination_deg, entry.inclination_spread_deg) for entry in one_by_one]),
        query_radius_m=np.array([entry.scale_cm / 100 for entry in one_by_one]),
        objects=objects,
        sizes_m=np.array([msgspec.structs.astuple(sized[name]) for name in objects]) / 100,
        containment=probability([[held[region][name] for name in objects] for region in regions]),
        adjacency=touching,
    )


def batches(names: list[str], size: int) -> list[list[str]]:
    """`names` in pieces of at most `size`; 0 = in one."""
    return [names[i : i + size] for i in range(0, len(names), size)] if size else [names]


def choose_regions(talk: Talk) -> Dialogue[tuple[list[str], dict[str, Placed]]]:
    """The regions into which the task divides the environment."""
    item = form_of({"name": TEXT, "parent": TEXT, "share": talk.cfg.percent})
    schema = form_of({"regions": {"type": "array", "items": item, "minItems": 3, "maxItems": talk.cfg.most_regions}})

    def read(text: str) -> tuple[dict[str, Placed], list[str]]:
        answer, faults = parse(text, NamedList, ["regions"])
        if answer is None:
            return {}, faults
        for region in answer.regions:
            region.name = normal(region.name.lower())
            region.parent = normal(region.parent)
        names = [region.name for region in answer.regions]
        found: dict[str, Placed] = {region.name: region for region in answer.regions}
        faults = [f"the region {name!r} is named more than once" for name in sorted({*names}) if names.count(name) > 1]
        if len(found) < 3 or len(found) > talk.cfg.most_regions:
            faults.append(f"name between 3 and {talk.cfg.most_regions} different regions; there are {len(found)}")
        return found, faults + faults_of_names("region", names) + faults_of_places(found)

    found = yield from talk.ask("regions", schema, read, most_regions=str(talk.cfg.most_regions))
    return list(found), found


def place_regions(talk: Talk, regions: list[str]) -> Dialogue[dict[str, Placed]]:
    """Zone and share of regions that the task has fixed."""
    schema = form_of(dict.fromkeys(regions, form_of({"parent": TEXT, "share": talk.cfg.percent})))

    def read(text: str) -> tuple[dict[str, Placed], list[str]]:
        found, faults = parse(text, dict[str, Placed], regions)
        if found is None:
            return {}, faults
        return found, faults_of_keys("region", found, regions) or faults_of_places(found)

    return (yield from talk.ask("fixed_regions", schema, read, regions=", ".join(regions)))


def describe(talk: Talk, batch: list[str]) -> Dialogue[dict[str, Described]]:
    """Appearance, objects and geometry of some regions."""
    form = form_of(
        {
            "phrases": {"type": "array", "items": TEXT, "minItems": 2, "maxItems": 5},
            "objects": {"type": "array", "items": TEXT, "minItems": 2, "maxItems": OBJECTS_PER_REGION},
            "inclination_deg": talk.cfg.number(0, 90),
            "inclination_spread_deg": talk.cfg.number(1, 45),
            "scale_cm": talk.cfg.number(20, 999),
        }
    )

    def read(text: str) -> tuple[dict[str, Described], list[str]]:
        found, faults = parse(text, dict[str, Described], batch)
        if found is None:
            return {}, faults
        if faults := faults_of_keys("region", found, batch):
            return {}, faults
        for entry in found.values():
            entry.phrases = _tidy(entry.phrases)
            entry.objects = _tidy(name.lower() for name in entry.objects)
        return found, [fault for name, entry in found.items() for fault in faults_of_description(name, entry)]

    return (yield from talk.ask("describe", form_of(dict.fromkeys(batch, form)), read, batch=", ".join(batch)))


def sizes(talk: Talk, batch: list[str]) -> Dialogue[dict[str, Sized]]:
    """Size of some objects, and how high above the floor they begin."""
    side, lower = talk.cfg.length, talk.cfg.number(0, 250)
    form = form_of({"longest_cm": side, "shortest_cm": side, "height_cm": side, "bottom_cm": lower})

    def read(text: str) -> tuple[dict[str, Sized], list[str]]:
        found, faults = parse(text, dict[str, Sized], batch)
        if found is None:
            return {}, faults
        faults = faults_of_keys("object", found, batch)
        faults += [fault for name, entry in found.items() for fault in faults_of_size(name, entry)]
        longest = [entry.longest_cm for entry in found.values()]
        if any(value != round(value) for value in longest) and max(longest) <= 10:
            faults.append("the lengths look like metres; give centimetres")
        return found, faults

    return (yield from talk.ask("sizes", form_of(dict.fromkeys(batch, form)), read, batch=", ".join(batch)))


def containment(talk: Talk, batch: list[str], objects: list[str]) -> Dialogue[dict[str, dict[str, float]]]:
    """P(o | r) of some regions, in percent, for all objects."""
    schema = form_of(dict.fromkeys(batch, form_of(dict.fromkeys(objects, talk.cfg.percent))))

    def read(text: str) -> tuple[dict[str, dict[str, float]], list[str]]:
        return read_matrix(text, {region: objects for region in batch}, ("region", "object"))

    return (yield from talk.ask("containment", schema, read, batch=", ".join(batch)))


def adjacency(talk: Talk, regions: list[str]) -> Dialogue[np.ndarray]:
    """P(ri <-> rj), (region, region), symmetric with diagonal 1. Each pair is asked for once; a model that gives it in
    both directions must say about the same twice."""
    form = {region: regions[i + 1 :] for i, region in enumerate(regions[:-1])}
    schema = form_of({region: form_of(dict.fromkeys(others, talk.cfg.percent)) for region, others in form.items()})

    def read(text: str) -> tuple[np.ndarray, list[str]]:
        found, faults = parse(text, dict[str, dict[str, float]], regions, regions)
        return (np.eye(len(regions)), faults) if found is None else read_adjacency(found, regions)

    if len(regions) == 1:
        return np.eye(1)
    return (yield from talk.ask("adjacency", schema, read))


def read_matrix(
    text: str, form: dict[str, list[str]], kinds: tuple[str, str]
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """A matrix of percentages in the form {row: {column: percent}}, with everything that is wrong about it."""
    columns_asked = [*dict.fromkeys(name for columns in form.values() for name in columns)]
    found, faults = parse(text, dict[str, dict[str, float]], list(form), columns_asked)
    if found is None:
        return {}, faults
    faults = faults_of_keys(kinds[0], found, list(form))
    for row, columns in form.items():
        if row in found:
            faults += faults_of_keys(kinds[1], found[row], columns, f" of {row!r}")
    return found, faults + faults_of_percentages(found)


def read_adjacency(found: dict[str, dict[str, float]], regions: list[str]) -> tuple[np.ndarray, list[str]]:
    """The symmetric matrix of probabilities, and what is wrong with what was found."""
    faults = [f"there is no region {name!r}" for name in unknown(found, regions)]
    faults += [f"there is no region {name!r}" for row in found.values() for name in unknown(row, regions)]
    faults += faults_of_percentages(found)
    matrix = np.eye(len(regions))
    for i, one in enumerate(regions):
        for j, other in enumerate(regions[:i]):
            said = [found[a][b] for a, b in ((one, other), (other, one)) if b in found.get(a, {})]
            if not said:
                faults.append(f"the pair {other!r} and {one!r} is missing")
            elif max(said) - min(said) > ASYMMETRY:
                faults.append(f"{other!r} and {one!r}: {min(said):g} one way, {max(said):g} the other; it is one pair")
            else:
                matrix[i, j] = matrix[j, i] = float(probability(sum(said) / len(said)))
    return matrix, list(dict.fromkeys(faults))


TEXT: Schema = {"type": "string"}


def form_of(properties: dict[str, Schema]) -> Schema:
    """Every property required and no other allowed, so that a server that constrains its sampling cannot omit one."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def outline(schema: Schema) -> str:
    """A form as a model reads it: a schema that repeats what a number is for each of hundreds costs many times that."""
    match schema:
        case {"properties": properties}:
            return f"{{{', '.join(f'{json.dumps(name)}: {outline(of)}' for name, of in properties.items())}}}"
        case {"items": items, "maxItems": most}:
            return f"[{outline(items)}, {schema.get('minItems', 0)} to {most} of these]"
        case {"minimum": least, "maximum": most}:
            return f"<{least} to {most}>"
        case {"enum": choices}:
            return " or ".join(map(json.dumps, choices))
    return '"text"'


def probability(percent: Any) -> np.ndarray:
    """Percentages as probabilities that are never certain."""
    return np.clip(np.asarray(percent, dtype=float) / 100, LEAST, MOST)


def _tidy(texts: Iterable[str]) -> list[str]:
    """Each text once, with single spaces; one without letter or digit says nothing and is left out."""
    return [text for text in dict.fromkeys(map(normal, texts)) if any(c.isalnum() for c in text)]
