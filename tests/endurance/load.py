"""Robots times rate until something is dropped, and where the time goes, with one worker and more."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from tests.chaos.streams import Stream
from tests.endurance.edge import Edge, Plan
from tests.endurance.meter import Look, Meter, percentiles

SETTLE_S = 3.0  # after the source has begun, which is not measured
LATEST_S = 2.0  # at which half of the keyframes are mapped and segmented, or the system does not follow
KEPT_UP = 0.95  # share of the keyframes due that must have come


def step(stream: Stream, plan: Plan, seconds: float, folder: Path) -> dict[str, Any]:
    """One load for some seconds: what came of the keyframes that were due, how late, and who worked."""
    with Edge(stream, plan, folder) as edge:
        meter = Meter(edge)
        edge.stream_now()
        time.sleep(SETTLE_S)
        first = meter.look()
        time.sleep(seconds)
        last = meter.look()
        edge.check()
        dropped = sum(state.skipped for state in edge.ingest.values())
    lateness = [one for one in meter.lateness() if first.at_s <= one.at_s < last.at_s - LATEST_S]
    due = plan.robots * plan.rate_hz * (last.at_s - first.at_s - LATEST_S)
    figures = {
        "robots": plan.robots,
        "rate_hz": plan.rate_hz,
        "workers": plan.workers,
        "came": len(lateness) / due,
        "dropped": dropped,
        "place": percentiles([one.place_s for one in lateness]),
        "pyramid": percentiles([one.pyramid_s for one in lateness]),
        "segmented": percentiles([one.segmented_s for one in lateness]),
        "cores": cores(first, last),
    }
    return figures | {"follows": follows(figures)}


def follows(figures: dict[str, Any]) -> bool:
    """Whether the system keeps up with this load: keyframes come at their rate, none is dropped, and what follows them
    does not pile up."""
    return bool(
        figures["came"] >= KEPT_UP
        and not figures["dropped"]
        and all(
            late["count"]
            and late["never"] <= (1 - KEPT_UP) * (late["count"] + late["never"])
            and late["p50_s"] <= LATEST_S
            for late in (figures["place"], figures["segmented"])
        )
    )


def cores(first: Look, last: Look) -> dict[str, float]:
    """Shares of a core that each service took, all its processes together."""
    found: dict[str, float] = {}
    for name, process in last.processes.items():
        service = name.split("-")[0]
        before_s = first.processes[name].worked_s if name in first.processes else 0.0
        share = (process.worked_s - before_s) / (last.at_s - first.at_s)
        found[service] = found.get(service, 0.0) + share
    return found


def load(
    stream: Stream, plans: Iterable[Sequence[Plan]], seconds: float, folder: Path, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Of each sequence of plans, one after another until the system does not follow."""
    rows = []
    for growing in plans:
        for plan in growing:
            name = f"{plan.robots} robots, {plan.rate_hz:g} Hz, {plan.workers} workers"
            row = step(stream, plan, seconds, folder / name.replace(", ", "-").replace(" ", ""))
            rows.append(row)
            segmented = row["segmented"]
            late = f"{segmented['p50_s']:.2f} / {segmented['p99_s']:.2f} s"
            say(f"{name}: segmented after {late}, follows: {row['follows']}")
            if not row["follows"]:
                break
    return rows
