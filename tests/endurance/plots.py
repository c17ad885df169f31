"""Pictures of a soak: memory, handles and lateness over time."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

from tests.endurance.meter import Late, Look


def draw(looks: list[Look], lateness: list[Late], path: Path) -> None:
    """One PNG."""
    figure, (memory, handles, late) = plt.subplots(3, 1, figsize=(9, 10), sharex=True, layout="constrained")
    for name in sorted({name for look in looks for name in look.processes}):
        found = [(look.at_s / 60, look.processes[name]) for look in looks if name in look.processes]
        minutes = [at_min for at_min, _ in found]
        memory.plot(minutes, [one.resident_mb for _, one in found], label=name)
        handles.plot(minutes, [one.handles for _, one in found], label=name)
    for kind in ("place_s", "pyramid_s", "segmented_s"):
        came = [(one.at_s / 60, getattr(one, kind)) for one in lateness if getattr(one, kind) is not None]
        late.plot(*zip(*came, strict=True), ".", markersize=2, label=kind.removesuffix("_s"))
    for axes, what in ((memory, "resident MB"), (handles, "open handles"), (late, "s after the keyframe")):
        axes.set_ylabel(what)
        axes.legend(fontsize=7, ncols=2)
        axes.grid(alpha=0.3)
    late.set_yscale("log")
    late.set_xlabel("minutes")
    figure.savefig(path, dpi=90)
    plt.close(figure)
