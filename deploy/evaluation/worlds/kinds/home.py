"""Homes: a flat along a hallway, with an open-plan day zone at times, or rooms around a living room."""

import itertools

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, halved, picked, row
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan, Room, Unbuildable

DAY = ("living room", "dining room", "kitchen")
FURTHER = ("home office", "bedroom", "bathroom", "laundry room", "storage room", "playroom", "home gym", "bedroom")
SMALL = {"bathroom": 0.6, "laundry room": 0.55, "storage room": 0.55, "walk-in closet": 0.5, "kitchen": 0.8}
LARGE = {"living room": 1.5, "bedroom": 1.1}


def home(rng: np.random.Generator) -> Plan:
    """A home of four to nine rooms on one level."""
    plan = Plan(rng, "residential home")
    shell = along_hallway(plan, 0.0) if rng.random() < 0.6 else around_living_room(plan, 0.0)
    for room in plan.rooms:
        plan.window(room, shell)
    furnished(plan)
    return plan


def along_hallway(plan: Plan, z_m: float) -> Rect:
    """Day rooms on one side of a hallway, the others on the other; returns the shell."""
    rng, level = plan.rng, Level(z_m, between(plan.rng, 2.4, 2.8))
    rest = ["bedroom", "bathroom", *picked(rng, FURTHER, int(rng.integers(0, 4)))]
    rest = [rest[i] for i in rng.permutation(len(rest))]
    day = [DAY[i] for i in rng.permutation(3)]
    width = between(rng, max(9.0, 2.6 * len(rest)), max(11.0, 3.2 * len(rest)))
    south, hall, north = between(rng, 3.6, 5.0), between(rng, 1.2, 1.7), between(rng, 3.0, 4.2)
    shell = Rect(0, 0, width, south + hall + north)
    plan.storey(shell, level)
    day_rect, hall_rect, rest_rect = shell.cut_y([south, hall, north])
    open_plan = bool(rng.random() < 0.5)
    day_rooms = _row(plan, day_rect, day, level, walled=not open_plan)
    hallway = plan.room("hallway", hall_rect, level)
    rest_rooms = _row(plan, rest_rect, rest, level)
    for room in rest_rooms:
        plan.door(hallway, room)
    _join_day_rooms(plan, day_rooms, hallway, open_plan)
    return shell


def around_living_room(plan: Plan, z_m: float) -> Rect:
    """The largest of some rectangles is the living room; the others open from it, or from each other; returns the
    shell."""
    rng, level = plan.rng, Level(z_m, between(plan.rng, 2.4, 2.8))
    count = int(rng.integers(4, 8))
    shell = Rect(0, 0, between(rng, 2.0 * count**0.5 + 3, 2.4 * count**0.5 + 4.5), between(rng, 6.0, 8.5))
    plan.storey(shell, level)
    rects = sorted(halved(rng, shell, count, 2.0), key=lambda rect: -rect.area)
    order = ["kitchen", "bedroom", "bathroom", *picked(rng, ["dining room", *FURTHER], 4)][: count - 1]
    labels = ["living room", *sorted(order, key=lambda label: -SMALL.get(label, LARGE.get(label, 1.0)))]
    rooms = [plan.room(label, rect, level) for label, rect in zip(labels, rects, strict=True)]
    inside, outside = rooms[:1], rooms[1:]
    while outside:
        joined = [(a, b) for b in outside for a in inside if _takes_door(plan, a, b)]
        if not joined:
            raise Unbuildable("a room has no neighbour")
        through, room = min(joined, key=lambda pair: (pair[0].label in {"bathroom", "bedroom"}, rng.random()))
        if {through.label, room.label} <= set(DAY) and rng.random() < 0.5:
            plan.opening(through, room, float(rng.uniform(0.4, 0.9)))
        else:
            plan.door(through, room)
        inside.append(room)
        outside.remove(room)
    return shell


def _takes_door(plan: Plan, one: Room, other: Room) -> bool:
    return any(edge.length >= 1.4 for edge in plan.edges(one, other))


def _row(plan: Plan, rect: Rect, labels: list[str], level: Level, walled: bool = True) -> list[Room]:
    weighted = [(label, SMALL.get(label, LARGE.get(label, 1.0))) for label in labels]
    return row(plan, rect, weighted, level, open_labels=() if walled else labels)


def _join_day_rooms(plan: Plan, rooms: list[Room], hallway: Room, open_plan: bool) -> None:
    rng = plan.rng
    for one, other in itertools.pairwise(rooms):
        if open_plan:
            plan.join(one, other)
        elif rng.random() < 0.5:
            plan.opening(one, other, float(rng.uniform(0.4, 0.9)))
        elif rng.random() < 0.7:
            plan.door(one, other)
    entered = [rooms[int(rng.integers(3))]] if open_plan else rooms
    for room in entered:
        if rng.random() < 0.25:
            plan.opening(hallway, room, 0.5)
        else:
            plan.door(hallway, room)
