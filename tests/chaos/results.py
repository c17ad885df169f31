"""Outcomes on disk, one a line, so that a run can be cut off and gone on with; and the table that sums them up."""

import statistics
from collections import defaultdict
from pathlib import Path
from typing import Any

import msgspec

from tests.chaos.oracle import ASPECTS
from tests.chaos.voyage import Hit, Outcome


class Results:
    """The outcomes in one folder."""

    def __init__(self, folder: Path) -> None:
        self._lines, self._folder = folder / "outcomes.jsonl", folder
        self.outcomes: list[Outcome] = []
        if self._lines.exists():
            for line in self._lines.read_bytes().splitlines():
                try:
                    self.outcomes.append(msgspec.json.decode(line, type=Outcome))
                except msgspec.DecodeError:  # the last one, cut off
                    break

    @property
    def faults(self) -> int:
        """How many have been done."""
        return sum(len(outcome.hits) for outcome in self.outcomes)

    def voyages(self) -> int:
        """The number after the last voyage."""
        return max((outcome.voyage for outcome in self.outcomes), default=-1) + 1

    def add(self, outcome: Outcome) -> None:
        """Keep one."""
        self.outcomes.append(outcome)
        with self._lines.open("ab") as file:
            file.write(msgspec.json.encode(outcome) + b"\n")

    def summary(self) -> dict[str, Any]:
        """Figures by fault and in all; also written to `chaos.json`."""
        by_fault: dict[str, list[tuple[Hit, Outcome]]] = defaultdict(list)
        for outcome in self.outcomes:
            for hit in outcome.hits:
                by_fault[hit.fault].append((hit, outcome))
        faults = {fault: _figures(found) for fault, found in sorted(by_fault.items())}
        every = [(hit, outcome) for found in by_fault.values() for hit, outcome in found]
        problems = [
            {"voyage": one.voyage, "phase": one.phase, "hits": [f"{h.fault} of {h.target}" for h in one.hits]}
            | {"problems": one.problems, "beside": one.beside}
            for one in self.outcomes
            if one.problems or one.beside
        ]
        found = {
            "faults": faults,
            "all": _figures(every),
            "acknowledged_lost": sum("announced" in text for one in self.outcomes for text in one.problems),
            "ended_without_being_hit": sum(len(one.beside) for one in self.outcomes),
            "comparisons": len(self.outcomes),
            "likeness": {a: min((one.likeness[a] for one in self.outcomes), default=1.0) for a in ASPECTS},
            "largest_mb": _largest(self.outcomes),
            "problems": problems,
        }
        (self._folder / "chaos.json").write_bytes(msgspec.json.format(msgspec.json.encode(found)))
        return found


def table(summary: dict[str, Any]) -> str:
    """Markdown."""
    rows = ["| fault | times | scene equal | s until followed, p50 | max |", "|---|--:|--:|--:|--:|"]
    for name, row in (*summary["faults"].items(), ("all", summary["all"])):
        rows.append(f"| {name} | {row['times']} | {row['equal']} | {row['s_p50']:.1f} | {row['s_max']:.1f} |")
    least = ", ".join(f"{aspect} {share:.3f}" for aspect, share in summary["likeness"].items())
    rows += [
        "",
        f"{summary['comparisons']} comparisons; least likeness: {least}",
        f"acknowledged revisions lost: {summary['acknowledged_lost']}; "
        f"processes that ended without being hit: {summary['ended_without_being_hit']}",
    ]
    return "\n".join(rows)


def _figures(found: list[tuple[Hit, Outcome]]) -> dict[str, Any]:
    seconds = [hit.recovered_s for hit, _ in found if hit.recovered_s is not None]
    return {
        "times": len(found),
        "equal": sum(not outcome.problems for _, outcome in found),
        "s_p50": statistics.median(seconds) if seconds else -1.0,
        "s_max": max(seconds, default=-1.0),
    }


def _largest(outcomes: list[Outcome]) -> dict[str, float]:
    largest: dict[str, float] = {}
    for outcome in outcomes:
        for name, held_mb in outcome.resident_mb.items():
            largest[name] = max(held_mb, largest.get(name, 0.0))
    return largest
