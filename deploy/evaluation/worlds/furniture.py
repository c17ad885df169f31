"""What stands in rooms: things built of boxes, and where in a room they go."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import FURNITURE, WALL_M, Plan, Room, rounded
from prior_sg.deploy.truth import TrueObject

Local = tuple[float, float, float, float, float, float]  # u, v, z from and to: u along the back, v away from it
Shape = Callable[[float, float, float], list[tuple[str, Local]]]  # width, depth, height -> named boxes; "" = no object
Where = Literal["wall", "middle", "rows"]
TRIES = 14
SPREAD = 0.12  # of a side, as a share of it


class Thing(NamedTuple):
    """Something that can stand in a room; `shape` builds it from its width, depth and height in metres."""

    width_m: float
    depth_m: float
    height_m: float
    shape: Shape
    where: Where = "wall"


class Wish(NamedTuple):
    """How many of a thing a room gets, and for each the chance that it does."""

    thing: str
    number: int = 1
    chance: float = 1.0
    per_m2: float = 0.0  # so many more for each square metre


def solid(name: str) -> Shape:
    """One closed box."""
    return lambda width, depth, height: [(name, (0, 0, 0, width, depth, height))]


def table(name: str) -> Shape:
    """A top on four legs."""

    def built(width: float, depth: float, height: float) -> list[tuple[str, Local]]:
        parts: list[tuple[str, Local]] = [
            (name, (0, 0, 0, width, depth, height)),
            ("", (0, 0, height - 0.05, width, depth, height)),
        ]
        legs = [(u, v) for u in (0.05, width - 0.1) for v in (0.05, depth - 0.1)]
        return parts + [("", (u, v, 0, u + 0.05, v + 0.05, height)) for u, v in legs]

    return built


def seat(name: str) -> Shape:
    """A seat with a back."""
    return lambda width, depth, height: [
        (name, (0, 0, 0, width, depth, height)),
        ("", (0, 0, 0, width, depth, height / 2)),
        ("", (0, 0, 0, width, 0.1, height)),
    ]


def bed(name: str) -> Shape:
    """A bed with its head at the wall."""
    return lambda width, depth, height: [
        (name, (0, 0, 0, width, depth, height)),
        ("", (0, 0, 0, width, depth, height * 0.6)),
        ("", (0, 0, 0, width, 0.1, height)),
    ]


def desk(name: str, chair: str, screen: str = "monitor") -> Shape:
    """A desk at the wall with a screen and a chair before it."""

    def built(width: float, depth: float, height: float) -> list[tuple[str, Local]]:
        middle, deep = width / 2, depth - 0.6
        parts = table(name)(width, deep, height)
        if screen:
            parts.append((screen, (middle - 0.3, 0.1, height, middle + 0.3, 0.15, height + 0.4)))
        chair_at = (middle - 0.25, deep - 0.1, 0.0)
        parts.append((chair, (*chair_at, middle + 0.25, depth - 0.15, 0.9)))
        parts.append(("", (middle - 0.25, deep - 0.1, 0.4, middle + 0.25, depth - 0.15, 0.5)))
        parts.append(("", (middle - 0.25, depth - 0.2, 0.4, middle + 0.25, depth - 0.15, 0.9)))
        return parts

    return built


def table_with_chairs(name: str, chair: str) -> Shape:
    """A table with chairs along both long sides."""

    def built(width: float, depth: float, height: float) -> list[tuple[str, Local]]:
        low, high = 0.45, depth - 0.45
        parts: list[tuple[str, Local]] = [
            (name, (0, low, 0, width, high, height)),
            ("", (0, low, height - 0.05, width, high, height)),
            ("", (width / 2 - 0.1, depth / 2 - 0.1, 0, width / 2 + 0.1, depth / 2 + 0.1, height)),
        ]
        for number in range(max(1, int(width / 0.7))):
            start = 0.1 + number * (width - 0.2) / max(1, int(width / 0.7))
            for v0, v1, back in ((0.0, 0.45, 0.0), (high, depth, depth - 0.05)):
                parts.append((chair, (start, v0, 0, start + 0.45, v1, 0.9)))
                parts.append(("", (start, v0, 0.4, start + 0.45, v1, 0.45)))
                parts.append(("", (start, back, 0.4, start + 0.45, back + 0.05, 0.9)))
        return parts

    return built


def furnish(plan: Plan, room: Room, wishes: Sequence[Wish], things: dict[str, Thing]) -> None:
    """Place what fits, in the order wished."""
    for wish in wishes:
        for _ in range(wish.number + int(wish.per_m2 * room.area_m2)):
            if plan.rng.random() < wish.chance:
                place(plan, room, things[wish.thing])


def place(plan: Plan, room: Room, thing: Thing) -> bool:
    """Put one thing somewhere in the room; whether there was space."""
    rng = plan.rng
    spread = 1 + SPREAD * rng.uniform(-1, 1, 2)
    width, depth = rounded(thing.width_m * spread[0], 0.1), rounded(thing.depth_m * spread[1], 0.1)
    for _ in range(TRIES):
        rect = room.rects[int(rng.integers(len(room.rects)))].grown(-WALL_M / 2 if room.walled else 0.0)
        side = int(rng.integers(4))
        footprint = _footprint(rect, side, (width, depth), thing.where, rng)
        gap_m = 0.0 if thing.where == "wall" else 0.5
        if footprint is not None and plan.fits(room, footprint, gap_m):
            put(plan, room, thing.shape(width, depth, thing.height_m), footprint, side)
            return True
    return False


def put(plan: Plan, room: Room, parts: Sequence[tuple[str, Local]], footprint: Rect, side: int) -> None:
    """Build something on a footprint with its back to a side (south, north, west, east)."""
    room.taken.append(footprint)
    for name, (u0, v0, z0, u1, v1, z1) in parts:
        rect = _placed(footprint, side, (u0, v0, u1, v1))
        low_m, high_m = room.z_m + rounded(z0), room.z_m + min(rounded(z1), room.height_m)
        if name:
            plan.objects.append(
                TrueObject(name, np.array([rect.x0, rect.y0, low_m]), np.array([rect.x1, rect.y1, high_m]))
            )
        if not name or len(parts) == 1 or not _hollow(parts, name):
            plan.box(rect, low_m, high_m, FURNITURE)


def _hollow(parts: Sequence[tuple[str, Local]], name: str) -> bool:
    """Whether later nameless boxes say what the inside of the object's box is made of."""
    index = next(i for i, part in enumerate(parts) if part[0] == name)
    return index + 1 < len(parts) and parts[index + 1][0] == "" and parts[index][1][2] == 0


