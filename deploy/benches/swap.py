"""`prior-sg bench swap`: cold and incremental energy minimisation against gco-wrapper's α-β-swap and a dual bound.

Times are of this process alone and compiled code is warm. Energies count from each place's cheapest label, so that a
constant in the costs flatters no ratio.
"""

import copy
import functools
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from prior_sg.deploy.benches.fields import LABELS, place_field
from prior_sg.services.segmenter.core.energy.bound import lower_bound
from prior_sg.services.segmenter.core.energy.mrf import Field, energy
from prior_sg.services.segmenter.core.energy.solver import Solver, minimise
from prior_sg.services.segmenter.core.map.arcs import Arcs, arcs_of

SIZES = (500, 2_000, 10_000, 50_000)
MAIN_SIZE = 10_000  # the one whose figures carry no suffix
BOUND_SIZES = (500, 2_000)
BOUND_FIELDS = 4  # of each size
REPEATS = 3
LARGE = 50_000  # from which on a fresh solve is timed once
STEPS = {1_000: 100, 10_000: 60, 50_000: 12}  # updates of a stream, by places
COLD_EVERY = {1_000: 1, 10_000: 3, 50_000: 4}  # steps at which one is compared with a fresh solve
CHANGED_SHARE = 0.01
CHANGED_PLACES = 100  # of the streams that show whether an update's time depends on the field's size


def swap_bench() -> tuple[dict[str, Any], dict[str, Any]]:
    """All figures and the settings."""
    minimise(bench_field(50, 0), np.zeros(50, np.int64))  # loads the compiled code
    metrics: dict[str, Any] = {}
    for places in SIZES:
        metrics |= suffixed(cold(places), places)
    metrics |= dual_bound()
    for places, steps in STEPS.items():
        settled = Solver()
        settled.take(bench_field(places, 0), bench_field(places, 0).unary.argmin(axis=1))
        settled.drain()
        metrics |= suffixed(stream(settled, int(CHANGED_SHARE * places), steps, cold_every=COLD_EVERY[places]), places)
        constant = stream(settled, CHANGED_PLACES, steps)
        metrics[f"update_ms_of_{CHANGED_PLACES}_places_{places}"] = constant["incremental_ms_p50"]
        rewired = stream(settled, CHANGED_PLACES, steps, rewired=True)
        metrics[f"update_ms_of_{CHANGED_PLACES}_places_rewired_{places}"] = rewired["incremental_ms_p50"]
    settings = {"labels": LABELS, "places": SIZES, "changed_share": CHANGED_SHARE, "steps": list(STEPS.values())}
    settings |= {"repeats": REPEATS, "repeats_of_large": 1, "cold_every": list(COLD_EVERY.values())}
    return metrics, settings | {"bound_fields": BOUND_FIELDS}


def suffixed(metrics: dict[str, float], places: int) -> dict[str, float]:
    """The figures' names with the size, except for the main one."""
    return metrics if places == MAIN_SIZE else {f"{name}_{places}": value for name, value in metrics.items()}


@functools.cache
def bench_field(places: int, seed: int) -> Field:
    """A random field whose costs count from each place's cheapest label."""
    field = place_field(places, np.random.default_rng([places, seed]))
    return field._replace(unary=field.unary - field.unary.min(axis=1, keepdims=True))


def cold(places: int) -> dict[str, float]:
    """One field from scratch, ours and gco's in turn; medians of several where it is not large."""
    import gco

    field = bench_field(places, 0)
    start = field.unary.argmin(axis=1)
    edges, start_32 = field.edges.astype(np.int32), start.astype(np.int32)

    def theirs() -> np.ndarray:
        costs = (field.weights, field.unary, field.pairwise)  # gco counts in integers; the wrapper scales and rounds
        return np.asarray(gco.cut_general_graph(edges, *costs, n_iter=-1, algorithm="swap", init_labels=start_32))

    spent: dict[str, list[float]] = {"ours": [], "theirs": []}
    for _ in range(1 if places >= LARGE else REPEATS):
        seconds, our_labels = timed(lambda: minimise(field, start))
        spent["ours"].append(seconds)
        seconds, their_labels = timed(theirs)
        spent["theirs"].append(seconds)
    ours_s, theirs_s = statistics.median(spent["ours"]), statistics.median(spent["theirs"])
    return {
        "cold_time_ratio_gco": ours_s / theirs_s,
        "cold_energy_ratio_gco": energy(field, our_labels) / energy(field, their_labels),
        "cold_ms": 1e3 * ours_s,
        "gco_ms": 1e3 * theirs_s,
    }


