"""Houses: living quarters on the ground floor, sleeping quarters on one or two floors above, around one staircase."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.kinds.tower import FLIGHT_M, LANDING_M, STOREY_M, staircase
from prior_sg.deploy.evaluation.worlds.layouts import between, connect, meet, picked, row
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import SLAB_M, WALL_M, Level, Plan, Room

DAY = ("living room", "kitchen", "dining room")
UTILITY = ("laundry room", "storage room")
NIGHT = ("bedroom", "bedroom", "home office", "playroom", "walk-in closet")
LIVING, SLEEPING, SERVICE = "living quarters", "sleeping quarters", "utility rooms"
OPEN = frozenset({"living room", "dining room"})


def house(rng: np.random.Generator) -> Plan:
    """A family's house of two or three floors."""
    plan = Plan(rng, "residential home")
    south, north = between(rng, 3.6, 4.6), between(rng, 4.2, 4.8)
    shell = Rect(2 * FLIGHT_M + WALL_M, 0, between(rng, 12, 14), south + LANDING_M + north)
    levels = [Level(STOREY_M * number, STOREY_M - SLAB_M) for number in range(int(rng.integers(2, 4)))]
    for level in levels:
        plan.storey(shell, level)
    stairs = staircase(plan, south, levels)
    for number, level in enumerate(levels):
        hallway = _storey(plan, shell.cut_y([south, LANDING_M, north]), level, number)
        plan.door(hallway, stairs, 0.9)
    stairs.within = {"building": ("building", 0)}
    for room in plan.rooms[1:]:
        plan.window(room, shell)
    furnished(plan, *plan.rooms[1:])
    return plan


def _storey(plan: Plan, strips: list[Rect], level: Level, number: int) -> Room:
    """One floor; returns its hallway."""
    rng = plan.rng
    labels = [*DAY, *picked(rng, UTILITY, 1)] if number == 0 else ["bedroom", "bathroom", *picked(rng, NIGHT, 2)]
    labels = [labels[i] for i in rng.permutation(len(labels)).tolist()]
    south, way, north = strips
    hallway = plan.room("hallway", way, level, walled=False)
    rooms = [hallway]
    for rect, some in ((south, labels[:2]), (north, labels[2:])):
        beside = row(plan, rect, [(label, 1.3 if label in DAY else 1.0) for label in some], level, OPEN)
        connect(plan, hallway, beside)
        meet(plan, [room for room in beside if not room.walled], 1.4, 0.3)
        rooms += beside
    for room in rooms:
        kind = SERVICE if room.label in UTILITY else SLEEPING if number else LIVING
        where = (kind, plan.rooms.index(room) if kind == SERVICE else number)
        room.within = {"zone": where, "floor": (f"floor {number}", 0), "building": ("building", 0)}
    return hallway
