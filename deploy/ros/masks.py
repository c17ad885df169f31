"""Masks of Nav2's costmap filters by the labels of regions: where not to drive, and where to drive slowly (pure).

Keepout (type 0, base 0, multiplier 1): a cell of 100 is lethal; -1 says nothing, while 0 would make free what the
costmap does not know. Speed in percent (type 1, base 0, multiplier 1): a cell is the limit; 0 is none, and -1 an error.
Outside a mask the last limit stays, so that masks reach MARGIN_M beyond the map.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from prior_sg.deploy.ros import messages
from prior_sg.deploy.ros.grids import UNKNOWN, Ground, with_values
from prior_sg.deploy.ros.messages import Classes
from prior_sg.deploy.ros.rules import NO_LIMIT, Filter, Rule
from prior_sg.schemas.names import same
from prior_sg.schemas.regions import Region

INFO = "nav2_msgs/msg/CostmapFilterInfo"
INFO_TEXT = "std_msgs/Header header\nuint8 type\nstring filter_mask_topic\nfloat32 base\nfloat32 multiplier\n"
TYPES: dict[Filter, int] = {"keepout": 0, "speed": 1}
MARGIN_M = 5.0


def mask_cells(ground: Ground, regions: Sequence[Region], rules: Iterable[Rule], of: Filter) -> np.ndarray:
    """The mask of one filter (int8): regions with a rule's label, also predicted ones, and all else unsaid."""
    by_label = {same(rule.label): rule.value for rule in rules if rule.filter == of}
    values = {region.id: by_label[same(region.label)] for region in regions if same(region.label) in by_label}
    unsaid = np.full(ground.owners.shape, UNKNOWN if of == "keepout" else NO_LIMIT, np.int8)
    return with_values(ground, values, unsaid)


def filter_info(classes: Classes, of: Filter, mask_topic: str, frame: str) -> Any:
    """What Nav2 has to know of a mask."""
    return classes[INFO](messages.header(classes, frame), TYPES[of], mask_topic, 0.0, 1.0)


def without_region(rules: Iterable[Rule], regions: Sequence[Region]) -> list[str]:
    """Labels of rules that no region carries at present."""
    there = {same(region.label) for region in regions}
    return sorted({rule.label for rule in rules if same(rule.label) not in there})
