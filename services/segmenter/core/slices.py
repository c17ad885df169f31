"""Work that comes part by part, and what it is measured in (pure).

Such work is a generator: it yields about how many places the next part will visit, and returns what it was for. A visit
is that of `energy.solver`: a pass over the labels of a place and its neighbours, 0.3 µs or so. Who goes on with it
counts visits, never time: a clock would stop a replay elsewhere than the run it repeats.
"""

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Parts = Generator[int, None, T]


def at_once(parts: Parts[T]) -> T:
    """What the work gives, done to its end."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return end.value
