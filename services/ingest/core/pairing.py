"""Messages of two streams that belong together by their stamps (pure)."""

from collections.abc import Sequence

import numpy as np

AT_ONCE_NS = 1000  # stamps of several cameras that go off together


def associate(first_ns: Sequence[int], second_ns: Sequence[int], within_ns: int) -> dict[int, int]:
    """Index in `second_ns` (rising) of each index in `first_ns` that finds one: closest first, each used once."""
    second = np.asarray(second_ns, np.int64)
    first = np.asarray(first_ns, np.int64)
    begins = np.searchsorted(second, first - within_ns, side="right")
    ends = np.searchsorted(second, first + within_ns, side="left")
    pairs = sorted(
        (abs(int(first[i] - second[j])), i, j)
        for i, (begin, end) in enumerate(zip(begins, ends, strict=True))
        for j in range(begin, end)
    )
    partner: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in pairs:
        if i not in partner and j not in used:
            partner[i] = j
            used.add(j)
    return partner


def risen(stamp_ns: int, newest_ns: int | None) -> int:
    """The stamp, or a nanosecond after the newest, where another camera went off at once: readers count on a rise."""
    at_once = newest_ns is not None and 0 <= newest_ns - stamp_ns < AT_ONCE_NS
    return newest_ns + 1 if newest_ns is not None and at_once else stamp_ns
