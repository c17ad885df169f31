"""One level aligned with the prior: labels of members by the same field and cuts as places (pure).

The entities of the level below are the field's nodes. With b the belief of a member over the entries below and P of the
prior's level, its unary cost of an entry e is

    -w (log sum_c b(c) P(e | c) - rho log P(e)) - lambda log P(e),    w = 2 area / (area + saturation),

the evidence of what it holds, in the measure that it is large, and what is expected anyhow (the environment expert).
With rho = 1 that is Bayes' rule for members that are independent given their node; members resemble each other, and a
smaller rho keeps rare entries from being found everywhere. Borders cost what they cost between regions, by the level's
own adjacency, times the ways that lead across.
Connected members of one entry are a node, and a node that gains less than `node_cost` becomes part of a neighbour.
"""

from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.schemas.levels import LevelPrior
from prior_sg.services.segmenter.core.energy.mrf import Field
from prior_sg.services.segmenter.core.energy.region_cost import consolidated
from prior_sg.services.segmenter.core.energy.solver import minimise

FLOOR = 1e-4  # least probability in a logarithm


class AlignmentConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How firmly members bind to each other and to what the prior says."""

    saturation_m2: float = 20.0  # area at which a member counts once
    rarity: float = 0.25  # rho
    existence: float = 0.1  # lambda
    border: float = 0.6  # times the cost of a border between regions
    way_m: float = 0.8  # clearance from which on a way counts once; half of it in a usual door
    ways: float = 2.0  # of one border that count at most
    node_cost: float = 1.5  # of each node, in the energy's unit
    temperature: float = 1.0  # of the probabilities

    def __post_init__(self) -> None:
        numbers = (self.rarity, self.existence, self.border, self.ways, self.node_cost)
        if min(numbers) < 0 or min(self.saturation_m2, self.way_m, self.temperature) <= 0:
            raise ValueError("a cost is negative, or saturation_m2, way_m or temperature not positive")


class Members(NamedTuple):
    """The entities of one level."""

    areas_m2: np.ndarray  # (member,)
    beliefs: np.ndarray  # (member, entry below)
    edges: np.ndarray  # (contact, 2) rows, smaller first
    ways: np.ndarray  # (contact,) how wide the ways across are together; 1 = one wide one, 0 = they only stand near


class Aligned(NamedTuple):
    """What the members are under the level's entries."""

    labels: np.ndarray  # (member,) entry
    costs: np.ndarray  # (member, entry) unary


def align(members: Members, level: LevelPrior, pairwise: np.ndarray, cfg: AlignmentConfig) -> Aligned:
    """Labels of the members; `pairwise` (entry, entry) as `aim.border_costs`."""
    costs = unary_costs(members, level, cfg)
    field = Field(costs, members.edges, np.minimum(members.ways, cfg.ways), cfg.border * pairwise)
    labels = minimise(field, costs.argmin(axis=1))
    return Aligned(consolidated(field, labels, cfg.node_cost), costs)


def unary_costs(members: Members, level: LevelPrior, cfg: AlignmentConfig) -> np.ndarray:
    """Cost (member, entry) of each entry, see the module."""
    existence = np.maximum(np.array([entry.existence for entry in level.entries]), FLOOR)
    held = np.maximum(members.beliefs @ level.parents.astype(np.float64), FLOOR)
    weights = 2 * members.areas_m2 / (members.areas_m2 + cfg.saturation_m2)
    evidence = np.log(held) - cfg.rarity * np.log(existence)
    return -weights[:, None] * evidence - cfg.existence * np.log(existence)


def beliefs_of(costs: np.ndarray, groups: np.ndarray, temperature: float) -> np.ndarray:
    """Belief (group, entry) of groups of members, number (member,), from their costs (member, entry) alone."""
    total = np.zeros((int(groups.max(initial=-1)) + 1, costs.shape[1]))
    np.add.at(total, groups, costs)
    likelihoods = np.exp((total.min(axis=1, keepdims=True) - total) / temperature)
    return likelihoods / likelihoods.sum(axis=1, keepdims=True)


def grouped(members: Members, groups: np.ndarray, beliefs: np.ndarray) -> Members:
    """The groups of members, number (member,), as members of the next level."""
    count = int(groups.max(initial=-1)) + 1
    pairs = np.sort(groups[members.edges], axis=1)
    across = pairs[:, 0] != pairs[:, 1]
    keys, inverse = np.unique(pairs[across, 0] * count + pairs[across, 1], return_inverse=True)
    return Members(
        areas_m2=np.bincount(groups, members.areas_m2, minlength=count),
        beliefs=beliefs,
        edges=np.stack(np.divmod(keys, max(count, 1)), axis=1).astype(np.int64),
        ways=np.bincount(inverse, members.ways[across], minlength=len(keys)).astype(np.float64),
    )
