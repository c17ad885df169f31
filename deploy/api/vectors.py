"""Vectors of the phrases that were embedded last, for a busy worker is slow to embed them again."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

MOST_KEPT = 4096  # a prior has a few hundred phrases
Vectors = np.ndarray[Any, Any]  # (phrase, dim) of several, (dim,) of one


class RecentVectors:
    """By space and phrase. Any thread may ask."""

    def __init__(self, most: int = MOST_KEPT) -> None:
        self._most = most
        self._kept: dict[tuple[str, str], Vectors] = {}  # the one used last is last
        self._lock = threading.Lock()

    def of(self, space: str, phrases: Sequence[str], embed: Callable[[str, list[str]], Vectors]) -> dict[str, Vectors]:
        """The vector of each phrase; those that are not kept are embedded, all at once."""
        wanted = dict.fromkeys(phrases)
        with self._lock:
            found = {phrase: self._kept[space, phrase] for phrase in wanted if (space, phrase) in self._kept}
        if missing := [phrase for phrase in wanted if phrase not in found]:
            found |= zip(missing, map(np.copy, embed(space, missing)), strict=True)  # a row would keep all others
        with self._lock:
            for phrase, vector in found.items():
                self._kept.pop((space, phrase), None)
                self._kept[space, phrase] = vector
            while len(self._kept) > self._most:
                del self._kept[next(iter(self._kept))]
        return found
