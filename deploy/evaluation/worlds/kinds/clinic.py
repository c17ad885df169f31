"""Clinics: three floors of two departments each, on both sides of one staircase."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.kinds.tower import FLIGHT_M, LANDING_M, STOREY_M, staircase
from prior_sg.deploy.evaluation.worlds.layouts import between, connect, picked, row
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import SLAB_M, WALL_M, Level, Plan, Room

DEPARTMENTS = {  # what each has for sure, and what it may have
    "public area": (("reception", "waiting area"), ("cafeteria", "restroom", "office", "pharmacy")),
    "diagnostics": (("imaging room", "examination room"), ("laboratory", "emergency room", "restroom", "office")),
    "ward": (("patient room", "patient room", "nurse station"), ("patient room", "supply room", "restroom")),
    "surgery": (("operating room", "operating room"), ("intensive care unit", "supply room", "office")),
}
ABOVE = ("ward", "ward", "surgery", "diagnostics")
OPEN = frozenset({"waiting area", "nurse station"})
FLOORS = 3


def clinic(rng: np.random.Generator) -> Plan:
    """Public area and diagnostics below, wards and others above."""
    plan = Plan(rng, "hospital")
    south, north = between(rng, 3.6, 4.6), between(rng, 4.2, 4.8)
    right = 2 * FLIGHT_M + WALL_M
    depth = south + LANDING_M + north
    shells = [Rect(-between(rng, 9, 11), 0, 0, depth), Rect(right, 0, right + between(rng, 9, 11), depth)]
    levels = [Level(STOREY_M * number, STOREY_M - SLAB_M) for number in range(FLOORS)]
    for shell in shells:
        for level in levels:
            plan.storey(shell, level)
    stairs = staircase(plan, south, levels)
    upper = picked(rng, ABOVE, len(ABOVE))
    departments = [*picked(rng, ("public area", "diagnostics"), 2), *upper]
    for number, department in enumerate(departments):
        shell, storey = shells[number % 2], number // 2
        corridor = _department(plan, shell.cut_y([south, LANDING_M, north]), levels[storey], department, number)
        plan.door(corridor, stairs, 0.9)
    stairs.within = {"building": ("building", 0)}
    for room in plan.rooms[1:]:
        for shell in shells:
            plan.window(room, shell, 0.5)
    furnished(plan, *plan.rooms[1:])
    return plan


def _department(plan: Plan, strips: list[Rect], level: Level, department: str, number: int) -> Room:
    """Rooms along a corridor; returns it."""
    rng = plan.rng
    sure, further = DEPARTMENTS[department]
    labels = [*sure, *picked(rng, further, 5 - len(sure) - int(rng.integers(0, 2)))]
    labels = [labels[i] for i in rng.permutation(len(labels)).tolist()]
    south, way, north = strips
    corridor = plan.room("corridor", way, level, walled=False)
    rooms = [corridor]
    half = (len(labels) + 1) // 2
    for rect, some in ((south, labels[:half]), (north, labels[half:])):
        rooms += row(plan, rect, [(label, 0.6 if label == "restroom" else 1.0) for label in some], level, OPEN)
    connect(plan, corridor, rooms[1:])
    for room in rooms:
        floor = (f"floor {number // 2}", 0)
        room.within = {"zone": (department, number), "floor": floor, "building": ("building", 0)}
    return corridor
