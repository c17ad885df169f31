"""Tasks and prior graphs (paper, Prior Graph Extraction)."""

import hashlib
from typing import Annotated

import msgspec
import numpy as np

from schemas.codec import Message, Shape, encode

SUM_TOLERANCE = 1e-3


class Task(Message, frozen=True, kw_only=True):
    """What a robot is to do, and where. `regions` fixes the vocabulary; empty lets the prior choose it."""

    robot: str
    stamp_ns: int
    environment: str
    task: str
    regions: list[str] = []


class TaskRequest(Message, frozen=True, kw_only=True):
    """Which task is in force for a robot? For whoever was not there when it was given."""

    robot: str


class TaskInForce(Message, frozen=True, kw_only=True):
    """The newest task of a robot; None before the first."""

    robot: str
    task: Task | None = None


class RegionPrior(msgspec.Struct, frozen=True, kw_only=True):
    """One expected region with its prototypical place: appearance phrases, inclination to the horizontal, size."""

    name: str
    phrases: list[str]
    existence: float  # P(r | E0), sums to one over the regions
    inclination_mean_rad: float = 0.0
    inclination_std_rad: float = 0.2
    query_radius_m: float = 0.75  # r_Q
    parent: str = ""


class ObjectPrior(msgspec.Struct, frozen=True, kw_only=True):
    """One expected object."""

    name: str
    phrases: list[str]


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Who made a prior, from what."""

    source: str  # library, or the model's name
    detail: str = ""
    parent_digest: str = ""
    note: str = ""  # for example: fell back to the library, and why


class Prior(Message, frozen=True, kw_only=True):
    """Prior graph for one environment and task: complete and validated."""

    environment: str
    task: str
    vocabulary: list[str] = []  # the task's fixed regions, when it fixed them
    regions: list[RegionPrior]
    objects: list[ObjectPrior]
    containment: Annotated[np.ndarray, Shape("float32", "region", "object")]  # P(o | r, E0)
    adjacency: Annotated[np.ndarray, Shape("float32", "region", "region")]  # P(ri <-> rj | E0), symmetric, in (0, 1]
    provenance: Provenance

    def check(self) -> None:
        names = [region.name for region in self.regions]
        if not names:
            raise ValueError("a prior needs at least one region")
        for kind, found in (("region", names), ("object", [item.name for item in self.objects])):
            if len(set(found)) != len(found):
                raise ValueError(f"{kind} names are not unique")
        if self.containment.shape != (len(names), len(self.objects)):
            raise ValueError("containment does not fit the regions and objects")
        if self.adjacency.shape[0] != len(names):
            raise ValueError("adjacency does not fit the regions")
        if (self.containment < 0).any() or (self.containment > 1).any():
            raise ValueError("containment is not a probability")
        if (self.adjacency <= 0).any() or (self.adjacency > 1).any():
            raise ValueError("adjacency must be in (0, 1]")
        if not np.allclose(self.adjacency, self.adjacency.T, atol=1e-6):
            raise ValueError("adjacency is not symmetric")
        existence = [region.existence for region in self.regions]
        if min(existence) <= 0 or abs(sum(existence) - 1) > SUM_TOLERANCE:
            raise ValueError("existence must be positive and sum to one")
        described = [(r.name, r.phrases) for r in self.regions] + [(o.name, o.phrases) for o in self.objects]
        for name, phrases in described:
            if not name or not phrases:
                raise ValueError(f"{name or 'an unnamed entry'} has no phrases")

    def digest(self) -> str:
        """Content address, 128 bit in hexadecimal."""
        return hashlib.blake2b(encode(self), digest_size=16).hexdigest()

    def answers(self, task: Task) -> bool:
        """Whether this prior was made for that task."""
        return (self.environment, self.task, self.vocabulary) == (task.environment, task.task, task.regions)


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
