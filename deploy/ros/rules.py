"""What holds in regions of a label, as options say it, and how a scene is shown (pure; nothing heavy is imported)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from prior_sg.schemas.names import fault_of_name, normal, same

Filter = Literal["keepout", "speed"]
LETHAL, NO_LIMIT = 100, 0
FORM = "write LABEL=keepout or LABEL=slow:PERCENT, such as 'ward=slow:50'"
FINEST_CELL_M, COARSEST_CELL_M, USUAL_CELL_M = 0.02, 1.0, 0.05


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


@dataclass(frozen=True)
class Look:
    """How a scene is shown."""

    node: str = "prior_sg"
    frame: str = "map"
    cell_m: float = USUAL_CELL_M
    heights_m: tuple[float, float] = (float("-inf"), float("inf"))  # of places on the grids and masks
    rules: tuple[Rule, ...] = ()

    def topic(self, name: str) -> str:
        """The full name of one of the node's topics."""
        return f"/{self.node}/{name}"

    def filters(self) -> tuple[Filter, ...]:
        """Filters that any rule is of."""
        return tuple(sorted({rule.filter for rule in self.rules}))


USUAL_LOOK = Look()
