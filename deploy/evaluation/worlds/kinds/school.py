"""Schools: classrooms along a corridor, a canteen open to the entrance, a library and a high gymnasium."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, picked
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan
from prior_sg.deploy.evaluation.worlds.wings import Wing, front_and_wing

FURTHER = ("office", "staff room", "restroom", "laboratory", "storage room", "restroom")
WIDTHS_M = {"restroom": 3.2, "office": 3.6, "storage room": 3.0, "staff room": 4.5, "library": 8.5}


def school(rng: np.random.Generator) -> Plan:
    """One floor with four to seven classrooms."""
    plan, level = Plan(rng, "school"), Level(0.0, between(rng, 2.9, 3.4))
    rooms = ["classroom"] * int(rng.integers(3, 6)) + ["library", *picked(rng, FURTHER, int(rng.integers(2, 5)))]
    rooms = [rooms[i] for i in rng.permutation(len(rooms))]
    half = len(rooms) // 2
    wing = Wing(
        rooms[:half],
        rooms[half:],
        WIDTHS_M,
        7.6,
        (6.2, 7.4),
        (2.6, 3.4),
        frozenset({"library"} if rng.random() < 0.3 else ()),
    )
    front = ["entrance", "cafeteria"] if rng.random() < 0.5 else ["cafeteria", "entrance"]
    corridor, shell = front_and_wing(plan, front, wing, level)
    for room in plan.rooms:
        plan.window(room, shell)
    if rng.random() < 0.75:
        end, width, depth = corridor.bounds, between(rng, 10, 14), between(rng, 12, 16)
        high, south = Level(0.0, between(rng, 4.8, 6.0)), end.y0 - between(rng, 1, 8)
        hall = Rect(end.x1, south, end.x1 + width, south + depth)
        plan.storey(hall, high)
        plan.door(corridor, plan.room("gymnasium", hall, high), 1.6)
    furnished(plan)
    return plan
