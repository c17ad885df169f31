"""`prior-sg bench foresight`: are regions foreseen before they are seen, and does that shorten searches?

In generated worlds of every kind an explorer sees by lines of sight and takes some regions for others; see
`prior_sg.deploy.evaluation.foresight`. At each moment of its walk, what every opening reveals is foretold by ours and
by what it has to beat. Then a named region that has not been seen is searched for by each policy, from the same start.
"""

from collections.abc import Sequence
from typing import Any

from prior_sg.deploy.evaluation.foresight.predictors import PREDICTORS
from prior_sg.deploy.evaluation.foresight.scores import Judged, chance_figures, figures, judge, search_figures
from prior_sg.deploy.evaluation.foresight.searches import POLICIES, metres, quests
from prior_sg.deploy.evaluation.foresight.trials import ERRORS, Moment, moments, trial
from prior_sg.deploy.evaluation.worlds import KINDS
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig

SEEDS = range(76, 80)  # none of them was used to choose a constant
SEARCHES = 132


def foresight_bench(
    seeds: Sequence[int] = SEEDS, searches: int = SEARCHES, kinds: Sequence[str] = tuple(KINDS)
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of predictions and of searches, over all kinds of worlds."""
    cfg = ForesightConfig()
    judged: dict[str, list[Judged]] = {name: [] for name in PREDICTORS}
    seen: list[tuple[Sequence[Moment], Prior]] = []
    walked_m: dict[str, list[float]] = {name: [] for name in POLICIES}
    saved: dict[str, dict[str, list[float]]] = {kind: {name: [] for name in POLICIES} for kind in kinds}
    left = searches
    pairs = [(kind, seed) for seed in seeds for kind in kinds]
    for number, (kind, seed) in enumerate(pairs):
        one = trial(kind, seed)
        walk = list(moments(one))
        for name, said in judge(kind, walk, one.prior, cfg).items():
            judged[name].append(said)
        seen.append((walk, one.prior))
        asked = quests(one, -(-left // (len(pairs) - number)))
        left -= len(asked)
        for quest in asked:
            for name, policy in POLICIES.items():
                way_m = metres(quest, policy, cfg)
                walked_m[name].append(way_m)
                saved[kind][name].append(way_m)
    metrics: dict[str, Any] = {name.replace(" ", "_"): figures(worlds) for name, worlds in judged.items()}
    metrics |= chance_figures(seen, cfg)
    metrics["search"] = search_figures(walked_m) | {"searches": len(walked_m["ours"])}
    metrics["search_by_kind"] = {kind: search_figures(found) for kind, found in saved.items() if len(found["ours"]) > 1}
    settings = {"kinds": list(kinds), "seeds": [seeds[0], seeds[-1]], "errors": ERRORS}
    return metrics, settings
