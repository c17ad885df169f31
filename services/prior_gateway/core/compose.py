"""From a task in plain words to a prior graph (paper, Prior Graph Extraction), by knowledge already written down.

Tasks divide an environment by merging its base regions. With w_i = P(r_i | E0) of the members i of a merged region m:

    P(m | E0)     = sum_i w_i
    P(o | m)      = sum_i w_i P(o | r_i) / sum_i w_i    a place of m is a place of r_i with probability w_i / sum w
    P(m <-> n)    = max_ij P(r_i <-> r_j)               they touch where any of their members touch
    mean, std     = of the mixture of the members' inclinations (law of total variance)
    r_Q           = sum_i w_i r_Q,i / sum_i w_i
    phrases       = of each member, the first w_i / max_j w_j of its own

The maximum and not a noisy-or: that one grows with the number of members, so a coarse task would get cheap boundaries
everywhere. A task that fixes its regions says that they are there, so their P(r | E0) is drawn towards uniform: a gym
is rare among homes, not small in a home that has one.
"""

import hashlib
import math
from collections.abc import Sequence

import msgspec
import numpy as np

from prior_sg.schemas.priors import ObjectPrior, Prior, Provenance, RegionPrior, Task
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.knowledge import Chosen, Environment, RegionEntry, TaskEntry
from prior_sg.services.prior_gateway.core.levels import levels_of
from prior_sg.services.prior_gateway.core.matching import choose_regions, match_environment, match_task, words

# Nouns that take no article.
MASS_NOUNS = frozenset(
    {"artwork", "bread", "clothing", "fruit", "furniture", "grass", "gravel", "laundry", "luggage", "machinery"}
    | {"medicine", "equipment", "scaffolding", "seating", "shelving", "signage", "tableware", "water"}
)


class NoPrior(Exception):
    """There is no prior for a task; the message is one sentence for the user."""


class Library(msgspec.Struct, frozen=True, kw_only=True):
    """Answers by heart."""

    environments: tuple[Environment, ...]
    version: str  # content address of the files

    def answer(self, task: Task, cfg: Config) -> Prior:
        """The prior of a curated task, or of the regions that the task fixes; raises NoPrior."""
        environment = match_environment(task.environment, self.environments)
        if task.regions:
            return self._of_vocabulary(task, environment, cfg)
        if environment is None:
            known = ", ".join(sorted(environment.name for environment in self.environments))
            raise NoPrior(f"The library knows no environment like {task.environment!r}; it knows {known}.")
        match = match_task(task.task, environment)
        note = f"{_environment_note(task, environment)}; {match.note}"
        detail = f"{environment.name}/{match.task.name}@{self.version}"
        chosen = task_regions(match.task, environment)
        return compose(task, chosen, match.task, Provenance(source="library", detail=detail, note=note), cfg)

    def _of_vocabulary(self, task: Task, environment: Environment | None, cfg: Config) -> Prior:
        if len(set(task.regions)) != len(task.regions) or not all(words(name) for name in task.regions):
            raise NoPrior("The task's region names must be words, and each may be given only once.")
        chosen = choose_regions(task.regions, environment, self.environments)
        note = "; ".join([_environment_note(task, environment), *(entry.how for entry in chosen)])
        detail = f"{environment.name if environment else '-'}/fixed vocabulary@{self.version}"
        fitting = match_task(task.task, environment).task if environment else None
        return compose(task, chosen, fitting, Provenance(source="library", detail=detail, note=note), cfg)


def question_of(task: Task, cfg: Config, prompts: str) -> str:
    """Content address of what is asked of whom: environment, task, vocabulary, provider, model, prompt version."""
    asked = (task.environment, task.task, task.regions, cfg.provider, cfg.model, prompts)
    return hashlib.blake2b(msgspec.msgpack.encode(asked), digest_size=16).hexdigest()


def noted(prior: Prior, remark: str) -> Prior:
    """The prior with a remark before its provenance's note."""
    made = prior.provenance
    note = "; ".join(filter(None, (remark, made.note)))
    return msgspec.structs.replace(prior, provenance=msgspec.structs.replace(made, note=note))


def task_regions(task: TaskEntry, environment: Environment) -> list[Chosen]:
    """The regions into which a curated task divides its environment."""
    return [
        Chosen(name, environment, tuple(environment.region(member) for member in members))
        for name, members in task.regions.items()
    ]


