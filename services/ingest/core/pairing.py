"""Messages of two streams that belong together by their stamps (pure)."""

from collections.abc import Sequence

import numpy as np


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
