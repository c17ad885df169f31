"""Stations: platforms between tracks, stairs up from them, and a concourse above with ticket hall and shops."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, columns, meet, picked, row
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import SLAB_M, Level, Plan, Room
from prior_sg.deploy.evaluation.worlds.stairs import flight, length_m

RISE_M = 4.5
TRACK_M, TRACK_BED_M = 3.4, -1.0
LANDING_M = 1.5  # half way up
SIDE_M = 1.9  # of a platform beside its stairs
OPEN = frozenset({"entrance", "ticket area", "waiting area", "food court"})


def station(rng: np.random.Generator) -> Plan:
    """One or two platforms below a concourse."""
    plan = Plan(rng, "train station", range_m=12.0)
    low, high = Level(0.0, RISE_M - SLAB_M), Level(RISE_M, between(rng, 3.2, 4.4))
    stairs_m = [between(rng, 2.2, 3.0) for _ in range(int(rng.integers(1, 3)))]
    width = round(sum(stairs_m) + len(stairs_m) * (2 * SIDE_M + TRACK_M) + TRACK_M, 1)
    hall = Rect(0, 0, between(rng, 13, 17), max(width, 16.0))
    below = Rect(hall.x1, 0, hall.x1 + between(rng, 26, 36), hall.depth)
    plan.storey(below, low)
    plan.storey(hall, high)
    concourse = _concourse(plan, hall, high)
    y = TRACK_M + (hall.depth - width) / 2
    _tracks(plan, below, 0.0, y)
    for stair_m in stairs_m:
        strip = Rect(below.x0, round(y, 1), below.x1, round(y + stair_m + 2 * SIDE_M, 1))
        _platform(plan, strip, concourse, low, high)
        y = strip.y1 + TRACK_M
        _tracks(plan, below, strip.y1, y if stair_m is not stairs_m[-1] else hall.depth)
    furnished(plan, *(room for room in plan.rooms if room.label != "staircase"))
    return plan


def _concourse(plan: Plan, hall: Rect, level: Level) -> Room:
    rng = plan.rng
    outer = between(rng, 5.0, 6.5)
    front, behind = hall.cut_x([outer, hall.width - outer])
    labels = ["entrance", "ticket area", "shops", *picked(rng, ["waiting area", "food court", "shops"], 1)]
    labels = [labels[i] for i in rng.permutation(len(labels)).tolist()]
    rooms = row(plan, front, [(label, 1.0) for label in labels], level, OPEN)
    concourse = plan.room("concourse", behind, level, walled=False)
    for room in rooms:
        if room.walled:
            plan.opening(concourse, room, 0.6, 2.4)
    meet(plan, [concourse, *(room for room in rooms if not room.walled)])
    columns(plan, [concourse], 5.0)
    return concourse


def _tracks(plan: Plan, below: Rect, south: float, north: float) -> None:
    """A bed below the level of the platforms, now and then with a train."""
    bed = Rect(below.x0, round(south, 1), below.x1, round(north, 1))
    plan.slab(bed, TRACK_BED_M)
    for edge in bed.edges():
        plan.box(edge.thick(0.1), TRACK_BED_M, 0.0)
    plan.hollow(bed, Level(-SLAB_M, SLAB_M))
    if plan.rng.random() < 0.4:
        train = Rect(below.x0 + 6, bed.y0 + 0.3, below.x1 - 0.5, bed.y0 + TRACK_M - 0.3)
        plan.box(train, TRACK_BED_M + 0.3, 2.7)


def _platform(plan: Plan, strip: Rect, concourse: Room, low: Level, high: Level) -> None:
    """A platform around the foot of stairs that come down from the concourse."""
    half_m, run = RISE_M / 2, length_m(RISE_M / 2)
    south, middle, north = strip.cut_y([SIDE_M, strip.depth - 2 * SIDE_M, SIDE_M])
    stair, rest = middle.cut_x([2 * run + LANDING_M, strip.width - 2 * run - LANDING_M])
    upper, landing, lower = stair.cut_x([run, LANDING_M, run])
    sides = [Rect(side.x0, side.y0, stair.x1, side.y1) for side in (south, north)]
    platform = plan.room("platform", [*sides, Rect(rest.x0, strip.y0, strip.x1, strip.y1)], low, walled=False)
    above = Level(RISE_M - SLAB_M, SLAB_M + 2.6)
    plan.walls(stair, above)
    plan.slab(stair.grown(0.05), above.z_m + above.height_m + SLAB_M)
    plan.hollow(stair, above)
    plan.hollow(Rect(stair.x0 - 0.1, stair.y0, stair.x0 + 0.1, stair.y1), Level(RISE_M, 2.4))
    flight(plan, lower, (0.0, half_m), towards=-2, solid_from_m=0.0)
    plan.box(landing, 0.0, half_m)
    flight(plan, upper, (half_m, RISE_M), towards=-2, solid_from_m=0.0)
    staircase = plan.room("staircase", stair, Level(0.0, high.z_m + 2.6), walled=False)
    plan.join(platform, staircase)
    plan.join(concourse, staircase)
    platform.portals = platform.portals[:1]
