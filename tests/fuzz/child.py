"""Inputs of one decoder in a process of their own, which a hang or a fault of native code may end."""

import contextlib
import logging
import mmap
import os
import resource
import signal
import struct
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random

import cv2

from tests.fuzz.mutators import LONGEST, mutated
from tests.fuzz.trial import Decoder, Tally, inputs_of, written

HANG_S = 2.0  # of processor, for one input
GROWTH_KB = 500 * 1024
MOST_BYTES = 8 << 30  # of address space: what asks for more is told so
HEAD = struct.Struct("<7Q")  # inputs, accepted, refused, slowest, crashes, length of the input tried now, 1 = ended
EVERY = 64  # inputs, after which the counts are written


class Ledger:
    """What parent and child both see: counts, and the input that is being tried."""

    def __init__(self) -> None:
        self._shared = mmap.mmap(-1, HEAD.size + LONGEST)

    def read(self) -> tuple[Tally, bool, bytes]:
        """Counts, whether the child came to its end, and the last input."""
        *counts, length, ended = HEAD.unpack_from(self._shared)
        data = self._shared[HEAD.size : HEAD.size + length]
        return Tally(*counts), bool(ended), data

    def trying(self, data: bytes) -> None:
        struct.pack_into("<Q", self._shared, 40, len(data))
        self._shared[HEAD.size : HEAD.size + len(data)] = data

    def write(self, tally: Tally, ended: bool = False) -> None:
        counts = (tally.inputs, tally.accepted, tally.refused, tally.slowest_ns, tally.crashed)
        HEAD.pack_into(self._shared, 0, *counts, HEAD.unpack_from(self._shared)[5], int(ended))


class Watch:
    """Tries inputs under limits of time and memory."""

    def __init__(self, decoder: Decoder, ledger: Ledger, out: Path) -> None:
        self.decoder, self.ledger, self.out, self.tally = decoder, ledger, out, Tally()
        self._base_kb = 0

    def run(self, data: bytes) -> None:
        """One input; a hang ends the process by a signal, which the parent sees."""
        self.ledger.trying(data)
        signal.setitimer(signal.ITIMER_PROF, HANG_S)
        self.tally.run(self.decoder, data)
        peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        self._base_kb = self._base_kb or peak_kb
        if peak_kb - self._base_kb > GROWTH_KB:
            self.tally.crash(f"memory grew to {peak_kb} kB", self.decoder.name, data)
            self._base_kb = peak_kb
        if self.tally.crashes:
            written(self.out, self.decoder.name, self.tally.crashes)
            self.tally.crashes.clear()
        if self.tally.inputs % EVERY == 0:
            self.ledger.write(self.tally)

    def end(self) -> None:
        self.ledger.write(self.tally, ended=True)


def plainly(watch: Watch, inputs: int, seed: int) -> None:
    """Mutations by chance."""
    for data, _ in zip(inputs_of(watch.decoder, seed), range(inputs), strict=False):
        watch.run(data)


def guided(watch: Watch, inputs: int, seed: int) -> None:
    """Mutations of inputs that reached lines which none had reached before, by Atheris and our own ways."""
    import atheris

    pool = watch.decoder.begin()
    waiting = iter(pool)

    def mutate(data: bytes, most: int, number: int) -> bytes:
        rng = Random(number)
        if rng.random() < 0.3:
            return atheris.Mutate(data, most)
        return mutated(rng, data if rng.random() < 0.9 else rng.choice(pool), pool, watch.decoder.mutators)[:most]

    def one(data: bytes) -> None:
        watch.run(data)
        if watch.tally.inputs >= inputs:
            watch.end()
            os._exit(0)

    with contextlib.suppress(StopIteration):
        while watch.tally.inputs < min(inputs, len(pool)):
            watch.run(next(waiting))
    options = ("-runs=-1", f"-seed={seed + 1}", f"-max_len={LONGEST}", "-timeout=0", "-rss_limit_mb=0", "-verbosity=0")
    folder = watch.out / "pools" / watch.decoder.name
    folder.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(pool):
        (folder / f"{number:04}").write_bytes(data)
    handled = (
        f"-handle_{name}=0" for name in ("segv", "bus", "abrt", "ill", "fpe", "int", "term", "xfsz", "usr1", "usr2")
    )
    atheris.Setup([sys.argv[0], *options, *handled, str(folder)], one, custom_mutator=mutate)
    atheris.Fuzz()


def start(watch: Watch, way: Callable[..., None], inputs: int, seed: int) -> int:
    """Fork; the child's process id."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        logging.disable(logging.CRITICAL)
        warnings.simplefilter("ignore")
        cv2.setNumThreads(0)
        with Path(os.devnull).open("wb") as nothing:
            os.dup2(nothing.fileno(), 2)  # decoders of images tell every fault there
            os.dup2(nothing.fileno(), 1)
        way(watch, inputs, seed)
        watch.end()
        status = 0
    finally:
        os._exit(status)


def ended(pid: int, wait_s: float) -> int | None:
    """The child's exit status, or minus the signal that ended it; None while it runs."""
    until = time.monotonic() + wait_s
    while True:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            return None
        time.sleep(0.1)
