"""Ends of routes as people write them."""

from typing import get_args

from prior_sg.schemas.answers import What
from prior_sg.schemas.queries import Spot

HERE = "here"
KINDS = (*get_args(What), "marker")
ENDS = (
    "a label; or `here`, where the camera was last; or `place:ID`, `region:ID`, `object:ID`, `marker:NUMBER`; or a "
    "point `X,Y,Z`"
)
MOST_DIGITS = 18
FARTHEST_M = 1e9


def spot_in(text: str) -> Spot:
    """An end of a route. Raises ValueError."""
    if text == HERE:
        return Spot(here=True)
    kind, _, number = text.partition(":")
    if kind in KINDS and number.isascii() and number.isdigit() and len(number) <= MOST_DIGITS:
        return Spot(what=kind, id=int(number))  # type: ignore[arg-type]
    point = _numbers(text)
    if len(point) == 3 and all(abs(value) <= FARTHEST_M for value in point):
        x, y, z = point
        return Spot(point_m=(x, y, z))
    if not text.strip() or point:
        raise ValueError(f"an end of a route is {ENDS}")
    return Spot(label=text)


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []
