"""Tasks and prior graphs (paper, Prior Graph Extraction)."""

import hashlib
import math
from typing import Annotated, Literal

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Shape, Stamp, encode
from prior_sg.schemas.levels import LevelPrior, check_levels, zones_of
from prior_sg.schemas.names import fault_of_names, fault_of_text, key_part

SUM_TOLERANCE = 1e-3
# No prior that somebody means is larger; a message beyond is refused wherever it arrives.
MOST_REGIONS, MOST_OBJECTS, MOST_PHRASES = 64, 512, 64
MOST_PIECES = 256  # regions of one map that evidence tells of
LONGEST_PHRASE = 240
LEAST_STD_RAD = 1e-6  # of an inclination: the concentration of what is sharper is beyond numbers
LARGEST_M, MOST_SPREAD = 1000.0, 2.0  # of an object's sides, and of their logarithm


class Task(Message, frozen=True, kw_only=True):
    """What a robot is to do, and where. `regions` fixes the vocabulary; empty lets the prior choose it."""

    robot: str
    stamp_ns: Stamp
    environment: str
    task: str
    regions: list[str] = []

    def fault(self) -> str:
        """Why nobody can answer this task, as a sentence; empty when nothing speaks against it."""
        return fault_of_task(self.environment, self.task, self.regions)


def fault_of_task(environment: str, task: str, regions: list[str]) -> str:
    """What is wrong with what is asked, as a sentence; empty when nothing is."""
    return (
        fault_of_text("the environment", environment)
        or fault_of_text("the task", task)
        or fault_of_names("region", regions, MOST_REGIONS)
    )


class TaskRequest(Message, frozen=True, kw_only=True):
    """Which task is in force for a robot? For whoever was not there when it was given."""

    robot: str


class TaskInForce(Message, frozen=True, kw_only=True):
    """The newest task of a robot; None before the first."""

    robot: str
    task: Task | None = None


