"""Who foretells what an opening reveals: ours, and what it has to beat."""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.foresight.trials import Moment
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.foresight.beyond import beyond
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import expected

Predictor = Callable[[Moment, Prior, ForesightConfig], np.ndarray]  # → (opening, 1 + label): same first, rows sum to 1
SAME_RATE = 0.5  # of openings that show more of the same region; what is no geometry takes this for all
SMOOTHING = 0.5  # regions of each label that are thought of as found, of `frequency`


def ours(moment: Moment, prior: Prior, cfg: ForesightConfig) -> np.ndarray:
    """The product's."""
    found = beyond(moment.views, expected(prior, moment.found, cfg), cfg)
    return np.column_stack((found.same, found.next))


def without_adjacency(moment: Moment, prior: Prior, cfg: ForesightConfig) -> np.ndarray:
    """Ours, to which all regions may touch alike; that the same region goes on is as likely as for ours."""
    flat = msgspec.structs.replace(prior, adjacency=np.ones_like(prior.adjacency))
    found = replace(moment.found, borders=np.zeros_like(moment.found.borders))
    same = ours(moment, prior, cfg)[:, :1]
    labels = ours(replace(moment, found=found), flat, cfg)[:, 1:]
    return np.column_stack((same, (1 - same) * labels / labels.sum(axis=1, keepdims=True)))


def existence(moment: Moment, prior: Prior, cfg: ForesightConfig) -> np.ndarray:
    """The prior's existence alone, whatever the opening."""
    return _everywhere(np.array([region.existence for region in prior.regions]), moment)


def frequency(moment: Moment, prior: Prior, cfg: ForesightConfig) -> np.ndarray:
    """As often as found so far."""
    counts = moment.found.regions + SMOOTHING
    return _everywhere(counts / counts.sum(), moment)


def uniform(moment: Moment, prior: Prior, cfg: ForesightConfig) -> np.ndarray:
    """All labels alike."""
    return _everywhere(np.full(len(prior.regions), 1 / len(prior.regions)), moment)


def _everywhere(labels: np.ndarray, moment: Moment) -> np.ndarray:
    row = np.concatenate(([SAME_RATE], (1 - SAME_RATE) * labels))
    return np.tile(row, (len(moment.outcomes), 1))


PREDICTORS: dict[str, Predictor] = {
    "ours": ours,
    "ours without adjacency": without_adjacency,
    "existence": existence,
    "frequency": frequency,
    "uniform": uniform,
}
