"""Shape of the curated knowledge: environments, their base regions, and tasks that divide them (pure)."""

from dataclasses import dataclass

import msgspec

from prior_sg.schemas.levels import NamedLevel


class Size(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What size an object usually is: the line of numbers in `library/sizes.toml`; metres."""

    longest_m: float  # horizontal sides
    shortest_m: float
    height_m: float
    bottom_m: float  # height of the lower edge above the floor
    spread: float = 0.35  # standard deviation of a side's logarithm


class RegionEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One base region: what it is called, looks like, holds and touches."""

    name: str
    phrases: list[str]  # what a camera sees there
    existence: float  # share of the environment's places expected to be of this region; only ratios matter
    objects: dict[str, float]  # P(o | r) of the objects worth naming; the rest has Config.unlisted_containment
    synonyms: list[str] = []
    parent: str = ""  # zone above the region, unless a level of the environment says it
    inclination_deg: float = 0.0  # of the walkable surface against the horizontal
    inclination_std_deg: float = 11.5
    query_radius_m: float = 0.75  # r_Q
    adjacent: dict[str, float] = {}  # P(ri <-> rj), written at one of the two regions
    connects: float | None = None  # P(ri <-> rj) to every region not listed, for regions that join others


class TaskEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One task: how people ask for it, and how it divides the environment."""

    name: str
    regions: dict[str, list[str]]  # task region -> base regions; together a partition of the environment's regions
    keywords: list[str] = []
    generic: bool = False  # the fallback of its environment
    objects: dict[str, dict[str, float]] = {}  # objects that matter to this task only -> base region -> P(o | r)


class LevelEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the parts of one level above regions are called. Of several of one name the task chooses, by keywords."""

    name: NamedLevel
    entries: list[str]
    parents: dict[str, str | dict[str, float]]  # base region -> the entry that it is in, or P(entry | region)
    otherwise: str | dict[str, float] = {}  # of the base regions not listed; without it, any entry alike
    task: str = ""  # whose words the entries are
    keywords: list[str] = []
    adjacent: dict[str, dict[str, float]] = {}  # P(ei <-> ej), written at one of the two


class Environment(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything known about one kind of environment."""

    name: str
    regions: list[RegionEntry]
    tasks: list[TaskEntry]
    synonyms: list[str] = []
    objects: dict[str, list[str]] = {}  # further phrases of an object
    levels: list[LevelEntry] = []  # above the regions, beyond the zones that they name as their parents
    sizes: dict[str, Size] = {}  # of objects that are of another size here than elsewhere

    def region(self, name: str) -> RegionEntry:
        """The base region of that name; raises KeyError."""
        for entry in self.regions:
            if entry.name == name:
                return entry
        raise KeyError(name)

    def share(self, entry: RegionEntry) -> float:
        """P(r | E0) of a base region: its existence over the sum of all."""
        return entry.existence / sum(other.existence for other in self.regions)

    @property
    def generic_task(self) -> TaskEntry:
        """The task used when no other fits."""
        return next(task for task in self.tasks if task.generic)


@dataclass(frozen=True)
class Chosen:
    """A region of the prior to be made: base regions under one name. `environment` None: known by its name alone."""

    name: str
    environment: Environment | None
    members: tuple[RegionEntry, ...]
    how: str = ""  # how the name was understood, for the provenance


def with_sizes(environment: Environment, common: dict[str, Size]) -> Environment:
    """The environment with the size of each of its objects: its own word, else the common one. Raises ValueError."""
    listed = [held for region in environment.regions for held in region.objects]
    listed += [held for task in environment.tasks for held in task.objects]
    sizes = {**common, **environment.sizes}
    if unknown := sorted({*listed} - sizes.keys()):
        raise ValueError(f"environment {environment.name!r}: no size of {unknown}")
    if unused := sorted(environment.sizes.keys() - {*listed}):
        raise ValueError(f"environment {environment.name!r}: sizes of {unused}, which it does not hold")
    return msgspec.structs.replace(environment, sizes={name: sizes[name] for name in dict.fromkeys(listed)})


def check_environment(environment: Environment) -> None:
    """Raise ValueError where the knowledge contradicts itself; says which entry."""
    names = [entry.name for entry in environment.regions]
    where = f"environment {environment.name!r}"
    if len(set(names)) != len(names):
        raise ValueError(f"{where}: region names are not unique")
    for entry in environment.regions:
        _check_region(entry, environment, where)
    for level in environment.levels:
        _check_level(level, names, f"{where}, level {level.name!r}")
    if [task.generic for task in environment.tasks].count(True) != 1:
        raise ValueError(f"{where}: exactly one task must be generic")
    for task in environment.tasks:
        members = [member for group in task.regions.values() for member in group]
        if sorted(members) != sorted(names):
            raise ValueError(f"{where}, task {task.name!r}: not a partition: {sorted(set(members) ^ set(names))}")
        if unknown := {region for held in task.objects.values() for region in held} - set(names):
            raise ValueError(f"{where}, task {task.name!r}: objects in unknown regions {sorted(unknown)}")


def _check_level(level: LevelEntry, regions: list[str], where: str) -> None:
    if not level.entries or len(set(level.entries)) != len(level.entries):
        raise ValueError(f"{where}: needs entries of different names")
    if unknown := sorted(set(level.parents) - set(regions)):
        raise ValueError(f"{where}: parents of unknown regions {unknown}")
    for said in (*level.parents.values(), level.otherwise):
        shares = {said: 1.0} if isinstance(said, str) else said
        if unknown := sorted(set(shares) - set(level.entries)):
            raise ValueError(f"{where}: parents {unknown}, which are no entries")
        if not all(0 < share <= 1 for share in shares.values()) or sum(shares.values()) > 1 + 1e-9:
            raise ValueError(f"{where}: {shares} are no probabilities")
    for one, others in level.adjacent.items():
        if not {one, *others} <= set(level.entries) or not all(0 < value <= 1 for value in others.values()):
            raise ValueError(f"{where}: adjacency of {one!r} is not of its entries, or not in (0, 1]")


def _check_region(entry: RegionEntry, environment: Environment, where: str) -> None:
    if entry.existence <= 0 or not entry.phrases or not entry.objects:
        raise ValueError(f"{where}, region {entry.name!r}: needs existence > 0, phrases and objects")
    connects = [] if entry.connects is None else [entry.connects]
    for value in (*entry.objects.values(), *entry.adjacent.values(), *connects):
        if not 0 < value <= 1:
            raise ValueError(f"{where}, region {entry.name!r}: {value} is not a probability in (0, 1]")
    for other, value in entry.adjacent.items():
        if other == entry.name or other not in {region.name for region in environment.regions}:
            raise ValueError(f"{where}, region {entry.name!r}: adjacent to {other!r}, which is no other region")
        if environment.region(other).adjacent.get(entry.name, value) != value:
            raise ValueError(f"{where}: {entry.name!r} and {other!r} disagree about their adjacency")
