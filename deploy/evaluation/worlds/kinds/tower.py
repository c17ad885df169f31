"""Towers: two or three storeys of a house of offices or flats, around one staircase."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, connect, meet, picked, row
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import SLAB_M, WALL_M, Level, Plan, Room
from prior_sg.deploy.evaluation.worlds.stairs import flight, length_m

STOREY_M = 3.0
LANDING_M, FLIGHT_M = 1.5, 1.4  # depth of a landing, width of a flight
FLAT = ("bathroom", "home office", "dining room", "bedroom", "storage room")
OFFICE = ("meeting room", "private office", "kitchen", "lounge", "printer room", "storage room")
OPEN = frozenset({"workspace", "lounge", "kitchen"})


def tower(rng: np.random.Generator) -> Plan:
    """An office building or an apartment building."""
    offices = bool(rng.random() < 0.5)
    plan = Plan(rng, "office building" if offices else "apartment building")
    south, north = between(rng, 3.6, 5.0), between(rng, 4.2, 5.2)
    shell = Rect(2 * FLIGHT_M + WALL_M, 0, between(rng, 14, 19), south + LANDING_M + north)
    count = int(rng.integers(2, 4))
    levels = [Level(STOREY_M * number, STOREY_M - SLAB_M) for number in range(count)]
    for level in levels:
        plan.storey(shell, level)
    stairs = staircase(plan, south, levels)
    for level in levels:
        corridor = _storey(plan, shell.cut_y([south, LANDING_M, north]), level, offices)
        plan.door(corridor, stairs, 0.9)
    for room in plan.rooms[1:]:
        plan.window(room, shell)
    furnished(plan, *plan.rooms[1:])
    return plan


def staircase(plan: Plan, south: float, levels: list[Level]) -> Room:
    """Two flights for each storey, beside each other with a wall between."""
    run = length_m(STOREY_M / 2)
    shaft = Rect(0, south, 2 * FLIGHT_M + WALL_M, south + LANDING_M + run + LANDING_M)
    whole = Level(0.0, levels[-1].z_m + levels[-1].height_m)
    plan.slab(shaft, 0.0)
    plan.slab(shaft, whole.height_m + SLAB_M)
    room = plan.room("staircase", shaft, whole)
    near, flights, far = shaft.cut_y([LANDING_M, run, LANDING_M])
    up, between_flights, down = flights.cut_x([FLIGHT_M, WALL_M, FLIGHT_M])
    for level in levels[:-1]:
        middle_m, next_m = level.z_m + STOREY_M / 2, level.z_m + STOREY_M
        flight(plan, up, (level.z_m, middle_m), towards=1)
        plan.slab(far, middle_m)
        flight(plan, down, (middle_m, next_m), towards=-1)
        plan.slab(near, next_m)
    plan.box(between_flights, 0.0, levels[-1].z_m + 1.0)
    plan.box(Rect(up.x0, up.y0, up.x1, up.y0 + WALL_M), levels[-1].z_m, levels[-1].z_m + 1.0)
    return room


def _storey(plan: Plan, strips: list[Rect], level: Level, offices: bool) -> Room:
    rng = plan.rng
    south, way, north = strips
    if offices:
        labels = ["workspace", *picked(rng, OFFICE, int(rng.integers(3, 5)))]
    else:
        labels = ["living room", "kitchen", "bedroom", *picked(rng, FLAT, int(rng.integers(1, 4)))]
    labels = [labels[i] for i in rng.permutation(len(labels)).tolist()]
    corridor = plan.room("corridor" if offices else "hallway", way, level, walled=False)
    for rect, some in ((south, labels[: len(labels) // 2]), (north, labels[len(labels) // 2 :])):
        weighted = [(label, 1.6 if label == "workspace" else 1.0) for label in some]
        rooms = row(plan, rect, weighted, level, OPEN if offices else ())
        connect(plan, corridor, rooms)
        meet(plan, [room for room in rooms if not room.walled], 1.4, 0.3)
    return corridor
