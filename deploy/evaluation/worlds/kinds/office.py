"""Offices: one hall of zones without walls, with partitions and a few rooms of glass."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, columns, connect, meet, parts, picked
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan, Room

ZONES = ("lounge", "dining area", "games area", "library", "reception", "workspace", "printer room")
CLOSED = ("meeting room", "private office", "meeting room", "phone booth", "server room", "storage room")
PARTITION_M = 1.4
WEIGHTS = {"workspace": 1.8, "phone booth": 0.45, "printer room": 0.6, "server room": 0.6, "storage room": 0.6}


def office(rng: np.random.Generator) -> Plan:
    """An open floor of five to ten zones along a corridor that nothing but habit divides from them."""
    plan = Plan(rng, "office floor")
    level = Level(0.0, between(rng, 2.7, 3.4))
    shell = open_floor(plan, level)
    for room in plan.rooms:
        plan.window(room, shell)
    furnished(plan)
    return plan


def open_floor(plan: Plan, level: Level) -> Rect:
    """The zones of one storey; returns the shell."""
    rng = plan.rng
    south, way, north = between(rng, 5.0, 7.5), between(rng, 1.8, 2.6), between(rng, 4.5, 7.0)
    shell = Rect(0, 0, between(rng, 17, 28), south + way + north)
    plan.storey(shell, level)
    south_rect, way_rect, north_rect = shell.cut_y([south, way, north])
    zones = ["workspace", "kitchen", *picked(rng, ZONES, int(rng.integers(2, 5)))]
    closed = picked(rng, CLOSED, int(rng.integers(1, 4)))
    labels = [(zones + closed)[i] for i in rng.permutation(len(zones) + len(closed))]
    half = len(labels) // 2
    corridor = plan.room("corridor", way_rect, level, walled=False)
    for rect, some in ((south_rect, labels[:half]), (north_rect, labels[half:])):
        _side(plan, corridor, rect, some, level)
    columns(plan, [room for room in plan.rooms if not room.walled], 6.0)
    return shell


def _side(plan: Plan, corridor: Room, rect: Rect, labels: list[str], level: Level) -> None:
    rng = plan.rng
    cuts = parts(rng, rect.width, [WEIGHTS.get(label, 1.0) for label in labels], 2.0)
    rooms = [
        plan.room(label, piece, level, walled=label in CLOSED)
        for label, piece in zip(labels, rect.cut_x(cuts), strict=True)
    ]
    for room in rooms:
        if room.label == "meeting room" and rng.random() < 0.7:
            plan.glaze(room)
    connect(plan, corridor, rooms, 0.9)
    meet(plan, [room for room in rooms if not room.walled], PARTITION_M, 0.5)
