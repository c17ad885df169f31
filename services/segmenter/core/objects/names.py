"""What the objects of the map are, in the prior's terms, and what followers have been told of them (pure)."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.features import TextEmbeddings
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.experts.context import ObjectView, standardised
from prior_sg.services.segmenter.core.map.received import PlaceGraph
from prior_sg.services.segmenter.core.objects import sizes
from prior_sg.services.segmenter.core.objects.sizes import SizeConfig
from prior_sg.services.segmenter.core.objects.tracks import Track, TrackingConfig, Tracks, descriptor

VISIBLE_CHANGE = 0.02  # smaller changes of a probability are not sent


class Named(NamedTuple):
    """One object as told, its belief over the prior's objects, and the weight of its word."""

    entry: SceneObject
    concepts: np.ndarray  # (concept,) sums to 1
    weight: float
    sought: float  # share of the detectors' votes that name one of the prior's objects


@dataclass
class ObjectLedger:
    """What followers know."""

    told: dict[int, Named] = field(default_factory=dict)
    digest: str = ""
    revision: int = -1
    stamp_ns: int = 0

    def view(self) -> ObjectView:
        """The objects that carry a label or have a say, for regions and experts."""
        named = [item for item in self.told.values() if item.entry.label or item.weight > 0]
        if not named:
            return ObjectView()
        return ObjectView(
            ids=np.array([item.entry.id for item in named], np.int64),
            positions_m=np.array([item.entry.position_m for item in named]),
            concepts=np.array([item.concepts for item in named]),
            weights=np.array([item.weight for item in named]),
            sought=np.array([item.sought for item in named]),
        )

    def snapshot(self, robot: str, epoch: int) -> ObjectDelta:
        """Everything told so far; before the first delta, the empty state that it follows on."""
        return self._delta(robot, epoch, [item.entry for _, item in sorted(self.told.items())], snapshot=True)

    def tell(
        self,
        robot: str,
        epoch: int,
        stamp_ns: int,
        *,
        now: dict[int, Named],
        merged: list[tuple[int, int]],
        digest: str,
    ) -> ObjectDelta | None:
        """The delta from what is known to what is so; None when nothing changed visibly."""
        known = self.told if digest == self.digest else {}
        upserts = [item for number, item in now.items() if number not in known or _differs(item, known[number])]
        heirs = dict(merged)
        joined = []
        for gone in sorted(self.told.keys() & heirs.keys() - now.keys()):
            into = heirs[gone]
            while into not in now and into in heirs:
                into = heirs[into]
            joined += [(gone, into)] if into in now else []
        removed = sorted(self.told.keys() - now.keys() - {gone for gone, _ in joined})
        if not (upserts or joined or removed):
            return None
        self.told = {number: known.get(number, item) for number, item in now.items()}
        self.told |= {item.entry.id: item for item in upserts}
        self.digest, self.revision, self.stamp_ns = digest, self.revision + 1, stamp_ns
        return self._delta(robot, epoch, [item.entry for item in upserts], removed, joined)

    def _delta(
        self,
        robot: str,
        epoch: int,
        entries: list[SceneObject],
        removed: list[int] | None = None,
        joined: list[tuple[int, int]] | None = None,
        *,
        snapshot: bool = False,
    ) -> ObjectDelta:
        return ObjectDelta(
            robot=robot,
            epoch=epoch,
            revision=self.revision,
            stamp_ns=self.stamp_ns,
            prior_digest=self.digest,
            snapshot=snapshot,
            objects=entries,
            removed_ids=np.array(removed or [], np.int64),
            merged_ids=np.array(joined or [], np.int64).reshape(-1, 2),
        )


def named(
    tracks: Tracks,
    prior: Prior | None,
    text: TextEmbeddings | None,
    cfg: TrackingConfig,
    *,
    graph: PlaceGraph,
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


def _differs(now: Named, before: Named) -> bool:
    """Whether somebody who looks would see it; a number of frames counts when it has doubled."""
    one, other = now.entry, before.entry
    return (
        (one.label, one.min_m, one.max_m) != (other.label, other.min_m, other.max_m)
        or abs(one.probability - other.probability) > VISIBLE_CHANGE
        or abs(one.known - other.known) > VISIBLE_CHANGE
        or one.frames >= 2 * other.frames
        or one.frames < other.frames
        or len(now.concepts) != len(before.concepts)
    )
