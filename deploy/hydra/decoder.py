"""Reads graphs in a process of its own, which foreign bytes may end or fill without harm to the bridge."""

import contextlib
import multiprocessing
import resource
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from prior_sg.deploy.hydra.core.graph import HydraGraph
from prior_sg.schemas.codec import decode, encode

MOST_BYTES = 512 << 20  # of one message
MOST_MEMORY_B = 6 << 30  # addresses of the reading process
MOST_S = 30.0  # to read one message


class GraphRefused(ValueError):
    """A message gave no graph; one sentence says why."""


class Decoder:
    """Use from one thread; `close` ends its process."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._pool = _pool()

    def read(self, payload: bytes) -> HydraGraph:
        """The columns of one message. Raises GraphRefused."""
        if len(payload) > MOST_BYTES:
            raise GraphRefused(
                f"a message of {len(payload) >> 20} MiB is not read; have Hydra send no mesh (send_mesh)"
            )
        try:
            columns, fault = self._pool.submit(_columns, payload, self._robot).result(MOST_S)
        except (BrokenProcessPool, TimeoutError) as error:
            self._start_again()
            took = f"took more than {MOST_S:.0f} s" if isinstance(error, TimeoutError) else "ended its reader"
            raise GraphRefused(f"a message of {len(payload)} bytes {took}; it is left out") from error
        if fault:
            raise GraphRefused(fault)
        return decode(HydraGraph, columns)

    def _start_again(self) -> None:
        for process in list((self._pool._processes or {}).values()):
            process.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool = _pool()

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _limit_memory)


def _limit_memory() -> None:
    """A damaged length must not fill the machine."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    lower = [limit for limit in (soft, hard, MOST_MEMORY_B) if limit != resource.RLIM_INFINITY]
    with contextlib.suppress(ValueError):
        resource.setrlimit(resource.RLIMIT_AS, (min(lower), hard))


def _columns(payload: bytes, robot: str) -> tuple[bytes, str]:
    """The columns, encoded, or why there are none."""
    from prior_sg.deploy.hydra.reading import NotAGraph, read_graph

    try:
        return encode(read_graph(payload, robot)), ""
    except NotAGraph as error:
        return b"", str(error)
    except Exception as error:  # a graph whose parts contradict each other
        return b"", f"a graph of {len(payload)} bytes cannot be used: {type(error).__name__} {error}"
