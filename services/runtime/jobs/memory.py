"""What a worker has done of late, so that a dispatcher that was killed and asks again costs nothing."""

from collections import OrderedDict
from hashlib import blake2b

MOST_JOBS = 64  # more than any dispatcher has under way at one worker


class Done:
    """How many results each of the newest jobs had, by the bytes of the job."""

    def __init__(self, most: int = MOST_JOBS) -> None:
        self._most = most
        self._results: OrderedDict[bytes, int] = OrderedDict()

    def note(self, payload: bytes, results: int) -> None:
        """A job is done, and its results are published."""
        self._results[_name(payload)] = results
        while len(self._results) > self._most:
            self._results.popitem(last=False)

    def results_of(self, payload: bytes) -> int:
        """How many results a job has had; 0 = it is not remembered."""
        return self._results.get(_name(payload), 0)


def _name(payload: bytes) -> bytes:
    return blake2b(payload, digest_size=16).digest()