def compose(
    task: Task, chosen: Sequence[Chosen], entry: TaskEntry | None, provenance: Provenance, cfg: Config
) -> Prior:
    """The prior graph over the chosen regions; `entry` adds the objects that matter to its task."""
    extra = entry.objects if entry else {}
    objects = _object_names(chosen, extra)
    existence = _existence(chosen, cfg.named_existence_uniform if task.regions else 0.0)
    adjacency = _adjacency(chosen, cfg)
    levels = levels_of(task.task, chosen, existence, adjacency)
    regions = [_region(one, share, bool(task.regions), cfg) for one, share in zip(chosen, existence, strict=True)]
    return Prior(
        environment=task.environment,
        task=task.task,
        vocabulary=task.regions,
        regions=[msgspec.structs.replace(one, parent="") for one in regions] if levels else regions,
        objects=[_object(name, chosen, cfg) for name in objects],
        containment=_containment(chosen, objects, extra, cfg).astype(np.float32),
        adjacency=adjacency.astype(np.float32),
        provenance=provenance,
        levels=levels,
    )


def adjacency_of(environment: Environment, one: RegionEntry, other: RegionEntry, cfg: Config) -> float:
    """P(ri <-> rj) of two base regions of one environment: the pair as listed, else the larger `connects` of the two,
    else the default; 1 for a region with itself."""
    if one is other:
        return 1.0
    listed = one.adjacent.get(other.name, other.adjacent.get(one.name))
    if listed is not None:
        return listed
    connects = [entry.connects for entry in (one, other) if entry.connects is not None]
    return max(connects, default=cfg.unlisted_adjacency)


def with_article(name: str) -> str:
    """`name` as it stands in a phrase: "a stove", "an oven", "stairs"."""
    last = name.rsplit(maxsplit=1)[-1].casefold()
    plural = last.endswith("s") and not last.endswith(("ss", "us", "is", "'s"))
    if plural or last in MASS_NOUNS:
        return name
    first = name.casefold()
    vowel = first.startswith(("a", "e", "i", "o", "u", "x-ray")) and not first.startswith(
        ("uni", "use", "uti", "eu", "one")
    )
    return f"{'an' if vowel else 'a'} {name}"


def _environment_note(task: Task, environment: Environment | None) -> str:
    if environment is None:
        return f"the library knows no environment like {task.environment!r}: adjacency across environments is a default"
    same = words(task.environment) == words(environment.name)
    return f"environment {environment.name!r}" if same else f"{task.environment!r} as environment {environment.name!r}"


def _weights(one: Chosen) -> list[float]:
    assert one.environment is not None
    return [one.environment.share(member) for member in one.members]


def _existence(chosen: Sequence[Chosen], uniform: float) -> list[float]:
    """P(r | E0), summing to one, mixed with `uniform` parts of the uniform distribution; a region known by name alone
    counts as the mean of the others."""
    known = [sum(_weights(one)) for one in chosen if one.environment]
    mean = sum(known) / len(known) if known else 1.0
    raw = [sum(_weights(one)) if one.environment else mean for one in chosen]
    return [uniform / len(raw) + (1 - uniform) * value / sum(raw) for value in raw]


def _region(one: Chosen, existence: float, named: bool, cfg: Config) -> RegionPrior:
    """`named`: the given name describes the region itself, as in a fixed vocabulary; the abstract names of tasks
    ("service zone") say nothing about appearance."""
    phrases = phrases_of(one.name, cfg) if named or not one.members else []
    if not one.members:
        return RegionPrior(
            name=one.name, phrases=phrases, existence=existence, query_radius_m=cfg.query_radius_m or 0.75
        )
    weights = _weights(one)
    phrases += _member_phrases(one.members, weights, cfg)
    mean, std = _mixture([(e.inclination_deg, e.inclination_std_deg) for e in one.members], weights)
    radius = _mean([member.query_radius_m for member in one.members], weights)
    return RegionPrior(
        name=one.name,
        phrases=list(dict.fromkeys(phrases)),
        existence=existence,
        inclination_mean_rad=math.radians(mean),
        inclination_std_rad=math.radians(std),
        query_radius_m=cfg.query_radius_m or radius,
        parent=_common_parent(one.members, weights),
    )


def _common_parent(members: Sequence[RegionEntry], weights: Sequence[float]) -> str:
    """The zone that holds more than half of the members by their share, if there is one."""
    held: dict[str, float] = {}
    for member, weight in zip(members, weights, strict=True):
        held[member.parent] = held.get(member.parent, 0.0) + weight
    best = max(held, key=lambda zone: held[zone])
    return best if held[best] > sum(weights) / 2 else ""


def _member_phrases(members: Sequence[RegionEntry], weights: Sequence[float], cfg: Config) -> list[str]:
    """Name and appearance of the members, of rarer ones fewer phrases: a region's concept is the mean of its phrases'
    embeddings, where each member should count by its share."""
    found: list[str] = []
    for member, weight in zip(members, weights, strict=True):
        phrases = [*phrases_of(member.name, cfg), *member.phrases]
        found += phrases[: max(1, round(len(phrases) * weight / max(weights)))]
    return found


