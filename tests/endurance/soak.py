"""One robot for an hour: whether memory, handles and lateness stay what they were."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.chaos.streams import Stream
from tests.endurance.edge import Edge, Plan
from tests.endurance.meter import Look, Meter, kept, percentiles, slope_per_hour

LOOK_S = 10.0
WINDOW_S = 600.0  # at the beginning and at the end, whose lateness is compared
WARM = 1 / 6  # share of the time that is left out of the slopes: what is filled once is filled then


def soak(
    stream: Stream, plan: Plan, seconds: float, folder: Path, say: Callable[[str], None]
) -> tuple[dict[str, Any], list[Look]]:
    """Figures, and what they were made from, which is written to the folder as well."""
    events: list[str] = []
    with Edge(stream, plan, folder, record=True) as edge:
        meter = Meter(edge)
        edge.stream_now()
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            events += edge.check()
            look = meter.look()
            say(
                f"{look.at_s:6.0f} s, {look.keyframes} keyframes, "
                f"{sum(one.resident_mb for one in look.processes.values()):.0f} MB"
            )
            time.sleep(min(LOOK_S, left_s))
        meter.look()
        skipped = {robot: state.skipped for robot, state in edge.ingest.items()}
    lateness = meter.lateness()
    kept(folder / "looks.jsonl", meter.looks)
    kept(folder / "lateness.jsonl", lateness)
    return summed(meter.looks, lateness, min(WINDOW_S, seconds / 3)) | {
        "plan": {"robots": plan.robots, "rate_hz": plan.rate_hz, "workers": plan.workers},
        "skipped": skipped,
        "started_again": events,
    }, meter.looks


def summed(looks: list[Look], lateness: list, window_s: float) -> dict[str, Any]:
    """The table: of each process how it grows, of the whole how late it is first and last."""
    first_s, last_s = lateness[0].at_s, lateness[-1].at_s
    steady = [look for look in looks if look.at_s >= first_s + WARM * (last_s - first_s)]
    names = sorted({name for look in looks for name in look.processes})
    span_s = looks[-1].at_s - looks[0].at_s
    return {
        "seconds": last_s - first_s,
        "keyframes": len(lateness),
        "processes": {name: _figures(looks, steady, name, span_s) for name in names},
        "disk_mb_per_hour": slope_per_hour(steady, lambda look: look.disk_mb),
        **{
            f"{kind}_{when}": percentiles([getattr(one, f"{kind}_s") for one in found])
            for kind in ("place", "pyramid", "segmented")
            for when, found in (
                ("first", [one for one in lateness if one.at_s < first_s + window_s]),
                # What came last may still be under way.
                ("last", [one for one in lateness if last_s - window_s - 5 < one.at_s <= last_s - 5]),
            )
        },
    }


def _figures(looks: list[Look], steady: list[Look], name: str, span_s: float) -> dict[str, float]:
    there = [look.processes[name] for look in looks if name in look.processes]

    def of(field: str) -> Callable[[Look], float | None]:
        return lambda look: getattr(look.processes[name], field) if name in look.processes else None

    return {
        "resident_mb_first": there[0].resident_mb,
        "resident_mb_last": there[-1].resident_mb,
        "resident_mb_most": max(one.resident_mb for one in there),
        "resident_mb_per_hour": slope_per_hour(steady, of("resident_mb")),
        "handles_per_hour": slope_per_hour(steady, of("handles")),
        "threads_per_hour": slope_per_hour(steady, of("threads")),
        "cores": (there[-1].worked_s - there[0].worked_s) / max(span_s, 1e-9),
    }
