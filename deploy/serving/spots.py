"""Ends of routes as people write them."""

import math
from typing import get_args

from prior_sg.deploy.serving.errors import FaultyRequestError
from prior_sg.schemas.queries import Spot, What

ENDS = "a label; or `place:ID`, `region:ID`, `object:ID`; or a point `X,Y,Z`"
MOST_DIGITS = 18


def spot_in(text: str) -> Spot:
    """An end of a route. Raises FaultyRequestError."""
    kind, _, number = text.partition(":")
    if kind in get_args(What) and number.isascii() and number.isdigit() and len(number) <= MOST_DIGITS:
        return Spot(what=kind, id=int(number))  # type: ignore[arg-type]
    point = _numbers(text)
    if len(point) == 3 and all(map(math.isfinite, point)):
        x, y, z = point
        return Spot(point_m=(x, y, z))
    if not text.strip() or point:
        raise FaultyRequestError(f"an end of a route is {ENDS}")
    return Spot(label=text)


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []
