"""`prior-sg bench levels`: levels above regions in generated houses, clinics and campuses."""

import math
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prior_sg.deploy.evaluation import levels
from prior_sg.deploy.evaluation.methods import Case
from prior_sg.deploy.evaluation.perception import Cache, Perceiver
from prior_sg.services.segmenter.core.config import Config

ENCODER = "simlike:0.2"
SEEDS = {"house": (60, 61), "clinic": (60,), "campus": (60,)}  # used for nothing but this


def levels_bench(
    seeds: dict[str, Sequence[int]] | None = None, encoder: str = ENCODER, config: Config | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Scores by kind and level, means and standard deviations over worlds."""
    chosen, found = SEEDS if seeds is None else seeds, dict[str, list[float]]()
    with tempfile.TemporaryDirectory() as folder:
        for kind, numbers in chosen.items():
            for seed in numbers:
                for name, value in world_figures(kind, seed, encoder, config or Config(), Path(folder)).items():
                    found.setdefault(f"{kind}_{name}", []).append(value)
    metrics: dict[str, Any] = {name: _mean(values) for name, values in found.items()}
    metrics |= {f"{name}_sd": statistics.pstdev(values) for name, values in found.items()}
    return metrics, {"seeds": {kind: list(numbers) for kind, numbers in chosen.items()}, "encoder": encoder}


def world_figures(kind: str, seed: int, encoder: str, config: Config, folder: Path) -> dict[str, float]:
    """The figures of one world; `folder` keeps what was perceived."""
    dataset = levels.dataset_of(kind, seed)
    perceiver = Perceiver({}, Cache(folder), lambda *_: None, encoder)
    deltas = perceiver.walk(dataset)
    case = Case(perceiver.perceive(dataset), dataset.prior, dataset.truth, dataset.objects)
    return levels.figures(levels.walk(case, deltas, config), case)


def _mean(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return statistics.mean(known) if known else float("nan")
