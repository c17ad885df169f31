"""Hotels: lobby, bar and restaurant open to each other, then guest rooms with bathrooms along a corridor."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.inventory import furnished
from prior_sg.deploy.evaluation.worlds.layouts import between, picked
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan
from prior_sg.deploy.evaluation.worlds.wings import Wing, front_and_wing

SERVICE = ("storage room", "office", "home gym", "laundry room")
GUESTS = frozenset({"guest room"})


def hotel(rng: np.random.Generator) -> Plan:
    """One floor with five to nine guest rooms."""
    plan, level = Plan(rng, "hotel"), Level(0.0, between(rng, 2.6, 3.2))
    sides = []
    for _ in range(2):
        side = ["guest room"] * int(rng.integers(3, 5)) + picked(rng, SERVICE, int(rng.integers(0, 2)))
        sides.append([side[i] for i in rng.permutation(len(side))])
    wing = Wing(sides[0], sides[1], {"guest room": 4.0}, 3.2, (5.4, 6.6), (1.6, 2.0), ensuite=GUESTS)
    front = picked(rng, ["bar", "restaurant"], int(rng.integers(1, 3)))
    front.insert(int(rng.integers(len(front) + 1)) if len(front) == 1 else 1, "lobby")
    _, shell = front_and_wing(plan, front, wing, level)
    for room in plan.rooms:
        plan.window(room, shell)
    furnished(plan)
    return plan