class RegionPrior(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One expected region with its prototypical place: appearance phrases, inclination to the horizontal, size."""

    name: str
    phrases: list[str]
    existence: float  # P(r | E0), sums to one over the regions
    inclination_mean_rad: float = 0.0
    inclination_std_rad: float = 0.2
    query_radius_m: float = 0.75  # r_Q
    parent: str = ""  # its zone for sure, where the prior has no `levels`


class ObjectPrior(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One expected object; what size it usually is, where the prior says so."""

    name: str
    phrases: list[str]
    size_m: tuple[float, float, float] | None = None  # longest and shortest horizontal side, height; medians
    size_spread: float = 0.35  # standard deviation of a side's logarithm
    bottom_m: float | None = None  # height of its lower edge above the floor: 0 = it stands there


class Provenance(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Who made a prior, from what, when."""

    source: str  # library, or the model's name
    detail: str = ""
    parent_digest: str = ""
    note: str = ""  # for example: fell back to the library, and why
    question: str = ""  # digest of what was asked of whom; empty where the library answered
    prompts: str = ""  # version of the prompts
    samples: int = 0  # generations averaged
    made_by: str = ""  # instance of the gateway
    made_ns: int = 0
    signer: str = ""  # name of the key; empty = not signed
    signature: str = ""  # Ed25519 over the prior's digest, in hexadecimal
    root_digest: str = ""  # of a revised prior: what it was before any revision
    contributors: list[str] = []  # robots whose maps revised it


class Spread(Message, frozen=True, kw_only=True):
    """Standard deviations over the samples that a prior is the mean of."""

    existence: Annotated[np.ndarray, Shape("float32", "region")]
    containment: Annotated[np.ndarray, Shape("float32", "region", "object")]
    adjacency: Annotated[np.ndarray, Shape("float32", "region", "region")]
    support: Annotated[np.ndarray, Shape("float32", "region")]  # share of the samples that named the region

    def check(self) -> None:
        if min(array.min(initial=0) for array in (self.existence, self.containment, self.adjacency, self.support)) < 0:
            raise ValueError("spread is negative")


class Counts(Message, frozen=True, kw_only=True, omit_defaults=True):
    """What a prior's containment was counted in, and what looks turned out to be worth beside it."""

    regions: Annotated[np.ndarray, Shape("float32", "region")]  # observed ones of each name, as far as they are that
    looks: float | None = None  # share of its face value that a look is worth beside contents; None = nobody knows

    def check(self) -> None:
        if self.regions.min(initial=0) < 0:
            raise ValueError("a count is negative")
        if self.looks is not None and not 0 < self.looks <= 1:
            raise ValueError("what looks are worth must lie between 0 and 1")


class Prior(Message, frozen=True, kw_only=True, omit_defaults=True):
    """Prior graph for one environment and task: complete and validated.

    Fields left at their defaults are not written, so that a field added later changes no digest.
    """

    environment: str
    task: str
    vocabulary: list[str] = []  # the task's fixed regions, when it fixed them
    regions: list[RegionPrior]
    objects: list[ObjectPrior]
    containment: Annotated[np.ndarray, Shape("float32", "region", "object")]  # P(o | r, E0)
    adjacency: Annotated[np.ndarray, Shape("float32", "region", "region")]  # P(ri <-> rj | E0), symmetric, in (0, 1]
    provenance: Provenance
    spread: Spread | None = None
    levels: list[LevelPrior] = []  # above the regions, from below; where there are some, no region's `parent` counts
    tested: Counts | None = None  # where robots have revised it

    def check(self) -> None:
        """Whoever sent it: a model, a file or another robot."""
        self._check_names()
        self._check_matrices()
        for region in self.regions:
            _check_region(region)
        for item in self.objects:
            _check_object(item)
        existence = [region.existence for region in self.regions]
        if abs(sum(existence) - 1) > SUM_TOLERANCE:
            raise ValueError("existence must be positive and sum to one")
        check_levels(self.levels, len(self.regions))

    def _check_names(self) -> None:
        if not self.regions:
            raise ValueError("a prior needs at least one region")
        if len(self.regions) > MOST_REGIONS or len(self.objects) > MOST_OBJECTS:
            raise ValueError(f"a prior has at most {MOST_REGIONS} regions and {MOST_OBJECTS} objects")
        if fault := fault_of_task(self.environment, self.task, self.vocabulary):
            raise ValueError(fault)
        described = [(r.name, r.phrases) for r in self.regions] + [(o.name, o.phrases) for o in self.objects]
        for kind, names in (("region", [r.name for r in self.regions]), ("object", [o.name for o in self.objects])):
            if fault := fault_of_names(kind, names, MOST_OBJECTS):
                raise ValueError(fault)
        for name, phrases in described:
            if not all(phrases) or not 0 < len(phrases) <= MOST_PHRASES:
                raise ValueError(f"{name} has no phrases, an empty one or more than {MOST_PHRASES}")
            if fault := next(filter(None, (fault_of_text("the phrase", one, LONGEST_PHRASE) for one in phrases)), ""):
                raise ValueError(f"{name}: {fault}")
        if fault := next(filter(None, (fault_of_text("the zone", region.parent) for region in self.regions)), ""):
            raise ValueError(fault)

    def _check_matrices(self) -> None:
        if self.containment.shape != (len(self.regions), len(self.objects)):
            raise ValueError("containment does not fit the regions and objects")
        if self.adjacency.shape[0] != len(self.regions):
            raise ValueError("adjacency does not fit the regions")
        if (self.containment < 0).any() or (self.containment > 1).any():
            raise ValueError("containment is not a probability")
        if (self.adjacency <= 0).any() or (self.adjacency > 1).any():
            raise ValueError("adjacency must be in (0, 1]")
        if not np.allclose(self.adjacency, self.adjacency.T, atol=1e-6):
            raise ValueError("adjacency is not symmetric")
        if self.spread is not None and self.spread.containment.shape != self.containment.shape:
            raise ValueError("the spread does not fit the regions and objects")
        if self.tested is not None and len(self.tested.regions) != len(self.regions):
            raise ValueError("what was tested does not fit the regions")

    @property
    def levels_above(self) -> list[LevelPrior]:
        """The levels above the regions, whichever way the prior says them."""
        if self.levels:
            return self.levels
        parents, existence = ([getattr(r, name) for r in self.regions] for name in ("parent", "existence"))
        zones = zones_of(parents, existence, self.adjacency)
        return [] if zones is None else [zones]

    @property
    def zones(self) -> list[str]:
        """The zone (region,) that each region is most likely in; empty where the prior names none for it."""
        if not self.levels:
            return [region.parent for region in self.regions]
        level = self.levels[0]
        return [level.names[column] for column in level.parents.argmax(axis=1).tolist()]

    def digest(self) -> str:
        """Content address, 128 bit in hexadecimal; of everything but the signature, which signs it."""
        return hashlib.blake2b(encode(self.unsigned()), digest_size=16).hexdigest()

    def unsigned(self) -> "Prior":
        """The same without its signature."""
        bare = msgspec.structs.replace(self.provenance, signer="", signature="")
        return msgspec.structs.replace(self, provenance=bare)

    def answers(self, task: Task) -> bool:
        """Whether this prior was made for that task."""
        return (self.environment, self.task, self.vocabulary) == (task.environment, task.task, task.regions)


def _check_region(region: RegionPrior) -> None:
    numbers = (region.existence, region.inclination_mean_rad, region.inclination_std_rad, region.query_radius_m)
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{region.name}: not finite")
    if region.existence <= 0:
        raise ValueError("existence must be positive and sum to one")
    if not (0 <= region.inclination_mean_rad <= math.pi / 2 and region.inclination_std_rad >= LEAST_STD_RAD):
        raise ValueError(f"{region.name}: inclination must lie between 0 and a right angle, its spread well above 0")
    if not 0 < region.query_radius_m <= 100:
        raise ValueError(f"{region.name}: the query radius must lie between 0 and 100 m")


def _check_object(item: ObjectPrior) -> None:
    if item.size_m is not None:
        longest, shortest, height = item.size_m
        if not 0 < shortest <= longest <= LARGEST_M or not 0 < height <= LARGEST_M:
            raise ValueError(
                f"{item.name}: sides must lie between 0 and {LARGEST_M:g} m, the longest horizontal one first"
            )
    if not 0 < item.size_spread <= MOST_SPREAD:
        raise ValueError(f"{item.name}: the spread of its size must lie between 0 and {MOST_SPREAD:g}")
    if item.bottom_m is not None and not 0 <= item.bottom_m <= LARGEST_M:
        raise ValueError(f"{item.name}: its lower edge must lie between 0 and {LARGEST_M:g} m above the floor")


class PriorRequest(Message, frozen=True, kw_only=True):
    """Ask for a prior by digest, or (digest empty) for an environment and task."""

    digest: str = ""
    environment: str = ""
    task: str = ""
    regions: list[str] = []


class PriorList(Message, frozen=True, kw_only=True):
    """Priors that answer a request, best first; `reason` says why there is none."""

    priors: list[Prior]
    reason: str = ""
    pending: bool = False  # somebody is at work on it: ask again


class PriorClaim(Message, frozen=True, kw_only=True):
    """A gateway wants to ask a model, or is asking; while it goes on saying so, the others wait."""

    question: str
    holder: str
    state: Literal["wants", "works", "gave up"]

    def check(self) -> None:
        key_part(self.question)


_NO_PIECES = msgspec.field(default_factory=lambda: np.zeros(0, np.float32))
_NO_TABLE = msgspec.field(default_factory=lambda: np.zeros((0, 0), np.float32))
_NO_LINKS = msgspec.field(default_factory=lambda: np.zeros((0, 2), np.int32))


class PriorEvidence(Message, frozen=True, kw_only=True):
    """What one map has shown of its prior so far: totals, not increments, so that only a map's newest one counts."""

    robot: str
    epoch: NumberOrNone  # of the map
    stamp_ns: Stamp
    prior_digest: str  # in force when it was seen
    environment: str
    task: str
    vocabulary: list[str] = []
    regions: list[str]
    objects: list[str] = []  # empty = no objects were looked for
    places: Annotated[np.ndarray, Shape("float32", "region")]  # sum of beliefs
    instances: Annotated[np.ndarray, Shape("float32", "region")]  # regions of that name
    holding: Annotated[np.ndarray, Shape("float32", "region", "object")]  # of those, how many hold the object
    pairs: Annotated[np.ndarray, Shape("float32", "region", "region")]  # pairs of regions with these two names
    touching: Annotated[np.ndarray, Shape("float32", "region", "region")]  # of those, how many touch
    # Region by region of the map, what was seen apart from the labels, in which the prior had a say; none from senders
    # of an older version. The columns are those of `regions` and `objects`.
    sizes: Annotated[np.ndarray, Shape("float32", "piece")] = _NO_PIECES  # places
    looks: Annotated[np.ndarray, Shape("float32", "piece", "look")] = _NO_TABLE  # mean log P(region | its crops), <= 0
    contents: Annotated[np.ndarray, Shape("float32", "piece", "content")] = _NO_TABLE  # P(it holds the object)
    links: Annotated[np.ndarray, Shape("int32", "link", 2)] = _NO_LINKS  # pieces that touch

    def check(self) -> None:
        if len(self.regions) != len(self.places) or len(self.objects) != self.holding.shape[1]:
            raise ValueError("counts do not fit the names")
        if min(array.min(initial=0) for array in (self.places, self.instances, self.holding, self.touching)) < 0:
            raise ValueError("a count is negative")
        if (self.holding > self.instances[:, None] + 1e-4).any() or (self.touching > self.pairs + 1e-4).any():
            raise ValueError("more hits than trials")
        if len(self.sizes):
            self._check_pieces()

    def _check_pieces(self) -> None:
        if len(self.sizes) > MOST_PIECES:
            raise ValueError(f"a map tells of at most {MOST_PIECES} regions")
        if self.looks.shape[1] != len(self.regions) or self.contents.shape[1] != len(self.objects):
            raise ValueError("pieces do not fit the names")
        if self.sizes.min() <= 0 or self.looks.max(initial=0) > 0:
            raise ValueError("a piece has no places, or a look is no logarithm of a probability")
        if self.contents.min(initial=0) < 0 or self.contents.max(initial=0) > 1:
            raise ValueError("contents are no probabilities")
        if self.links.min(initial=0) < 0 or self.links.max(initial=-1) >= len(self.sizes):
            raise ValueError("a link leads to no piece")


class PriorRevision(Message, frozen=True, kw_only=True):
    """Please revise the prior of this task from what has been observed, and publish the result."""

    environment: str
    task: str
    regions: list[str] = []
    by_model: bool = False  # show the model what was observed against what was expected, instead of counting


class ModelRequest(Message, frozen=True, kw_only=True):
    """One turn of a conversation with a language model. `schema` (JSON) constrains the answer; empty = plain text."""

    conversation: str
    turn: Number
    messages: list[tuple[str, str]]  # (role, text); roles are system, user, assistant
    schema: str = ""
    schema_name: str = "answer"
    max_tokens: Number = 4096


class ModelReply(Message, frozen=True, kw_only=True):
    """What the model said, or why it said nothing."""

    conversation: str
    turn: Number
    text: str = ""
    failure: str = ""  # one word of the kind
    reason: str = ""  # one sentence
    attempts: Number = 1
    tokens_in: Number = 0
    tokens_out: Number = 0


class Recall(Message, frozen=True, kw_only=True):
    """What does the archive know of this task?"""

    question: str
    environment: str
    task: str
    regions: list[str] = []


class Recalled(Message, frozen=True, kw_only=True):
    """The kept prior that answers a task from now on (imported or revised), the one that answers the very question,
    the newest of all others, what a revised prior was before, and the evidence gathered."""

    question: str
    preferred: Prior | None = None
    exact: Prior | None = None
    newest: Prior | None = None
    root: Prior | None = None
    evidence: list[PriorEvidence] = []


class Keep(Message, frozen=True, kw_only=True):
    """Keep a prior or a piece of evidence; `own` dates and signs a prior that was made here, the signature of any other
    is checked."""

    prior: Prior | None = None
    root: Prior | None = None  # the unrevised ancestor of a revised prior
    preferred: bool = False  # it answers its task from now on, whatever provider is configured
    own: bool = False
    question: str = ""  # that it answers
    evidence: PriorEvidence | None = None


class Kept(Message, frozen=True, kw_only=True):
    """Done: the prior as it is from now on, and what its signature says; no prior = it is not trusted."""

    prior: Prior | None = None
    question: str = ""
    verdict: str = ""