def dual_bound() -> dict[str, float]:
    """Energy ÷ dual bound after a fresh solve and after idle time: the mean over the fields, and the worst field."""
    fresh, idle = [], []
    for places in BOUND_SIZES:
        for seed in range(BOUND_FIELDS):
            field, solver = bench_field(places, seed), Solver()
            bound, start = lower_bound(field), field.unary.argmin(axis=1)
            fresh.append(energy(field, minimise(field, start)) / bound)
            solver.take(field, start)
            idle.append(energy(field, solver.drain()) / bound)
    return {
        "dual_bound_ratio": statistics.mean(fresh),
        "dual_bound_ratio_worst": max(fresh),
        "dual_bound_ratio_idle": statistics.mean(idle),
        "dual_bound_ratio_idle_worst": max(idle),
    }


def stream(
    settled: Solver, changed: int, steps: int, *, cold_every: int = 0, rewired: bool = False
) -> dict[str, float]:
    """Updates that each change the costs of `changed` places around one; the solver is drained between two updates.

    `settled` has solved the field that they start from. Every `cold_every` steps a fresh solve is made as well, 0 =
    never. `rewired`, the weights of their edges change too, so that the solver has to take up the whole graph again.
    """
    solver, places = copy.deepcopy(settled), len(settled.labels)
    rng, field, labels = np.random.default_rng([places, changed]), bench_field(places, 0), solver.labels.copy()
    graph = arcs_of(places, field.edges, field.weights)
    solver.take(field, labels, dirty=np.zeros(0, np.int64))  # these very arrays, which the copy does not have
    update_s, cold_s, drain_s, gaps = [], [], [], []
    for step in range(steps):
        rows = around(int(rng.integers(places)), changed, graph)
        field = field._replace(unary=revised(field.unary, rows, rng))
        if rewired:
            weights = field.weights.copy()
            weights[np.isin(field.edges, rows).any(axis=1)] *= rng.uniform(0.8, 1.25)
            field = field._replace(weights=weights)
            dirty = np.union1d(rows, field.edges[np.isin(field.edges, rows).any(axis=1)])
        else:
            dirty = rows
        seconds, updated = timed(lambda: solver.update(field, labels, dirty=dirty))  # noqa: B023 (called at once)
        update_s.append(seconds)
        if cold_every and step % cold_every == 0:
            seconds, fresh = timed(lambda: minimise(field, field.unary.argmin(axis=1)))  # noqa: B023 (at once)
            cold_s.append(seconds)
            gaps.append(energy(field, updated) / energy(field, fresh) - 1.0)
        seconds, labels = timed(solver.drain)
        drain_s.append(seconds)
    figures = {
        "incremental_ms_p50": 1e3 * statistics.median(update_s),
        "incremental_ms_p99": 1e3 * float(np.percentile(update_s, 99)),
        "drain_ms_p50": 1e3 * statistics.median(drain_s),
    }
    if cold_every:
        figures["incremental_time_ratio"] = statistics.median(update_s) / statistics.median(cold_s)
        figures["incremental_energy_gap"] = float(np.percentile(gaps, 99))
        figures["incremental_energy_gap_mean"] = statistics.mean(gaps)
    return figures


def around(center: int, count: int, graph: Arcs) -> np.ndarray:
    """The `count` places that are fewest steps from `center`."""
    found, reached = [center], {center}
    for place in found:
        if len(found) >= count:
            break
        for neighbour in graph.neighbours[graph.starts[place] : graph.starts[place + 1]].tolist():
            if neighbour not in reached:
                reached.add(neighbour)
                found.append(neighbour)
    return np.array(found[:count])


def revised(unary: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """New evidence: half of the old costs, noise, and one new favourite of all the rows."""
    after = unary.copy()
    after[rows] = (
        0.5 * after[rows] + rng.normal(0, 0.5, (len(rows), unary.shape[1])) + rng.uniform(0, 1, unary.shape[1])
    )
    after[rows] -= after[rows].min(axis=1, keepdims=True)
    return after


def timed(run: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    """Processor seconds of a call, and what it returned."""
    started_s = time.process_time()
    answer = run()
    return time.process_time() - started_s, answer
