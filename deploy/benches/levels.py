"""`prior-sg bench levels`: levels above regions in generated houses, clinics and campuses."""

import math
import statistics
import tempfile
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from prior_sg.deploy.evaluation import levels
from prior_sg.deploy.evaluation.datasets import WorldName
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.methods import Case
from prior_sg.deploy.evaluation.perception import Cache, Perceiver
from prior_sg.services.segmenter.core.config import Config

ENCODER = "simlike:0.2"
WORLDS = (  # used for nothing but this
    WorldName("house", 60),
    WorldName("house", 61),
    WorldName("clinic", 60),
    WorldName("campus", 60),
)

Report = Callable[[str], None]


def levels_bench(
    worlds: Sequence[WorldName] = WORLDS, encoder: str = ENCODER, report: Report = lambda text: None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Scores by kind and level, means and standard deviations over worlds. `report` hears how far it is. Raises
    EvaluationError for a kind whose truth knows no levels."""
    other = [world.kind for world in worlds if world.kind not in levels.TASKS]
    if other:
        raise EvaluationError(f"{other[0]} has no levels above regions: name worlds of {', '.join(levels.TASKS)}")
    found = dict[str, list[float]]()
    with tempfile.TemporaryDirectory() as folder:
        for number, world in enumerate(worlds, 1):
            where = f"world {number} of {len(worlds)}: {world.kind} {world.seed}"
            for name, value in world_figures(world, encoder, Config(), Path(folder), partial(_told, report, where)):
                found.setdefault(f"{world.kind}_{name}", []).append(value)
    metrics: dict[str, Any] = {name: _mean(values) for name, values in found.items()}
    metrics |= {f"{name}_sd": statistics.pstdev(values) for name, values in found.items()}
    return metrics, {"worlds": [f"world:{world.kind}:{world.seed}" for world in worlds], "encoder": encoder}


def world_figures(
    world: WorldName, encoder: str, config: Config, folder: Path, report: Callable[[str, int, int], None]
) -> Iterable[tuple[str, float]]:
    """The figures of one world by name; `folder` keeps what was perceived."""
    dataset = levels.dataset_of(world)
    perceiver = Perceiver({}, Cache(folder), report, encoder)
    deltas = perceiver.walk(dataset)
    case = Case(perceiver.perceive(dataset), dataset.prior, dataset.truth, dataset.objects)
    return levels.figures(levels.walk(case, deltas, config), case).items()


def _told(report: Report, where: str, what: str, done: int, whole: int) -> None:
    report(f"{where}, frame {done} of {whole} ({what})")


def _mean(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return statistics.mean(known) if known else float("nan")
