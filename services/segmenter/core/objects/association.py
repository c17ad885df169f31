"""Detections become objects, frame by frame (pure).

A detection belongs to the object whose cells it shares, the descriptor deciding between several; objects that come to
share most of their cells become one, the older stays. An object seen once, and not again although several later frames
looked at it, was none.
"""

import numpy as np
import scipy

from prior_sg.schemas.codec import copied
from prior_sg.schemas.objects import Detections
from prior_sg.services.geometry import inverse
from prior_sg.services.segmenter.core.evidence import kernel
from prior_sg.services.segmenter.core.objects.cells import bounds_of, clouds_of, shared
from prior_sg.services.segmenter.core.objects.splitting import split
from prior_sg.services.segmenter.core.objects.track import Track, TrackingConfig, descriptor, extend, vote
from prior_sg.services.segmenter.core.objects.tracks import Tracks, order_of


def observe(tracks: Tracks, detections: Detections, cfg: TrackingConfig) -> bool:
    """Keep one frame's detections, and associate them if they are of the space in force; False for a repeat, or for
    embeddings of another width than the space's."""
    key = (detections.space, detections.detector, detections.frame_id)
    width = tracks.widths.setdefault(detections.space, detections.embeddings.shape[1])
    if key in tracks.archive or detections.embeddings.shape[1] != width:
        return False
    tracks.archive[key] = kept = copied(detections)
    if len(tracks.archive) > cfg.archive_frames:
        del tracks.archive[next(iter(tracks.archive))]
        tracks.forgetful = True
    if detections.space == (tracks.space if tracks.renewal is None else tracks.renewal.fresh.space):
        tracks.disordered |= order_of(key) < tracks.newest
        tracks.newest = max(order_of(key), tracks.newest)
    if tracks.renewal is not None and detections.space == tracks.renewal.fresh.space:
        tracks.renewal.waiting.append(key)
    elif detections.space == tracks.space and not tracks.moved:
        associate(tracks, kept, cfg)
    return True


def associate(tracks: Tracks, detections: Detections, cfg: TrackingConfig) -> None:
    """One frame's detections join objects or begin new ones; then merge, and drop what nobody saw again."""
    seen = clouds_of(detections, cfg.cell_m)
    joined = _matches(tracks, detections, seen, cfg)
    touched = []
    for index, cells in enumerate(seen):
        source = {(detections.detector, detections.frame_id, index)}
        news = Track(-1, cells, np.ones_like(cells), [detections.embeddings[index]], source, vote(detections, index))
        track = tracks.items.get(joined.get(index, -1))
        if track is None:
            news.id, track = tracks.next_id, news
            tracks.items[news.id], tracks.next_id = news, tracks.next_id + 1
        else:
            extend(track, news, cfg)
        touched.append(track.id)
    _merge(tracks, touched, cfg)
    split(tracks, touched, cfg)
    _forget(tracks, detections, set(touched), cfg)
    tracks.changed = True


def _matches(tracks: Tracks, detections: Detections, seen: list[np.ndarray], cfg: TrackingConfig) -> dict[int, int]:
    """Object id by detection: at most one each, the sum of overlap and similarity as large as possible."""
    items = list(tracks.items.values())
    scores = np.zeros((len(seen), len(items)))
    for row, cells in enumerate(seen):
        for column in _near(bounds_of(cells), items):
            track = items[column]
            shares = shared(cells, track.cells), shared(track.cells, cells)
            if max(shares) >= cfg.match_overlap and min(shares) >= cfg.match_part:
                cosine = float(descriptor(track.embeddings) @ detections.embeddings[row].astype(np.float64))
                scores[row, column] = max(shares) + cfg.descriptor_weight * (1 + cosine) + 1e-9
    rows, columns = scipy.optimize.linear_sum_assignment(-scores)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {row: items[column].id for row, column in pairs if scores[row, column] > 0}


def _merge(tracks: Tracks, touched: list[int], cfg: TrackingConfig) -> None:
    """Objects that have come to share most of their cells with one that grew become one; the older id stays."""
    waiting = list(dict.fromkeys(touched))
    while waiting:
        track = tracks.items.get(waiting.pop())
        if track is None:
            continue
        cells = track.firm()
        items = list(tracks.items.values())
        for other in (items[index] for index in _near(track.bounds, items)):
            if other.id == track.id:
                continue
            others = other.firm()
            least = 2 * cfg.merge_overlap - 1  # of one share, for their mean to be enough
            share = shared(cells, others)
            if share >= least and share + shared(others, cells) >= 2 * cfg.merge_overlap:
                into, gone = (track, other) if track.id < other.id else (other, track)
                extend(into, gone, cfg)
                del tracks.items[gone.id]
                tracks.merged.append((gone.id, into.id))
                waiting.append(into.id)
                break


def _forget(tracks: Tracks, detections: Detections, touched: set[int], cfg: TrackingConfig) -> None:
    """Count frames that look at a barely seen object in vain; enough of them, and it is dropped."""
    doubtful = [t for t in tracks.items.values() if t.frames < cfg.min_frames and t.id not in touched]
    if not doubtful:
        return
    centres_m = np.array([track.box_m(cfg).mean(axis=0) for track in doubtful])
    none = np.zeros(0, np.float32)
    view = kernel.Frame(
        inverse(detections.world_from_camera),
        detections.intrinsics,
        centers_px=none.reshape(0, 2),
        sigmas_px=none,
        layer_starts=np.zeros(0, np.int64),
        embeddings=none.reshape(0, 0),
        surface_m=kernel.fill_holes(detections.surface_m),
    )
    looks = kernel.visible(view, centres_m, kernel.KernelConfig(max_depth_m=cfg.max_depth_m))
    for row in looks.tolist():
        doubtful[row].missed += 1
        if doubtful[row].missed >= cfg.patience_frames:
            del tracks.items[doubtful[row].id]


def _near(bounds: np.ndarray, items: list[Track]) -> list[int]:
    """Indices of the objects whose bounds overlap a box, or touch it."""
    if not items:
        return []
    every = np.array([track.bounds for track in items])
    touches = (every[:, 0] <= bounds[1] + 1) & (every[:, 1] >= bounds[0] - 1)
    return np.flatnonzero(touches.all(axis=1)).tolist()
