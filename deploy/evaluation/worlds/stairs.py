"""Stairs of steps that one can climb."""

from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Plan, rounded

RISE_M, TREAD_M = 0.15, 0.3
THICK_M = 0.25


def flight(
    plan: Plan, rect: Rect, heights_m: tuple[float, float], towards: int, solid_from_m: float | None = None
) -> None:
    """Steps from the lower to the higher height over the whole rectangle.

    They rise towards: 1 = to larger y, -1 = to smaller y, 2 = to larger x, -2 = to smaller x. They are hollow
    below, or solid from a height on.
    """
    low_m, high_m = heights_m
    steps = round((high_m - low_m) / RISE_M) - 1
    along_y = abs(towards) == 1
    tread = (rect.depth if along_y else rect.width) / steps
    for number in range(steps):
        start, end = (rounded(number * tread), rounded((number + 1) * tread))
        if along_y:
            step = Rect(rect.x0, rect.y0 + start, rect.x1, rect.y0 + end)
            step = step if towards > 0 else Rect(rect.x0, rect.y1 - end, rect.x1, rect.y1 - start)
        else:
            step = Rect(rect.x0 + start, rect.y0, rect.x0 + end, rect.y1)
            step = step if towards > 0 else Rect(rect.x1 - end, rect.y0, rect.x1 - start, rect.y1)
        top = rounded(low_m + (number + 1) * RISE_M)
        plan.box(step, top - THICK_M if solid_from_m is None else solid_from_m, top)


def length_m(rise_m: float) -> float:
    """How long a flight is."""
    return rounded((round(rise_m / RISE_M) - 1) * TREAD_M)
