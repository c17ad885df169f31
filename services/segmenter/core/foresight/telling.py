"""What is foreseen as it travels, and whether it is news (pure)."""

from collections.abc import Mapping

import numpy as np

from prior_sg.schemas.foresight import ForeseenLabel, Foresight, MissingLabel, Opening
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import Region
from prior_sg.services.segmenter.core.foresight.around import around_of
from prior_sg.services.segmenter.core.foresight.beyond import Beyond, Views, beyond, leads_features
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import Found, expected
from prior_sg.services.segmenter.core.foresight.openings import Openings

DIGITS = 3


def foresight(openings: Openings, regions: Mapping[int, Region], prior: Prior, cfg: ForesightConfig) -> Foresight:
    """What lies beyond the openings of a map with these regions."""
    names = [region.name for region in prior.regions]
    found = found_in(regions, prior, cfg)
    foreseen = beyond(views_of(openings, regions, cfg), expected(prior, found, cfg), cfg)
    told, missing = told_labels(foreseen, cfg), foreseen.missing
    return Foresight(
        openings=[
            _opening(openings, row, foreseen=foreseen, told=told[row], prior=prior, found=found)
            for row in range(len(openings.place_ids))
        ],
        missing=[
            MissingLabel(label=names[label], probability=_short(missing[label]), found=int(found.regions[label]))
            for label in np.argsort(-missing, kind="stable").tolist()
            if missing[label] >= cfg.least_told
        ],
        look_m=cfg.look_m,
        elsewhere_m=cfg.elsewhere_m,
    )


def told_labels(foreseen: Beyond, cfg: ForesightConfig) -> np.ndarray:
    """Whether (opening, label) an opening tells of a label: of its most probable ones, and of all that it leads to, for
    searches would pass it by otherwise."""
    ranks = np.argsort(np.argsort(-foreseen.within, axis=1, kind="stable"), axis=1)
    likely = (ranks < cfg.told_labels) & (foreseen.within >= cfg.least_within)
    return np.asarray(likely | (foreseen.toward >= cfg.least_toward))


def found_in(regions: Mapping[int, Region], prior: Prior, cfg: ForesightConfig) -> Found:
    """What a map with these regions holds of a prior."""
    return Found.of(regions.values(), [region.name for region in prior.regions], cfg.least_places)


def views_of(openings: Openings, regions: Mapping[int, Region], cfg: ForesightConfig) -> Views:
    """What the openings tell of what is behind them."""
    areas_m2 = np.array([regions[region].area_m2 for region in openings.regions.tolist()])
    signs = leads_features(openings.widths_m, openings.rises, openings.unseen)
    return Views(openings.beliefs, openings.widths_m, areas_m2, around_of(openings, regions, cfg), signs)


def differs(told: Foresight | None, now: Foresight, cfg: ForesightConfig) -> bool:
    """Whether an opening came or went, or a probability changed by more than what is told."""
    before, after = _figures(told or Foresight()), _figures(now)
    return any(
        abs(after.get(key, 0.0) - before.get(key, 0.0)) > cfg.told_change for key in before.keys() | after.keys()
    )


def _figures(one: Foresight) -> dict[tuple[str, int, str], float]:
    """Every probability that planners choose by, by what it is of, opening and label; openings as a whole count as
    likely."""
    found = {("opening", opening.place_id, ""): 1.0 + opening.same for opening in one.openings}
    for opening in one.openings:
        found |= {("within", opening.place_id, entry.label): entry.within for entry in opening.labels}
        found |= {("toward", opening.place_id, entry.label): entry.toward for entry in opening.labels}
    return found | {("missing", -1, entry.label): entry.probability for entry in one.missing}


def _opening(
    openings: Openings, row: int, *, foreseen: Beyond, told: np.ndarray, prior: Prior, found: Found
) -> Opening:
    here = int(openings.beliefs[row].argmax())
    by_chance = np.argsort(-foreseen.within[row], kind="stable").tolist()
    return Opening(
        place_id=int(openings.place_ids[row]),
        position_m=_point(openings.positions_m[row]),
        beyond_m=_point(openings.beyond_m[row]),
        width_m=round(float(openings.widths_m[row]), 2),
        region=int(openings.regions[row]),
        same=_short(foreseen.same[row]),
        labels=[
            ForeseenLabel(
                label=prior.regions[label].name,
                next=_short(foreseen.next[row, label]),
                within=_short(foreseen.within[row, label]),
                toward=_short(foreseen.toward[row, label]),
                adjacency=_short(prior.adjacency[here, label]),
                existence=_short(prior.regions[label].existence),
                found=int(found.regions[label]),
                met=int(found.borders[here, label]),
            )
            for label in by_chance
            if told[label]
        ],
    )


def _point(point_m: np.ndarray) -> tuple[float, float, float]:
    x, y, z = np.round(point_m, 2).tolist()
    return x, y, z


def _short(probability: float) -> float:
    return round(float(probability), DIGITS)
