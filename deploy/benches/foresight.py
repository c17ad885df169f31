"""`prior-sg bench foresight`: are regions foreseen before they are seen, and does that shorten searches?

In generated worlds of every kind an explorer sees by lines of sight and takes some regions for others; see
`prior_sg.deploy.evaluation.foresight`. At each moment of its walk, what every opening reveals is foretold by ours and
by what it has to beat. Then a named region that has not been seen is searched for by each policy, from the same start.
Last, under `mapped`, the same predictions at openings of maps that place graph and segmenter made of recorded walks.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from prior_sg.deploy.evaluation.datasets import WorldName
from prior_sg.deploy.evaluation.foresight.mapped import ENCODER, mapped
from prior_sg.deploy.evaluation.foresight.predictors import PREDICTORS
from prior_sg.deploy.evaluation.foresight.scores import Judged, chance_figures, figures, judge, search_figures
from prior_sg.deploy.evaluation.foresight.searches import POLICIES, metres, quests
from prior_sg.deploy.evaluation.foresight.trials import ERRORS, Moment, moments, trial
from prior_sg.deploy.evaluation.perception import Cache, Perceiver
from prior_sg.deploy.evaluation.worlds import KINDS
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig

SEEDS = range(76, 80)  # none of them was used to choose a constant
SEARCHES = 33  # of each seed, over all kinds
MAPPED = (*(WorldName("home", seed) for seed in range(80, 84)), WorldName("office", 80))
FOLDER = Path("out/bench/foresight")  # maps are kept: to make one takes minutes

Report = Callable[[str], None]
Told = tuple[str, Sequence[Moment], Prior]  # a kind of world, what was seen of one, and its prior


def foresight_bench(
    seeds: Sequence[int] = SEEDS,
    worlds: Sequence[WorldName] = MAPPED,
    kinds: Sequence[str] = tuple(KINDS),
    report: Report = lambda text: None,
    folder: Path = FOLDER,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of predictions and of searches over all kinds of worlds, and of predictions on maps of `worlds`."""
    cfg = ForesightConfig()
    seen: list[Told] = []
    walked_m: dict[str, dict[str, list[float]]] = {kind: {name: [] for name in POLICIES} for kind in kinds}
    left = SEARCHES * len(seeds)
    pairs = [(kind, seed) for seed in seeds for kind in kinds]
    for number, (kind, seed) in enumerate(pairs):
        report(f"world {number + 1} of {len(pairs)}: {kind} {seed}")
        one = trial(kind, seed)
        seen.append((kind, list(moments(one)), one.prior))
        asked = quests(one, -(-left // (len(pairs) - number)))
        left -= len(asked)
        for quest in asked:
            for name, policy in POLICIES.items():
                walked_m[kind][name].append(metres(quest, policy, cfg))
    metrics = predicted(revealing(seen), cfg)
    whole_m = {name: [way_m for found in walked_m.values() for way_m in found[name]] for name in POLICIES}
    metrics["search"] = search_figures(whole_m) | {"searches": len(whole_m["ours"])}
    metrics["search_by_kind"] = {
        kind: search_figures(found) for kind, found in walked_m.items() if len(found["ours"]) > 1
    }
    metrics["mapped"] = mapped_figures(worlds, cfg, report, folder)
    settings = {
        "kinds": list(kinds),
        "seeds": [seeds[0], seeds[-1]],
        "errors": ERRORS,
        "mapped": [f"world:{one.kind}:{one.seed}" for one in worlds],
        "encoder": ENCODER,
    }
    return metrics, settings


def mapped_figures(worlds: Sequence[WorldName], cfg: ForesightConfig, report: Report, folder: Path) -> dict[str, Any]:
    """Figures of predictions at openings of the product's own maps, over all of them and by kind."""
    seen: list[Told] = []
    for number, world in enumerate(worlds):
        where = f"map {number + 1} of {len(worlds)}: {world.kind} {world.seed}"
        report(where)
        told = partial(_frames, report, where)
        perceiver = Perceiver({}, Cache(folder), told, ENCODER)
        seen.append((world.kind, *mapped(world.kind, world.seed, perceiver)))
    seen = revealing(seen)
    if not seen:
        return {}
    kinds = dict.fromkeys(kind for kind, _, _ in seen)
    by_kind = {kind: predicted([one for one in seen if one[0] == kind], cfg) for kind in kinds}
    return predicted(seen, cfg) | {"by_kind": by_kind}


def revealing(seen: Sequence[Told]) -> list[Told]:
    """The walks on which any opening reveals something: of others nothing can be foretold."""
    return [one for one in seen if any(len(moment.outcomes) for moment in one[1])]


def _frames(report: Report, where: str, what: str, done: int, whole: int) -> None:
    report(f"{where}, frame {done} of {whole} ({what})")


def predicted(seen: Sequence[Told], cfg: ForesightConfig) -> dict[str, Any]:
    """How well what openings reveal, what begins behind them and what is missing were foretold."""
    judged: dict[str, list[Judged]] = {name: [] for name in PREDICTORS}
    for kind, walk, prior in seen:
        for name, said in judge(kind, walk, prior, cfg).items():
            judged[name].append(said)
    metrics: dict[str, Any] = {name.replace(" ", "_"): figures(worlds) for name, worlds in judged.items()}
    return metrics | chance_figures([(walk, prior) for _, walk, prior in seen], cfg)
