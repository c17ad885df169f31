"""Masks of Nav2's costmap filters by the labels of regions: where not to drive, and where to drive slowly (pure).

Keepout (type 0, base 0, multiplier 1): a cell of 100 is lethal; -1 says nothing, while 0 would make free what the costmap
does not know. Speed in percent (type 1, base 0, multiplier 1): a cell is the limit; 0 is none, and -1 an error to Nav2.
Outside a mask the last limit stays, so that masks reach MARGIN_M beyond the map.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from prior_sg.deploy.ros import messages
from prior_sg.deploy.ros.grids import UNKNOWN, Ground
from prior_sg.deploy.ros.messages import Classes
from prior_sg.schemas.names import fault_of_name, normal, same
from prior_sg.schemas.regions import Region

INFO = "nav2_msgs/msg/CostmapFilterInfo"
INFO_TEXT = "std_msgs/Header header\nuint8 type\nstring filter_mask_topic\nfloat32 base\nfloat32 multiplier\n"
Filter = Literal["keepout", "speed"]
TYPES: dict[Filter, int] = {"keepout": 0, "speed": 1}
LETHAL, NO_LIMIT = 100, 0
MARGIN_M = 5.0
FORM = "write LABEL=keepout or LABEL=slow:PERCENT, such as 'ward=slow:50'"


@dataclass(frozen=True)
class Rule:
    """What holds in regions of a label; `value` is what a cell of them has."""

    label: str
    filter: Filter
    value: int


def rule_of(written: str) -> Rule:
    """A rule as an option. Raises ValueError with one sentence."""
    label, is_there, what = written.rpartition("=")
    label, what = normal(label), what.strip()
    if not is_there:
        raise ValueError(f"{written[:60]!r} is no mask: {FORM}")
    if fault := fault_of_name("a mask's label", label):
        raise ValueError(fault)
    if what == "keepout":
        return Rule(label, "keepout", LETHAL)
    kind, _, percent = what.partition(":")
    if kind != "slow" or not (percent.isascii() and percent.isdigit() and 1 <= int(percent) <= 100):
        raise ValueError(f"{written[:60]!r} is no mask: {FORM}, of 1 to 100 percent of the full speed")
    return Rule(label, "speed", int(percent))


def check_rules(rules: Iterable[Rule]) -> tuple[Rule, ...]:
    """The rules, unchanged. Raises ValueError where two say different things of one label."""
    said: dict[tuple[str, Filter], Rule] = {}
    for rule in rules:
        key = (same(rule.label), rule.filter)
        if said.setdefault(key, rule) != rule:
            raise ValueError(f"two masks say how slowly to drive in {rule.label!r}: give one of them")
    return tuple(said.values())


def mask_cells(ground: Ground, regions: Sequence[Region], rules: Iterable[Rule], of: Filter) -> np.ndarray:
    """The mask of one filter (int8): regions with a rule's label, also predicted ones, and all else unsaid."""
    cells = np.full(ground.owners.shape, UNKNOWN if of == "keepout" else NO_LIMIT, np.int8)
    values = {same(rule.label): rule.value for rule in rules if rule.filter == of}
    for region in regions:
        if (value := values.get(same(region.label))) is not None:
            cells[ground.owners == region.id] = value
    return cells


def filter_info(classes: Classes, of: Filter, mask_topic: str, frame: str) -> Any:
    """What Nav2 has to know of a mask."""
    return classes[INFO](messages.header(classes, frame), TYPES[of], mask_topic, 0.0, 1.0)


def without_region(rules: Iterable[Rule], regions: Sequence[Region]) -> list[str]:
    """Labels of rules that no region carries at present."""
    there = {same(region.label) for region in regions}
    return sorted({rule.label for rule in rules if same(rule.label) not in there})
