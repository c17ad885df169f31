"""One object that is two (pure).

An object whose cells lie in two parts that few detections show together is two; the part shown more often keeps the id.
"""

from collections.abc import Iterator

import numpy as np
import scipy

from prior_sg.schemas.objects import Detections
from prior_sg.services.segmenter.core.objects.cells import cloud_of, connected, unpacked
from prior_sg.services.segmenter.core.objects.track import Track, TrackingConfig, extend, vote
from prior_sg.services.segmenter.core.objects.tracks import Tracks


def split(tracks: Tracks, touched: list[int], cfg: TrackingConfig) -> None:
    """Objects whose firm cells fall into two parts that few detections show together become two."""
    for number in dict.fromkeys(touched):
        track = tracks.items.get(number)
        if track is None or track.frames < max(cfg.split_frames, track.look_again):
            continue
        track.look_again = track.frames + max(1, track.frames // 4)
        parts = connected(track.firm(cfg.firm_share))
        if len(parts) < 2:
            continue
        halves = _halves(tracks, track, parts[0], parts[1], cfg)
        if halves is not None:
            tracks.items[number], split_off = halves
            split_off.id, tracks.next_id = tracks.next_id, tracks.next_id + 1
            tracks.items[split_off.id] = split_off


def _halves(
    tracks: Tracks, track: Track, one: np.ndarray, other: np.ndarray, cfg: TrackingConfig
) -> tuple[Track, Track] | None:
    """What the object becomes if it is two, that with more frames first and under the old id; None if it is one.

    Its detections are taken from the archive; every cell of theirs goes with the nearer part.
    """
    tree = scipy.spatial.cKDTree(np.concatenate((unpacked(one), unpacked(other))))
    both, shown, halves = 0, [0, 0], (_blank(track), _blank(track))
    views = list(_views(tracks, track, cfg))
    if len(views) < len(track.sources):  # too old for the archive: nobody can say to which part they belong
        return None
    for detections, index, cells in views:
        _, nearest = tree.query(unpacked(cells))
        sides = [cells[nearest < len(one)], cells[nearest >= len(one)]]
        main = int(len(sides[1]) > len(sides[0]))
        joint = len(sides[1 - main]) >= cfg.part_share * len(cells)
        both += joint
        for side, half in enumerate(halves):
            if side == main:
                source = {(detections.detector, detections.frame_id, index)}
                said = [detections.embeddings[index]], source, vote(detections, index)
                extend(half, Track(-1, sides[side], np.ones_like(sides[side]), *said), cfg)
            elif joint:
                extend(half, Track(-1, sides[side], np.ones_like(sides[side]), [], set(), {}), cfg)
            shown[side] += side == main or joint
    if both >= cfg.split_joint * min(shown) or min(half.frames for half in halves) == 0:
        return None
    kept, split_off = sorted(halves, key=lambda half: -half.frames)
    return kept, split_off


def _blank(track: Track) -> Track:
    none = np.zeros(0, np.int64)
    return Track(track.id, none, none, [], set(), {}, look_again=track.look_again)


def _views(tracks: Tracks, track: Track, cfg: TrackingConfig) -> Iterator[tuple[Detections, int, np.ndarray]]:
    """The object's detections that the archive holds, by frame: message, index, and cells in the world."""
    for detector, frame_id, index in sorted(track.sources, key=lambda source: (source[1], source)):
        detections = tracks.archive.get((tracks.space, detector, frame_id))
        if detections is not None:
            yield detections, index, cloud_of(detections, index, cfg.cell_m)
