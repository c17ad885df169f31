"""Disturbs whole systems by a schedule drawn from a seed, and compares what they map with undisturbed ones.

python -m tests.chaos --faults 300 --seed 1 --out out/chaos
"""

import argparse
import contextlib
import shutil
import signal
import sys
import time
from pathlib import Path

from tests.chaos import machine
from tests.chaos.faults import FAULTS
from tests.chaos.results import Results, table
from tests.chaos.schedule import BY_NAME, planned
from tests.chaos.streams import SAMPLE_NAME, made
from tests.chaos.voyage import reference, sailed

PHASES = 14  # of a voyage, at most
STREAMS = (SAMPLE_NAME, "world:home:3", "world:office:5")


def main() -> int:
    """Exit status 1 where anything was not as it ought to be."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.chaos",
        description=__doc__.splitlines()[0],
        epilog="example: python -m tests.chaos --faults 300 --seed 1 --out out/chaos; the same command goes on after "
        "Ctrl-C",
    )
    parser.add_argument("--faults", type=int, default=300, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the schedule (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/chaos"), help="folder (default: %(default)s)")
    parser.add_argument("--only", default="", metavar="FAULT,…", help=f"of {', '.join(FAULTS)}")
    parser.add_argument("--streams", default=",".join(STREAMS), help="sample, world:KIND:SEED (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=240, help="of a stream (default: %(default)s)")
    parser.add_argument("--together", type=int, default=2, help="most faults in one phase (default: %(default)s)")
    parser.add_argument("--lasting-ids", action="store_true", help="ids of regions and objects must be equal too")
    parser.add_argument("--keep", action="store_true", help="keep the files of every voyage, not of faulty ones alone")
    arguments = parser.parse_args()
    wanted = [name for name in arguments.only.split(",") if name] or list(FAULTS)
    if unknown := [name for name in wanted if name not in FAULTS]:
        parser.error(f"there is no fault {unknown[0]!r}; known: {', '.join(FAULTS)}")
    machine.enter(sys.argv[1:])
    return run(arguments, wanted)


def run(arguments: argparse.Namespace, wanted: list[str]) -> int:
    """All voyages that are wanted, those of an earlier run counted."""
    there = machine.means()
    names = [name for name in wanted if BY_NAME[name].needs in ({""} | there)]
    if missing := sorted(set(wanted) - set(names)):
        print(f"left out, for this machine does not allow them: {', '.join(missing)}", flush=True)
    for number in (signal.SIGINT, signal.SIGTERM):  # also where the shell has started us in the background
        signal.signal(number, signal.default_int_handler)
    arguments.out.mkdir(parents=True, exist_ok=True)
    results, began_s, before = Results(arguments.out), time.monotonic(), 0
    before = results.faults
    with contextlib.suppress(KeyboardInterrupt):
        while results.faults < arguments.faults:
            done = results.faults
            _voyage(arguments, results, names)
            if results.faults == done:
                print("no fault could be done: the system did not come to rest before the first", flush=True)
                break
            spent_s = time.monotonic() - began_s
            rate_s = spent_s / max(results.faults - before, 1)
            left_s = rate_s * max(arguments.faults - results.faults, 0)
            print(
                f"{results.faults} of {arguments.faults} faults, {spent_s:.0f} s; about {left_s:.0f} s left", flush=True
            )
    summary = results.summary()
    print(table(summary), flush=True)
    print(f"written to {arguments.out}: chaos.json, outcomes.jsonl", flush=True)
    return 1 if summary["problems"] or results.faults < arguments.faults else 0


def _voyage(arguments: argparse.Namespace, results: Results, names: list[str]) -> None:
    number = results.voyages()
    streams = arguments.streams.split(",")
    stream = made(streams[number % len(streams)], arguments.frames, arguments.out)
    known = reference(stream, arguments.out, lambda text: print(text, flush=True))
    phases = planned(arguments.seed, number, PHASES, names, arguments.together)
    folder = arguments.out / f"voyage-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    faulty = False
    with contextlib.ExitStack() as ending:
        small = any(plan.fault == "full disk" for phase in phases for plan in phase)
        disk = ending.enter_context(machine.small_disk(folder / "disk")) if small else None
        for outcome in sailed(number, stream, known, phases, folder, disk=disk, lasting=arguments.lasting_ids):
            results.add(outcome)
            faulty = faulty or bool(outcome.problems)
            hits = ", ".join(f"{hit.fault} of {hit.target} {hit.recovered_s} s" for hit in outcome.hits)
            print(f"{number}.{outcome.phase} {hits}: {'; '.join(outcome.problems) or 'equal'}", flush=True)
            for text in outcome.beside:
                print(f"    not hit, and ended: {text}", flush=True)
    if not faulty and not arguments.keep:
        shutil.rmtree(folder)


if __name__ == "__main__":
    sys.exit(main())