def _footprint(rect: Rect, side: int, size: tuple[float, float], where: Where, rng: np.random.Generator) -> Rect | None:
    width, depth = size
    along, across = (rect.width, rect.depth) if side < 2 else (rect.depth, rect.width)
    if width > along or depth > across:
        return None
    u = rounded(rng.uniform(0, along - width))
    if where == "wall":
        u = 0.0 if rng.random() < 0.25 else u  # corners are taken first
        v = 0.0
    else:
        v = rounded(rng.uniform(0.3, max(0.3, across - depth - 0.3)))
    x, y = (u, v) if side == 0 else (u, across - depth - v)
    if side >= 2:
        x, y = (v, u) if side == 2 else (across - depth - v, u)
    span = (width, depth) if side < 2 else (depth, width)
    return Rect(rect.x0 + x, rect.y0 + y, rect.x0 + x + span[0], rect.y0 + y + span[1])


def _placed(footprint: Rect, side: int, local: tuple[float, float, float, float]) -> Rect:
    u0, v0, u1, v1 = local
    x0, y0, x1, y1 = footprint
    if side == 0:
        return Rect(x0 + u0, y0 + v0, x0 + u1, y0 + v1)
    if side == 1:
        return Rect(x0 + u0, y1 - v1, x0 + u1, y1 - v0)
    if side == 2:
        return Rect(x0 + v0, y0 + u0, x0 + v1, y0 + u1)
    return Rect(x1 - v1, y0 + u0, x1 - v0, y0 + u1)
