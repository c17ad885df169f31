"""How long and how much: one robot for an hour, or robots times rate until something is dropped.

python -m tests.endurance soak --seconds 3600 --rate 5 --out out/soak
python -m tests.endurance load --robots 1,2,4 --rates 1,2,5,10 --workers 1,2,4 --out out/load
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

import msgspec

from tests.chaos.streams import SAMPLE_NAME, made
from tests.endurance.edge import Plan
from tests.endurance.load import load
from tests.endurance.meter import Late
from tests.endurance.plots import draw
from tests.endurance.soak import soak

SLACK = 60  # keyframes more than are due


def numbers(kind: type) -> object:
    """An argument of several numbers."""
    return lambda text: tuple(kind(part) for part in text.split(","))


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.endurance",
        description=__doc__.splitlines()[0],
        epilog="example: python -m tests.endurance soak --seconds 600 --rate 5 --out out/soak",
    )
    parser.add_argument("what", choices=("soak", "load"))
    parser.add_argument("--seconds", type=float, default=0.0, help="default: 3600 of a soak, 30 of each load")
    parser.add_argument("--rate", type=float, default=5.0, help="keyframes a second of a soak (default: %(default)g)")
    parser.add_argument("--robots", type=numbers(int), default=(1, 2, 4), help="of a load (default: 1,2,4)")
    parser.add_argument("--rates", type=numbers(float), default=(1.0, 2.0, 5.0, 10.0), help="default: 1,2,5,10")
    parser.add_argument("--workers", type=numbers(int), default=(1, 2, 4), help="of a load (default: 1,2,4)")
    parser.add_argument("--stream", default=SAMPLE_NAME, help="sample or world:KIND:SEED (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/endurance"), help="folder (default: %(default)s)")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    work = given.out / "work"
    shutil.rmtree(work, ignore_errors=True)

    def say(text: str) -> None:
        print(text, flush=True)

    if given.what == "soak":
        seconds = given.seconds or 3600.0
        stream = made(given.stream, int(seconds * given.rate) + SLACK, given.out)
        figures, looks = soak(stream, Plan(1, given.rate), seconds, work, say)
        lateness = [
            msgspec.json.decode(line, type=Late) for line in (work / "lateness.jsonl").read_bytes().splitlines()
        ]
        draw(looks, lateness, given.out / "soak.png")
    else:
        seconds = given.seconds or 30.0
        stream = made(given.stream, int((seconds + SLACK) * max(given.rates)), given.out)
        plans = (
            [Plan(robots, rate_hz, workers) for rate_hz in given.rates]
            for workers in given.workers
            for robots in given.robots
        )
        figures = load(stream, plans, seconds, work, say)
    (given.out / f"{given.what}.json").write_text(json.dumps(figures, indent=1))
    say(json.dumps(figures, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
