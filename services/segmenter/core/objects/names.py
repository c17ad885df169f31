"""What the objects of the map are, in the prior's terms (pure)."""

from typing import NamedTuple

import numpy as np

from prior_sg.schemas.features import TextEmbeddings
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.experts.context import standardised
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.objects import sizes
from prior_sg.services.segmenter.core.objects.sizes import SizeConfig
from prior_sg.services.segmenter.core.objects.track import Track, TrackingConfig, descriptor
from prior_sg.services.segmenter.core.objects.tracks import Tracks


class Named(NamedTuple):
    """One object as told, its belief over the prior's objects, and the weight of its word."""

    entry: SceneObject
    concepts: np.ndarray  # (concept,) sums to 1
    weight: float
    sought: float  # share of the detectors' votes that name one of the prior's objects


def named(
    tracks: Tracks,
    prior: Prior | None,
    text: TextEmbeddings | None,
    cfg: TrackingConfig,
    *,
    graph: ReceivedGraph,
    size_cfg: SizeConfig,
) -> dict[int, Named]:
    """Every object that was seen often enough; without a prior and its text, none has a label."""
    items = [track for track in tracks.items.values() if track.frames >= cfg.min_frames]
    if not items:
        return {}
    if prior is None or text is None:
        return {track.id: Named(_entry(track, "", 0.0, 0.0, cfg), np.zeros(0), 0.0, 0.0) for track in items}
    found = np.array([descriptor(track.embeddings) for track in items])
    boxes = sizes.measured(items, cfg, graph, size_cfg)
    fits = sizes.log_ratios(boxes, prior.objects, size_cfg)
    seen, known = beliefs(found, text, np.log(commonness(prior)) + fits)
    votes = np.array([said(track.votes, prior) for track in items])
    concepts, sure = with_votes(seen, known, votes, cfg.detector_trust)
    result = {}
    for track, row, certain, heard in zip(items, concepts, sure.tolist(), votes.sum(axis=1).tolist(), strict=True):
        best = int(row.argmax())
        label = prior.objects[best].name if certain * row[best] >= cfg.label_least else ""
        weight = certain * (heard + (1.0 - heard) * cfg.unprompted_weight)
        result[track.id] = Named(_entry(track, label, float(row[best]), certain, cfg), row, weight, heard)
    return result


def beliefs(found: np.ndarray, text: TextEmbeddings, evidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P(c | o) (object, concept), rows sum to 1, and the probability (object,) that it is any of the concepts.

    A softmax over the concepts c of tau z(c) + evidence(c): the standardised similarity z with the space's temperature
    tau, as the visual expert's, and (object, concept) what else speaks for c, log P(c) among it. Beside them stands the
    null class: similarities of what is no concept scatter like the background's, as N(0, 1). A temperature of tau says
    that those of c itself scatter as N(tau, 1), so that the odds of c against none are exp(tau z - tau^2 / 2). Before
    anybody looks, an object is as likely one of the concepts as none. The space's null score is no help here: it is
    made for the sum over a few regions, of which the largest counts, not for a mean over a hundred concepts.
    """
    scores = text.temperature * standardised(found, text) + evidence
    shift = scores.max(axis=1, keepdims=True)
    odds = np.exp(scores - shift)
    total = odds.sum(axis=1)
    null = np.exp(np.minimum(text.temperature**2 / 2 - shift[:, 0], 700.0))
    return odds / total[:, None], total / (total + null)


def commonness(prior: Prior) -> np.ndarray:
    """P(c | E0) (concept,) of an object that is one of the prior's: sum over r of P(r | E0) P(c | r), summing to 1."""
    existence = np.array([region.existence for region in prior.regions])
    common = np.maximum(existence @ prior.containment.astype(np.float64), 1e-9)
    return common / common.sum()


def said(votes: dict[str, float], prior: Prior) -> np.ndarray:
    """Share (concept,) of each of the prior's objects in the votes; the rest went to other names."""
    shares = np.array([votes.get(item.name, 0.0) for item in prior.objects])
    return shares / max(sum(votes.values()), 1e-12)


def with_votes(
    concepts: np.ndarray, known: np.ndarray, votes: np.ndarray, trust: float
) -> tuple[np.ndarray, np.ndarray]:
    """Beliefs, as of `beliefs`, mixed with what detectors say: `votes` (object, concept) from `said`.

    Where the prior's names have a share h of the votes, they get trust h of the belief; the rest stays as it was. Votes
    for other names say nothing, for those are not what is asked.
    """
    weight = trust * votes.sum(axis=1)
    joint = trust * votes + ((1.0 - weight) * known)[:, None] * concepts
    sure = weight + (1.0 - weight) * known
    return joint / np.maximum(sure, 1e-12)[:, None], sure


def _entry(track: Track, label: str, probability: float, known: float, cfg: TrackingConfig) -> SceneObject:
    low_m, high_m = np.round(track.box_m(cfg), 3)
    return SceneObject(
        id=track.id,
        label=label,
        probability=round(probability, 3),
        known=round(known, 3),
        position_m=tuple(np.round((low_m + high_m) / 2, 3).tolist()),
        min_m=tuple(low_m.tolist()),
        max_m=tuple(high_m.tolist()),
        frames=track.frames,
    )
