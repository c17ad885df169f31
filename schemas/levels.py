"""Levels above regions: what a prior says of them, and their nodes as found.

Regions are members of zones, zones of floors, floors of buildings, buildings of districts. Floors and buildings are
found in any map; zones and districts only where the prior names some. The members of a node are of the next level below
that is there.
"""

import math
from collections.abc import Iterable
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Part, Shape
from prior_sg.schemas.names import LONGEST_NAME, fault_of_names, fault_of_text

LevelName = Literal["zone", "floor", "building", "district"]
NamedLevel = Literal["zone", "building", "district"]  # by a prior; floors are found from the geometry
LEVELS: tuple[LevelName, ...] = get_args(LevelName)  # from below
MOST_ENTRIES = 64
NO_NODE = -1
SURE = 0.95  # of what a prior says without a number; no statement about a map is certain
SUM_TOLERANCE = 1e-3


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of node that a level may have."""

    name: str
    existence: float  # P(entry | E0), sums to one over the level


class LevelPrior(Message, frozen=True, kw_only=True, omit_defaults=True):
    """One level above the regions; its children are the entries of the level before it in the prior, or the regions."""

    name: NamedLevel
    task: str = ""  # whose words its entries are, such as "which ward?"
    entries: list[Entry]
    parents: Annotated[np.ndarray, Shape("float32", "child", "entry")]  # P(entry | child), rows sum to one
    adjacency: Annotated[np.ndarray, Shape("float32", "entry", "entry")]  # P(ei <-> ej | E0), symmetric, in (0, 1]

    @property
    def names(self) -> list[str]:
        """Names of the entries."""
        return [entry.name for entry in self.entries]

    def check(self) -> None:
        """Whoever sent it."""
        where, names = f"level {self.name}", self.names
        if not names:
            raise ValueError(f"{where}: needs at least one entry")
        if fault := fault_of_names("entry", names, MOST_ENTRIES) or fault_of_text("the task", self.task):
            raise ValueError(f"{where}: {fault}")
        existence = [entry.existence for entry in self.entries]
        if not all(map(math.isfinite, existence)) or min(existence) <= 0 or abs(sum(existence) - 1) > SUM_TOLERANCE:
            raise ValueError(f"{where}: existence must be positive and sum to one")
        if self.parents.shape[1] != len(names) or self.adjacency.shape[0] != len(names):
            raise ValueError(f"{where}: a matrix does not fit the entries")
        if (self.parents < 0).any() or (np.abs(self.parents.sum(axis=1) - 1) > SUM_TOLERANCE).any():
            raise ValueError(f"{where}: the parents of a child are no distribution")
        if (self.adjacency <= 0).any() or (self.adjacency > 1).any():
            raise ValueError(f"{where}: adjacency must be in (0, 1]")
        if not np.allclose(self.adjacency, self.adjacency.T, atol=1e-6):
            raise ValueError(f"{where}: adjacency is not symmetric")


class LevelNode(Part, frozen=True, kw_only=True):
    """One node of a level: a ward, a floor, a building. Its id lasts, and is unique within its level."""

    level: LevelName
    id: int
    label: str  # entry of the prior's level; else "floor 0" for the lowest, "building", "outdoors"
    probability: float  # of the label
    member_ids: list[int]  # ascending
    members: str = "region"  # level of these ids
    area_m2: float = 0.0  # sum over its regions
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # mean of its places, world
    parent_id: int = NO_NODE  # the node of the next level above that holds it


def regions_in(nodes: Iterable[LevelNode], level: LevelName) -> dict[int, int]:
    """Id of the node of `level` by the id of each region in it."""
    held: dict[tuple[str, int], list[int]] = {}  # regions by level and id
    found: dict[int, int] = {}
    for node in sorted(nodes, key=lambda node: LEVELS.index(node.level)):
        regions = node.member_ids
        if node.members != "region":
            regions = [region for member in node.member_ids for region in held.get((node.members, member), ())]
        held[node.level, node.id] = regions
        if node.level == level:
            found.update(dict.fromkeys(regions, node.id))
    return found


def nodes_above(nodes: Iterable[LevelNode]) -> dict[int, list[LevelNode]]:
    """The nodes that hold each region, from below, by the region's id."""
    listed = sorted(nodes, key=rank)
    found: dict[int, list[LevelNode]] = {}
    for level in LEVELS:
        by_id = {node.id: node for node in listed if node.level == level}
        for region, number in regions_in(listed, level).items():
            found.setdefault(region, []).append(by_id[number])
    return found


def rank(node: LevelNode) -> tuple[int, int]:
    """By which nodes are sorted: from below, by id."""
    return LEVELS.index(node.level), node.id


def check_levels(levels: list[LevelPrior], regions: int) -> None:
    """Raise ValueError where the levels of a prior of so many regions do not stand on each other."""
    ranks = [LEVELS.index(level.name) for level in levels]
    if ranks != sorted(set(ranks)):
        raise ValueError(f"levels must come once each, in the order {', '.join(get_args(NamedLevel))}")
    children = regions
    for level in levels:
        if level.parents.shape[0] != children:
            raise ValueError(f"level {level.name}: its parents do not fit the {children} entries below")
        children = len(level.entries)


def zones_of(parents: list[str], existence: list[float], adjacency: np.ndarray) -> LevelPrior | None:
    """The level that regions' `parents` name, one each, empty = none; None where nobody names any.

    Regions without a parent may be in any zone. Two zones touch where any of their regions touch.
    """
    parents = [parent.strip()[:LONGEST_NAME].strip() for parent in parents]
    names = list(dict.fromkeys(filter(None, parents)))
    if not names:
        return None
    rows = []
    for parent in parents:
        rest = (1 - SURE) / max(len(names) - 1, 1)
        sure = 1.0 if len(names) == 1 else SURE
        rows.append([sure if name == parent else rest for name in names] if parent else [1 / len(names)] * len(names))
    matrix = np.array(rows)
    touch = np.eye(len(names))
    for i, one in enumerate(names):
        for j, other in enumerate(names[:i]):
            pairs = adjacency[np.ix_([p == one for p in parents], [p == other for p in parents])]
            touch[i, j] = touch[j, i] = pairs.max()
    share = matrix.T @ (np.array(existence) / sum(existence))
    return LevelPrior(
        name="zone",
        entries=[Entry(name=name, existence=float(value)) for name, value in zip(names, share, strict=True)],
        parents=matrix.astype(np.float32),
        adjacency=touch.astype(np.float32),
    )