def _mixture(parts: Sequence[tuple[float, float]], weights: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation of a mixture of (mean, std)."""
    mean = _mean([part[0] for part in parts], weights)
    variance = _mean([std**2 + (part - mean) ** 2 for part, std in parts], weights)
    return mean, math.sqrt(variance)


def _mean(values: Sequence[float], weights: Sequence[float]) -> float:
    return sum(value * weight for value, weight in zip(values, weights, strict=True)) / sum(weights)


def phrases_of(name: str, cfg: Config) -> list[str]:
    """The phrases that a name itself makes."""
    return [template.format(with_article(name)) for template in cfg.templates]


def _object_names(chosen: Sequence[Chosen], extra: dict[str, dict[str, float]]) -> list[str]:
    """Objects listed by any member, and those of the task that a member may hold, in order of first mention."""
    members = [member for one in chosen for member in one.members]
    listed = [name for member in members for name in member.objects]
    of_task = [name for name, held in extra.items() if any(member.name in held for member in members)]
    return list(dict.fromkeys([*listed, *of_task]))


def _object(name: str, chosen: Sequence[Chosen], cfg: Config) -> ObjectPrior:
    """An object with its phrases, and its size as the first environment has it that knows it."""
    item = ObjectPrior(name=name, phrases=_object_phrases(name, chosen, cfg))
    sizes = [one.environment.sizes[name] for one in chosen if one.environment and name in one.environment.sizes]
    if not sizes:
        return item
    size = sizes[0]
    sides_m = (size.longest_m, size.shortest_m, size.height_m)
    return msgspec.structs.replace(item, size_m=sides_m, size_spread=size.spread, bottom_m=size.bottom_m)


def _object_phrases(name: str, chosen: Sequence[Chosen], cfg: Config) -> list[str]:
    further = [phrase for one in chosen if one.environment for phrase in one.environment.objects.get(name, [])]
    return list(dict.fromkeys([*phrases_of(name, cfg), *further]))


def _containment(
    chosen: Sequence[Chosen], objects: Sequence[str], extra: dict[str, dict[str, float]], cfg: Config
) -> np.ndarray:
    """P(o | r), (region, object). A region known by name alone gets the mean over all others: uniform, and as likely to
    hold any object as the rest, so that objects speak neither for nor against it on average."""
    matrix = np.full((len(chosen), len(objects)), np.nan)
    for row, one in enumerate(chosen):
        if one.members:
            weights = _weights(one)
            for column, name in enumerate(objects):
                held = [_held(member, name, extra, cfg) for member in one.members]
                matrix[row, column] = _mean(held, weights)
    alone = np.array([not one.members for one in chosen])
    if alone.any() and not alone.all():
        matrix[alone] = matrix[~alone].mean()
    return matrix


def _held(member: RegionEntry, name: str, extra: dict[str, dict[str, float]], cfg: Config) -> float:
    return extra.get(name, {}).get(member.name, member.objects.get(name, cfg.unlisted_containment))


def _adjacency(chosen: Sequence[Chosen], cfg: Config) -> np.ndarray:
    matrix = np.eye(len(chosen))
    for i, one in enumerate(chosen):
        for j, other in enumerate(chosen[:i]):
            matrix[i, j] = matrix[j, i] = _touch(one, other, cfg)
    return matrix


def _touch(one: Chosen, other: Chosen, cfg: Config) -> float:
    """P(m <-> n) of two different chosen regions: the largest over their members."""
    if one.environment is None or other.environment is None:
        return cfg.unknown_adjacency
    return max(
        _touch_members(one.environment, member, other.environment, neighbour, cfg)
        for member in one.members
        for neighbour in other.members
    )


def _touch_members(
    environment: Environment, entry: RegionEntry, other_environment: Environment, other: RegionEntry, cfg: Config
) -> float:
    """As `adjacency_of`; two regions of different environments touch as their counterparts in either one do."""
    if environment is other_environment:
        # Two names that share an entry are two regions of that kind: nothing is known about how they touch.
        return cfg.unknown_adjacency if entry is other else adjacency_of(environment, entry, other, cfg)
    for home, resident, guest in ((environment, entry, other), (other_environment, other, entry)):
        counterpart = next((known for known in home.regions if _same_kind(known, guest)), None)
        if counterpart is not None and counterpart is not resident:
            return adjacency_of(home, resident, counterpart, cfg)
    connects = [value for value in (entry.connects, other.connects) if value is not None]
    return max(connects, default=cfg.unknown_adjacency)


def _same_kind(known: RegionEntry, guest: RegionEntry) -> bool:
    return words(guest.name) in {words(name) for name in (known.name, *known.synonyms)}
