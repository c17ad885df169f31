"""Hospitals: patient rooms and treatment along corridors, nurse stations open to them, reception in front."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, picked
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan
from prior_sg.deploy.evaluation.worlds.wings import Wing, crossing, front_and_wing

WARD = ["patient room"] * 4
TREATMENT = (
    "examination room", "operating room", "supply room", "restroom", "pharmacy", "laboratory", "office",
    "imaging room", "intensive care unit", "emergency room", "examination room",
)  # fmt: skip
OPEN = frozenset({"nurse station"})
WIDTHS_M = {"restroom": 2.8, "supply room": 3.0, "office": 3.4, "operating room": 5.6, "intensive care unit": 7.5,
            "emergency room": 7.0, "nurse station": 4.0, "imaging room": 5.0}  # fmt: skip


def hospital(rng: np.random.Generator) -> Plan:
    """One floor with ten to twenty-five rooms."""
    plan, level = Plan(rng, "hospital"), Level(0.0, between(rng, 2.6, 3.0))
    front = ["reception", "waiting area"] if rng.random() < 0.5 else ["waiting area", "reception"]
    corridor, shell = front_and_wing(plan, front, _wing(rng, int(rng.integers(1, 4))), level)
    shells = [shell]
    if rng.random() < 0.5:
        shells.append(crossing(plan, corridor, _wing(rng, int(rng.integers(0, 2))), level))
    for room in plan.rooms:
        for outer in shells:
            plan.window(room, outer, 0.5)
    furnished(plan)
    return plan


def _wing(rng: np.random.Generator, more: int) -> Wing:
    south = [*WARD[: int(rng.integers(2, 5))], "nurse station", *picked(rng, TREATMENT, more)]
    north = [*WARD[: int(rng.integers(1, 4))], *picked(rng, TREATMENT, 2 + more)]
    sides = [[side[i] for i in rng.permutation(len(side))] for side in (south, north)]
    return Wing(sides[0], sides[1], WIDTHS_M, 4.2, (4.4, 6.2), (2.2, 2.9), OPEN)
