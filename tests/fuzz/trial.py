"""One input at a time: taken, refused as it should be, or a crash."""

import hashlib
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.mutators import Mutator, mutated

CORPUS = Path(__file__).parent / "corpus"
KEPT = 4096  # inputs that others are made from, of one decoder


@dataclass(frozen=True)
class Decoder:
    """A row of the table: inputs to begin with, what reads one, what it may raise, and ways that keep its structure."""

    name: str
    seeds: Callable[[], list[bytes]]
    decode: Callable[[bytes], Any]
    refuses: tuple[type[Exception], ...] = ()
    mutators: tuple[Mutator, ...] = ()
    share: float = 1.0  # of the inputs, beside those of other decoders; those that are slow get fewer

    def corpus(self) -> list[Path]:
        """Inputs that once were too much; a file's name is the reason."""
        return sorted((CORPUS / self.name).glob("*"))

    def begin(self) -> list[bytes]:
        """What other inputs are made from."""
        return [*self.seeds(), *(path.read_bytes() for path in self.corpus())]


@dataclass
class Crash:
    """What was raised that must not be, where, and by what."""

    what: str
    where: str
    data: bytes


@dataclass
class Tally:
    """What became of the inputs of one decoder."""

    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    slowest_ns: int = 0  # of processor
    crashed: int = 0
    crashes: list[Crash] = field(default_factory=list)

    def run(self, decoder: Decoder, data: bytes) -> bool:
        """Whether the input was accepted."""
        self.inputs += 1
        began_ns = time.thread_time_ns()
        try:
            decoder.decode(data)
            self.accepted += 1
            return True
        except decoder.refuses:
            self.refused += 1
        except Exception as error:
            self.crash(repr(error)[:200], _place(error), data)
        finally:
            self.slowest_ns = max(self.slowest_ns, time.thread_time_ns() - began_ns)
        return False

    def crash(self, what: str, where: str, data: bytes) -> None:
        """One more, of which the input is kept."""
        self.crashed += 1
        self.crashes.append(Crash(what, where, data))


def _place(error: BaseException) -> str:
    """The innermost line of the product, else of anything."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/tests/" not in frame.filename and "/site-packages/" not in frame.filename]
    last = (own or frames)[-1]
    return f"{'/'.join(Path(last.filename).parts[-3:])}:{last.lineno}"


def inputs_of(decoder: Decoder, seed: int) -> Iterator[bytes]:
    """What it begins with, then mutations without end, of those and of a few of the mutations."""
    rng = Random(f"{decoder.name}/{seed}")
    pool = decoder.begin()
    yield from pool
    fixed = len(pool)
    while True:
        data = mutated(rng, rng.choice(pool), pool[:fixed], decoder.mutators)
        if rng.random() < 0.01:
            if len(pool) < KEPT:
                pool.append(data)
            else:
                pool[rng.randrange(fixed, KEPT)] = data
        yield data


def tried(decoder: Decoder, inputs: int, seed: int) -> Tally:
    """Some inputs in this process."""
    tally = Tally()
    for data, _ in zip(inputs_of(decoder, seed), range(inputs), strict=False):
        tally.run(decoder, data)
    return tally


def written(folder: Path, decoder: str, crashes: Sequence[Crash]) -> None:
    """Keep the shortest input for each place and kind of crash."""
    (folder / decoder).mkdir(parents=True, exist_ok=True)
    for crash in crashes:
        kind = hashlib.blake2b(f"{crash.where}{crash.what.partition('(')[0]}".encode(), digest_size=4).hexdigest()
        path = folder / decoder / f"{kind}.input"
        if not path.exists() or path.stat().st_size > len(crash.data):
            path.write_bytes(crash.data)
            path.with_suffix(".txt").write_text(f"{crash.what}\n{crash.where}\n", encoding="utf-8", errors="replace")
