"""Gives damaged inputs to everything that reads what others have written, and tells what became of them.

python -m tests.fuzz --inputs 2000000
"""

import argparse
import contextlib
import importlib.util
import io
import json
import os
import signal
import sys
import time
from pathlib import Path

from tests.fuzz.trial import Crash, Decoder, Tally, written

PROGRESS_S = 10.0


def main() -> int:
    """Exit status 1 where anything crashed, hung or took too much memory, or too few inputs were tried."""
    has_guide = importlib.util.find_spec("atheris") is not None
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description=__doc__.splitlines()[0],
        epilog="example: python -m tests.fuzz --only messages,logs --inputs 50000; what was found lies in --out; it "
        "is moved to tests/fuzz/corpus/NAME/ when it is mended, with the reason as its name",
    )
    parser.add_argument("--inputs", type=int, default=2_000_000, help="in all (default: %(default)s)")
    parser.add_argument("--only", default="", metavar="NAME,…", help="decoders (default: all)")
    parser.add_argument("--seed", type=int, default=1, help="of the mutations (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after these (default: never)")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="folder (default: %(default)s)")
    parser.add_argument(
        "--guided",
        action=argparse.BooleanOptionalAction,
        default=has_guide,
        help="by coverage (pip install 'prior-sg[fuzz]'; default: where that is installed)",
    )
    arguments = parser.parse_args()
    if arguments.guided and not has_guide:
        parser.error("--guided needs Atheris: pip install 'prior-sg[fuzz]'")
    decoders = _instrumented() if arguments.guided else _plain()
    by_name = {decoder.name: decoder for decoder in decoders}
    wanted = [name for name in arguments.only.split(",") if name] or list(by_name)
    if unknown := [name for name in wanted if name not in by_name]:
        parser.error(f"there is no decoder {unknown[0]!r}; known: {', '.join(by_name)}")
    return run(arguments, [by_name[name] for name in wanted])


def _plain() -> tuple[Decoder, ...]:
    from tests.fuzz.decoders import DECODERS

    return DECODERS


def _instrumented() -> tuple[Decoder, ...]:
    """The same, with the product's modules telling which of their lines were reached."""
    import atheris

    with contextlib.redirect_stderr(io.StringIO()), atheris.instrument_imports(include=["prior_sg"]):
        return _plain()


def run(arguments: argparse.Namespace, decoders: list[Decoder]) -> int:
    """All decoders, one after the other; the table."""
    print(f"{'by coverage (Atheris)' if arguments.guided else 'by chance'}, seed {arguments.seed}", flush=True)
    for number in (signal.SIGINT, signal.SIGTERM):  # also where the shell has started us in the background
        signal.signal(number, signal.default_int_handler)
    whole, until = sum(decoder.share for decoder in decoders), time.monotonic() + arguments.seconds
    tallies: dict[str, Tally] = {}
    with contextlib.suppress(KeyboardInterrupt):
        for decoder in decoders:
            tallies[decoder.name] = Tally()
            inputs = -int(-arguments.inputs * decoder.share // whole)
            _tried(decoder, inputs, arguments, until, tallies[decoder.name])
    print(table(tallies), flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = {name: _row(tally) for name, tally in tallies.items()}
    (arguments.out / "fuzz.json").write_text(json.dumps(rows, indent=1))
    print(
        f"written to {arguments.out}: fuzz.json" + (", and each input that was too much" if _crashes(tallies) else "")
    )
    return 1 if _crashes(tallies) or sum(tally.inputs for tally in tallies.values()) < arguments.inputs else 0


def _tried(decoder: Decoder, inputs: int, arguments: argparse.Namespace, until: float, sum_up: Tally) -> None:
    """Children one after the other, until the inputs are tried; each that dies is a crash of its last input."""
    from tests.fuzz import child

    seed = arguments.seed
    while sum_up.inputs < inputs and time.monotonic() < until:
        ledger = child.Ledger()
        way = child.guided if arguments.guided else child.plainly
        status = None
        pid = child.start(child.Watch(decoder, ledger, arguments.out), way, inputs - sum_up.inputs, seed)
        try:
            while (status := child.ended(pid, PROGRESS_S)) is None and time.monotonic() < until:
                print(f"{decoder.name}: {sum_up.inputs + ledger.read()[0].inputs} of {inputs}", flush=True)
        finally:
            if status is None:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
            _add(sum_up, decoder, ledger, status, arguments.out)
        seed += 1000


def _add(sum_up: Tally, decoder: Decoder, ledger: "object", status: int | None, out: Path) -> None:
    tally, is_whole, last = ledger.read()  # type: ignore[attr-defined]
    if status is not None and not is_whole:
        died = {-signal.SIGPROF: "hung"}.get(status, f"died of {status}")
        written(out, decoder.name, [Crash(died, decoder.name, last)])
        sum_up.crashed += 1
        sum_up.inputs += 1
    sum_up.inputs += tally.inputs
    sum_up.accepted += tally.accepted
    sum_up.refused += tally.refused
    sum_up.slowest_ns = max(sum_up.slowest_ns, tally.slowest_ns)
    sum_up.crashed += tally.crashed


def _crashes(tallies: dict[str, Tally]) -> int:
    return sum(tally.crashed for tally in tallies.values())


def _row(tally: Tally) -> dict[str, float]:
    return {
        "inputs": tally.inputs,
        "accepted": tally.accepted,
        "refused": tally.refused,
        "slowest_ms": round(tally.slowest_ns / 1e6, 1),
        "crashes": tally.crashed,
    }


def table(tallies: dict[str, Tally]) -> str:
    """As Markdown."""
    names = ("inputs", "accepted", "refused", "slowest_ms", "crashes")
    lines = ["| decoder | inputs | accepted | refused | slowest ms | crashes |", "|---|---|---|---|---|---|"]
    rows = {name: _row(tally) for name, tally in tallies.items()}
    slowest = max((row["slowest_ms"] for row in rows.values()), default=0)
    rows["all"] = {name: sum(row[name] for row in rows.values()) for name in names} | {"slowest_ms": slowest}
    lines += [
        f"| {name} | {' | '.join(f'{row[field]:g}' if field == 'slowest_ms' else str(row[field]) for field in names)} |"
        for name, row in rows.items()
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
