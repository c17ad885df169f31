"""Campuses: street, walkway, plaza, lawn and parking lot before a building that one enters."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.furniture import put
from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, connect, meet, picked, row
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import FURNITURE, Level, Plan, Room, rounded

SKY = Level(0.0, 9.0)
ROOMS = ("classroom", "lecture hall", "cafeteria", "library", "laboratory", "office", "restroom")
STANDING = {"lawn": "tree", "plaza": "bench", "parking lot": "car", "walkway": "street lamp", "street": "car"}
SIZES_M = {"tree": (3.0, 3.0, 6.0), "bench": (1.6, 0.6, 0.5), "car": (4.4, 1.8, 1.5), "street lamp": (0.2, 0.2, 5.0)}
PER_M2 = {"lawn": 0.02, "plaza": 0.015, "parking lot": 0.025, "walkway": 0.02, "street": 0.006}


def campus(rng: np.random.Generator) -> Plan:
    """Four outdoor zones or more, and a building of four to six rooms."""
    plan = Plan(rng, "university campus", voxel_m=0.1, range_m=30.0, stride_m=1.5, outdoors=True)
    depths = [between(rng, 6, 8), between(rng, 2.4, 3.2), between(rng, 14, 20), between(rng, 13, 16)]
    site = Rect(0, 0, between(rng, 42, 54), round(sum(depths), 1))
    plan.slab(site, 0.0)
    street, walkway, middle, north = site.cut_y(depths)
    zones = [plan.room("street", street, SKY, walled=False), plan.room("walkway", walkway, SKY, walled=False)]
    order = ["parking lot", "plaza", "lawn"] if rng.random() < 0.5 else ["lawn", "plaza", "parking lot"]
    zones += row(plan, middle, [(label, 1.0) for label in order], SKY, order)
    meet(plan, zones)
    plaza = zones[3]
    building = Rect(plaza.bounds.x0 - between(rng, 2, 5), north.y0, plaza.bounds.x1 + between(rng, 2, 5), north.y1)
    for facade in (Rect(0, north.y0, building.x0, north.y1), Rect(building.x1, north.y0, site.x1, north.y1)):
        plan.box(facade, 0.0, between(rng, 5, 8))
    _building(plan, building, plaza)
    for zone in zones:
        _dress(plan, zone)
    furnished(plan, *plan.rooms[len(zones) :])
    for number, room in enumerate(plan.rooms):
        inside = number >= len(zones)
        room.within = {"building": ("building" if inside else "outdoors", 0), "floor": ("floor 0", int(inside))}
        room.within["zone"] = ("indoors" if inside else "outdoors", 0)
    return plan


def _building(plan: Plan, shell: Rect, plaza: Room) -> None:
    """An atrium behind a glass front, and rooms along a corridor behind it and beside."""
    rng, level = plan.rng, Level(0.0, between(plan.rng, 3.0, 3.6))
    plan.storey(shell, level)
    front_m = between(rng, 5.0, 5.6)
    front, way, back = shell.cut_y([front_m, 2.4, shell.depth - front_m - 2.4])
    labels = picked(rng, ROOMS, int(rng.integers(3, 6)))
    corridor = plan.room("corridor", way, level, walled=False)
    beside = [(labels[0], 1.0), ("atrium", 1.2)]
    rooms = row(plan, front, beside if rng.random() < 0.5 else beside[::-1], level, {"atrium"})
    rooms += row(plan, back, [(label, 0.5 if label == "restroom" else 1.0) for label in labels[1:]], level)
    connect(plan, corridor, rooms, 1.0)
    atrium = next(room for room in rooms if room.label == "atrium")
    for room in rooms:
        plan.window(room, shell, 0.6)
    plan.door(plaza, atrium, 2.0)


def _dress(plan: Plan, zone: Room) -> None:
    """Trees, benches, cars and lamps."""
    rng, name = plan.rng, STANDING[zone.label]
    width, depth, height_m = SIZES_M[name]
    for _ in range(2 + int(PER_M2[zone.label] * zone.area_m2)):
        bounds = zone.bounds.grown(-0.3)
        if bounds.depth <= depth or bounds.width <= width:
            return
        x = rounded(rng.uniform(bounds.x0, bounds.x1 - width), 0.1)
        y = rounded(rng.uniform(bounds.y0, bounds.y1 - depth), 0.1)
        footprint = Rect(x, y, round(x + width, 6), round(y + depth, 6))
        if not plan.fits(zone, footprint, 0.8):
            continue
        if name == "tree":
            trunk = footprint.grown(-1.3)
            plan.box(trunk, 0.0, 2.4)
            plan.box(footprint, 2.4, height_m, FURNITURE)
            zone.taken.append(trunk)
        else:
            put(plan, zone, [(name, (0, 0, 0, width, depth, height_m))], footprint, 0)
