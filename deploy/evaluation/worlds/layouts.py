"""How rectangles are divided, and rooms lined up and joined, by many kinds of plans."""

import itertools
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from prior_sg.deploy.evaluation.worlds.furniture import put
from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Level, Plan, Room, Unbuildable, rounded

LEAST_WIDTH_M = 1.8


def parts(rng: np.random.Generator, length_m: float, weights: Sequence[float], least_m: float) -> list[float]:
    """A length divided about as the weights say, each part at least so long, on a grid of 0.1 m. Raises Unbuildable."""
    shares = np.array(weights, float) * rng.uniform(0.8, 1.25, len(weights))
    free_m = length_m - least_m * len(weights)
    if free_m < -1e-6:
        raise Unbuildable(f"{len(weights)} rooms do not fit into {length_m:.1f} m")
    wanted = np.maximum(shares / shares.sum() * length_m - least_m, 0)
    cuts = [rounded(least_m + free_m * float(share), 0.1) for share in wanted / max(wanted.sum(), 1e-9)]
    cuts[int(np.argmax(cuts))] += length_m - sum(cuts)
    return [rounded(cut, 0.1) for cut in cuts]


def between(rng: np.random.Generator, low_m: float, high_m: float) -> float:
    """A length from a range, on a grid of 0.1 m."""
    return rounded(float(rng.uniform(low_m, high_m)), 0.1)


def picked(rng: np.random.Generator, options: Sequence[str], count: int) -> list[str]:
    """So many different ones, in random order."""
    return [options[i] for i in rng.permutation(len(options))[:count].tolist()]


def halved(rng: np.random.Generator, rect: Rect, count: int, least_m: float) -> list[Rect]:
    """A rectangle cut in two again and again, along its longer side. Raises Unbuildable."""
    if count == 1:
        return [rect]
    fewer = count // 2
    weights = [fewer, count - fewer] if rng.random() < 0.5 else [count - fewer, fewer]
    along_x = rect.width >= rect.depth
    cuts = parts(rng, rect.width if along_x else rect.depth, weights, least_m)
    halves = rect.cut_x(cuts) if along_x else rect.cut_y(cuts)
    return [
        piece for half, share in zip(halves, weights, strict=True) for piece in halved(rng, half, int(share), least_m)
    ]


def row(
    plan: Plan, rect: Rect, rooms: Sequence[tuple[str, float]], level: Level, open_labels: Collection[str] = ()
) -> list[Room]:
    """Rooms of these labels and relative widths along the rectangle's longer side, walled but for the open ones.

    Raises Unbuildable.
    """
    along_x = rect.width >= rect.depth
    cuts = parts(plan.rng, rect.width if along_x else rect.depth, [width for _, width in rooms], LEAST_WIDTH_M)
    pieces = rect.cut_x(cuts) if along_x else rect.cut_y(cuts)
    return [
        plan.room(label, piece, level, walled=label not in open_labels)
        for (label, _), piece in zip(rooms, pieces, strict=True)
    ]


def connect(plan: Plan, corridor: Room, rooms: Iterable[Room], door_m: float | None = None) -> None:
    """Doors from a corridor into walled rooms, none into open ones, which meet it."""
    for room in rooms:
        if room.walled:
            plan.door(corridor, room, door_m)
        else:
            plan.join(corridor, room)


def meet(plan: Plan, rooms: Sequence[Room], partition_m: float = 0.0, chance: float = 0.0) -> None:
    """Join all open rooms that touch, some with half-height partitions between."""
    for one, other in itertools.combinations(rooms, 2):
        if any(edge.length >= 1.3 for edge in plan.edges(one, other)):
            plan.join(one, other, partition_m if plan.rng.random() < chance else 0.0)


def columns(plan: Plan, rooms: Sequence[Room], spacing_m: float, side_m: float = 0.4) -> None:
    """Columns on a raster, where they stand in nobody's way."""
    for room in rooms:
        bounds = room.bounds
        for x in np.arange(np.ceil(bounds.x0 / spacing_m) * spacing_m, bounds.x1, spacing_m).tolist():
            for y in np.arange(np.ceil(bounds.y0 / spacing_m) * spacing_m, bounds.y1, spacing_m).tolist():
                column = Rect(x - side_m / 2, y - side_m / 2, x + side_m / 2, y + side_m / 2)
                if plan.fits(room, column):
                    room.taken.append(column)
                    plan.box(column, room.z_m, room.z_m + room.height_m)


def shelving(plan: Plan, room: Room, name: str, height_m: float, way_m: float) -> None:
    """Parallel rows of shelves along the room's longer side, with ways between and around."""
    bounds = room.bounds.grown(-0.8)
    along_x, depth_m = bounds.width >= bounds.depth, 0.8
    across = bounds.depth if along_x else bounds.width
    count = int((across + way_m) / (depth_m + way_m))
    pitch = (across - depth_m) / max(count - 1, 1)
    for number in range(count):
        start = rounded((bounds.y0 if along_x else bounds.x0) + number * pitch)
        if along_x:
            shelf = Rect(rounded(bounds.x0), start, rounded(bounds.x1), start + depth_m)
        else:
            shelf = Rect(start, rounded(bounds.y0), start + depth_m, rounded(bounds.y1))
        if plan.fits(room, shelf):
            put(plan, room, [(name, (0, 0, 0, shelf.width, shelf.depth, height_m))], shelf, 0)
