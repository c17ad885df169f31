"""A plan mirrored and turned, so that no kind always lies the same way."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Box, Plan, Room
from prior_sg.deploy.truth import TrueObject


def turned(plan: Plan, rng: np.random.Generator) -> Plan:
    """The same plan in one of eight positions."""
    swap, mirror_x, mirror_y = (rng.random(3) < 0.5).tolist()

    def place(rect: Rect) -> Rect:
        x0, x1 = (-rect.x1, -rect.x0) if mirror_x else (rect.x0, rect.x1)
        y0, y1 = (-rect.y1, -rect.y0) if mirror_y else (rect.y0, rect.y1)
        return Rect(y0, x0, y1, x1) if swap else Rect(x0, y0, x1, y1)

    return replace(
        plan,
        rooms=[_room(room, place) for room in plan.rooms],
        boxes=[_box(box, place) for box in plan.boxes],
        objects=[_object(item, place) for item in plan.objects],
    )


def _room(room: Room, place: Callable[[Rect], Rect]) -> Room:
    return replace(room, rects=tuple(place(rect) for rect in room.rects))


def _box(box: Box, place: Callable[[Rect], Rect]) -> Box:
    rect = place(Rect(box.min_m[0], box.min_m[1], box.max_m[0], box.max_m[1]))
    return Box((rect.x0, rect.y0, box.min_m[2]), (rect.x1, rect.y1, box.max_m[2]), box.matter)


def _object(item: TrueObject, place: Callable[[Rect], Rect]) -> TrueObject:
    rect = place(Rect(*item.min_m[:2].tolist(), *item.max_m[:2].tolist()))
    low_m, high_m = (rect.x0, rect.y0, item.min_m[2]), (rect.x1, rect.y1, item.max_m[2])
    return TrueObject(item.label, np.array(low_m, float), np.array(high_m, float))
