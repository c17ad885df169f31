"""How good predictions of what openings reveal are: likelihood, ranks, calibration."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from prior_sg.deploy.evaluation.foresight.predictors import PREDICTORS
from prior_sg.deploy.evaluation.foresight.trials import SAME, Moment
from prior_sg.deploy.evaluation.search import calibration_error
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.foresight.beyond import beyond
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import expected

LEAST = 1e-6  # least probability in a logarithm


@dataclass(frozen=True)
class Judged:
    """What was said of the openings of one world."""

    kind: str
    chances: np.ndarray  # (event,) given to what came
    ranks: np.ndarray  # (event,) of it, from 1
    sure: np.ndarray  # (event,) the largest probability
    another: np.ndarray  # (event,) bool: another region came
    chances_another: np.ndarray  # (event,) given to its label, where another one is known to come
    ranks_another: np.ndarray  # (event,)


def judge(kind: str, moments: Iterable[Moment], prior: Prior, cfg: ForesightConfig) -> dict[str, Judged]:
    """By predictor. Raises ValueError where there is nothing to judge."""
    kept = [moment for moment in moments if len(moment.outcomes)]
    if not kept:
        raise ValueError("no opening reveals anything")
    outcomes = np.concatenate([moment.outcomes for moment in kept])
    found = {}
    for name, predictor in PREDICTORS.items():
        given = np.concatenate([predictor(moment, prior, cfg) for moment in kept])
        at = outcomes + 1
        assert SAME + 1 == 0
        chance = given[np.arange(len(at)), at]
        labels = given[:, 1:] / given[:, 1:].sum(axis=1, keepdims=True)
        of_label = labels[np.arange(len(at)), np.maximum(outcomes, 0)]
        found[name] = Judged(
            kind=kind,
            chances=chance,
            ranks=1 + (given > chance[:, None]).sum(axis=1) + _ties(given, chance) / 2,
            sure=given.max(axis=1),
            another=outcomes != SAME,
            chances_another=of_label,
            ranks_another=1 + (labels > of_label[:, None]).sum(axis=1) + _ties(labels, of_label) / 2,
        )
    return found


def _ties(given: np.ndarray, chance: np.ndarray) -> np.ndarray:
    """How many others (event,) are as probable: a tie is half before and half behind."""
    return (given == chance[:, None]).sum(axis=1) - 1


def figures(worlds: Sequence[Judged]) -> dict[str, float]:
    """Means over worlds, each the mean over its events, with standard errors; calibration over all events. Where no
    world has shown another region, nothing is told of that."""
    one = {
        "nll": [-np.log(np.maximum(world.chances, LEAST)).mean() for world in worlds],
        "top1": [(world.ranks < 1.5).mean() for world in worlds],
        "top3": [(world.ranks <= 3).mean() for world in worlds],
        "nll_another": [
            -np.log(np.maximum(world.chances_another[world.another], LEAST)).mean()
            for world in worlds
            if world.another.any()
        ],
        "top1_another": [(world.ranks_another[world.another] < 1.5).mean() for world in worlds if world.another.any()],
        "top3_another": [(world.ranks_another[world.another] <= 3).mean() for world in worlds if world.another.any()],
    }
    found = _means(one)
    sure = np.concatenate([world.sure for world in worlds])
    right = np.concatenate([world.ranks < 1.5 for world in worlds]).astype(float)
    return found | {
        "ece": calibration_error(np.minimum(sure, 1.0), right),
        "events": float(len(sure)),
        "worlds": float(len(worlds)),
    }


def chance_figures(worlds: Sequence[tuple[Sequence[Moment], Prior]], cfg: ForesightConfig) -> dict[str, float]:
    """Calibration and Brier score of what is said to begin behind each opening, and to be missing: how often on average
    (`said`), how often it was so (`true`); `rate` is the score of whoever knows nothing but that. Of what begins behind
    openings, means over worlds as well: the likelihood, and how often of two openings of one moment the one that a
    region begins behind was given the larger chance (`right`; a tie is half right)."""
    nll: list[float] = []
    right: list[float] = []
    within: list[tuple[np.ndarray, np.ndarray]] = []
    missing: list[tuple[np.ndarray, np.ndarray]] = []
    for moments, prior in worlds:
        first, rights = len(within), []
        for moment in moments:
            if len(moment.outcomes):
                said = beyond(moment.views, expected(prior, moment.found, cfg), cfg)
                within.append((said.within.reshape(-1), moment.met.reshape(-1)))
                missing.append((said.missing, moment.left))
                rights += _rights(said.within, moment.met)
        if len(within) > first:
            chance, there = (np.concatenate(column) for column in zip(*within[first:], strict=True))
            nll.append(-float(np.log(np.maximum(np.where(there, chance, 1 - chance), LEAST)).mean()))
        if rights:
            right.append(float(np.mean(rights)))
    found = _means({"within_nll": nll, "within_right": right})
    for name, pairs in (("within", within), ("missing", missing)):
        chance, there = (np.concatenate(column).astype(float) for column in zip(*pairs, strict=True))
        found[f"{name}_ece"] = calibration_error(chance, there)
        found[f"{name}_said"], found[f"{name}_true"] = float(chance.mean()), float(there.mean())
        found[f"{name}_brier"] = float(((chance - there) ** 2).mean())
        found[f"{name}_brier_rate"] = float(((there.mean() - there) ** 2).mean())
    return found


def _rights(chances: np.ndarray, met: np.ndarray) -> list[float]:
    """Of each label that begins behind some of the openings and not behind others, how often the chances (opening,
    label) are in the right order."""
    found = []
    for label in np.flatnonzero(met.any(axis=0) & ~met.all(axis=0)).tolist():
        there = met[:, label]
        ahead = chances[there, label][:, None] - chances[~there, label]
        found.append(float((ahead > 0).mean() + (ahead == 0).mean() / 2))
    return found


def _means(worlds: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Means over worlds with standard errors, where there are enough."""
    found = {name: float(np.mean(values)) for name, values in worlds.items() if values}
    return found | {
        f"{name}_error": float(np.std(values, ddof=1) / len(values) ** 0.5)
        for name, values in worlds.items()
        if len(values) > 1
    }


def search_figures(walked_m: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Mean metres by policy with standard errors, and how much ours saves against each other one, paired."""
    found: dict[str, float] = {}
    for name, values in walked_m.items():
        found[f"{name}_m"] = float(np.mean(values))
        found[f"{name}_m_error"] = float(np.std(values, ddof=1) / len(values) ** 0.5)
    ours = np.array(walked_m["ours"])
    for name, values in walked_m.items():
        if name != "ours":
            theirs = np.array(values)
            saved = theirs - ours
            found[f"saved_against_{name}"] = float(saved.mean() / theirs.mean())
            found[f"saved_against_{name}_error"] = float(np.std(saved, ddof=1) / len(saved) ** 0.5 / theirs.mean())
    return found
