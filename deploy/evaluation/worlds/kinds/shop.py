"""Shops: one hall divided by its shelves, checkout and entrance in front, storage behind a wall."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, meet, picked, row, shelving
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan

SHELVED = {"grocery aisle": ("grocery shelf", 1.9), "beverage aisle": ("grocery shelf", 1.6),
           "household aisle": ("grocery shelf", 2.0), "dairy aisle": ("display refrigerator", 2.0),
           "frozen food section": ("chest freezer", 0.9), "book section": ("bookshelf", 1.8)}  # fmt: skip
FRONT = ("promotion area", "cafe", "bakery", "produce section")
BACK = ("deli counter", "bakery", "produce section")


def shop(rng: np.random.Generator) -> Plan:
    """A supermarket or, one time in three, a bookshop."""
    if rng.random() < 1 / 3:
        return _built(Plan(rng, "bookshop"), *_bookshop(rng))
    return _built(Plan(rng, "supermarket"), *_supermarket(rng))


def _supermarket(rng: np.random.Generator) -> tuple[list[str], list[list[str]], list[str]]:
    shelved = picked(rng, [label for label in SHELVED if label != "book section"], int(rng.integers(3, 6)))
    extra = picked(rng, FRONT, 1)
    back = picked(rng, [label for label in BACK if label not in extra], int(rng.integers(1, 3)))
    half = len(shelved) // 2
    rows = [shelved] if len(shelved) < 4 or rng.random() < 0.5 else [shelved[:half], shelved[half:]]
    return (
        ["entrance", "checkout", *extra],
        rows,
        [*back, "storage room", *picked(rng, ["staff room"], int(rng.integers(2)))],
    )


def _bookshop(rng: np.random.Generator) -> tuple[list[str], list[list[str]], list[str]]:
    middle = [["book section", "reading area"], ["seating area", "book section"]][int(rng.integers(2))]
    return ["entrance", "checkout counter"], [middle], [*picked(rng, ["cafe", "book section"], 1), "storage room"]


def _built(plan: Plan, front: list[str], middle: list[list[str]], back: list[str]) -> Plan:
    rng, level = plan.rng, Level(0.0, between(plan.rng, 3.0, 4.2))
    depths = [between(rng, 4.0, 5.5), *(between(rng, 6.0, 9.0) for _ in middle), between(rng, 4.0, 5.5)]
    width = between(rng, 5.2, 6.4) * max(len(front), 3, *(len(some) for some in middle))
    shell = Rect(0, 0, round(width, 1), round(sum(depths), 1))
    plan.storey(shell, level)
    closed = {"storage room", "staff room"}
    for rect, labels in zip(shell.cut_y(depths), [front, *middle, back], strict=True):
        order = [(labels[i], 1.0) for i in rng.permutation(len(labels)).tolist()]
        row(plan, rect, order, level, {label for label in labels if label not in closed})
    zones = [room for room in plan.rooms if room.walled is False]
    meet(plan, zones)
    for room in (room for room in plan.rooms if room.walled):
        beside = [zone for zone in zones if any(edge.length >= 1.6 for edge in plan.edges(zone, room))]
        plan.door(beside[int(rng.integers(len(beside)))], room, 1.0)
    for room in plan.rooms:
        if room.label in SHELVED:
            shelving(plan, room, *SHELVED[room.label], way_m=between(rng, 1.3, 1.8))
    plan.window(next(room for room in plan.rooms if room.label == "entrance"), shell)
    furnished(plan, *(room for room in plan.rooms if room.label not in SHELVED))
    return plan
