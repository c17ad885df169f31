"""What followers have been told, and the smallest delta to what they should know (pure)."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.regions import Region, RegionDelta


@dataclass(frozen=True)
class View:
    """The regions and beliefs of all places, sorted by place id; fields as in RegionDelta."""

    robot: str
    epoch: int
    revision: int
    stamp_ns: int
    prior_digest: str
    environment: str
    task: str
    space: str
    labels: list[str]
    regions: dict[int, Region]
    place_ids: np.ndarray
    place_regions: np.ndarray
    posteriors: np.ndarray
    unknown: np.ndarray
    energy: float


def difference(
    published: View | None, now: View, everything: bool, tolerance: float
) -> tuple[View, RegionDelta | None]:
    """What followers know afterwards, and the delta that tells them; None when there is nothing to tell.

    A belief is sent when the region of the place changed or a probability moved by more than `tolerance` since it was
    last sent; a follower of all deltas knows exactly the view that is returned.
    """
    if published is None or everything:
        view = replace(now, revision=now.revision + 1)
        return view, complete(view)
    rows, before = _common(published.place_ids, now.place_ids)
    sent = np.ones(len(now.place_ids), dtype=bool)
    sent[rows] = (
        (now.place_regions[rows] != published.place_regions[before])
        | _moved(now.posteriors[rows], published.posteriors[before], tolerance).any(axis=1)
        | _moved(now.unknown[rows], published.unknown[before], tolerance)
    )
    upserts = [region for _, region in sorted(now.regions.items()) if published.regions.get(region.id) != region]
    gone_regions = sorted(published.regions.keys() - now.regions.keys())
    gone_places = np.setdiff1d(published.place_ids, now.place_ids)
    if not (sent.any() or upserts or gone_regions or len(gone_places)):
        return published, None
    posteriors, unknown = now.posteriors.copy(), now.unknown.copy()
    kept = ~sent[rows]
    posteriors[rows[kept]] = published.posteriors[before[kept]]
    unknown[rows[kept]] = published.unknown[before[kept]]
    view = replace(now, revision=now.revision + 1, posteriors=posteriors, unknown=unknown)
    return view, _delta(view, sent, upserts, gone_regions, gone_places, snapshot=False)


def complete(view: View) -> RegionDelta:
    """The whole view as a snapshot."""
    everyone = np.ones(len(view.place_ids), dtype=bool)
    return _delta(
        view, everyone, [region for _, region in sorted(view.regions.items())], [], np.zeros(0), snapshot=True
    )


def nothing(robot: str, epoch: int) -> RegionDelta:
    """The snapshot before anything was published; the first delta follows on it."""
    none = np.zeros(0, dtype=np.int64)
    view = View(robot, epoch, -1, 0, "", "", "", "", [], {}, none, none, np.zeros((0, 0)), np.zeros(0), 0.0)
    return complete(view)


def _delta(
    view: View,
    sent: np.ndarray,
    upserts: list[Region],
    gone_regions: list[int],
    gone_places: np.ndarray,
    *,
    snapshot: bool,
) -> RegionDelta:
    return RegionDelta(
        robot=view.robot,
        epoch=view.epoch,
        revision=view.revision,
        stamp_ns=view.stamp_ns,
        prior_digest=view.prior_digest,
        environment=view.environment,
        task=view.task,
        space=view.space,
        snapshot=snapshot,
        labels=view.labels,
        regions=upserts,
        removed_ids=np.array(gone_regions, dtype=np.int64),
        place_ids=view.place_ids[sent],
        place_regions=view.place_regions[sent],
        posteriors=view.posteriors[sent].astype(np.float16),
        unknown=view.unknown[sent].astype(np.float16),
        removed_place_ids=gone_places.astype(np.int64),
        energy=view.energy,
    )


def _common(before: np.ndarray, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows in `now` and in `before` of the ids that both hold."""
    _, in_now, in_before = np.intersect1d(now, before, assume_unique=True, return_indices=True)
    return in_now, in_before


def _moved(now: np.ndarray, before: np.ndarray, tolerance: float) -> np.ndarray:
    return np.abs(now.astype(np.float32) - before.astype(np.float32)) > tolerance
