"""All detections of the archive associated afresh, a slice at a time (pure).

An object then keeps the id under which most of its detections were known.
"""

from collections import deque

from prior_sg.services.segmenter.core.objects.association import associate
from prior_sg.services.segmenter.core.objects.track import Track, TrackingConfig
from prior_sg.services.segmenter.core.objects.tracks import Renewal, Tracks, order_of


def renew(tracks: Tracks, space: str, frames: int, cfg: TrackingConfig) -> None:
    """Associate stored detections of a space afresh, in the order of frames, those of at most so many at a time.

    With the last of them the objects change over; ids last by the detections that objects share. Poses corrected
    meanwhile begin another renewal afterwards, so that frequent corrections do not keep the objects from changing.
    """
    if tracks.renewal is None or tracks.renewal.fresh.space != space:
        keys = sorted((key for key in tracks.archive if key[0] == space), key=order_of)
        tracks.renewal = Renewal(Tracks(space=space, archive=tracks.archive), deque(keys))
        tracks.newest, tracks.moved, tracks.disordered = order_of(keys[-1]) if keys else (-1, ""), False, False
    fresh, waiting = tracks.renewal.fresh, tracks.renewal.waiting
    for _ in range(min(frames, len(waiting))):
        detections = tracks.archive.get(waiting.popleft())
        if detections is not None:  # it may have left the archive meanwhile
            associate(fresh, detections, cfg)
    if not waiting:
        tracks.renewal = None
        _change_over(tracks, fresh)


def _change_over(tracks: Tracks, fresh: Tracks) -> None:
    """The fresh objects take the places of the former, under their ids. A former one of which the archive holds nothing
    any more stays where it was."""
    heirs = _heirs(list(tracks.items.values()), list(fresh.items.values()))
    items = {}
    for track in fresh.items.values():
        former = [old for old, heir in heirs.items() if heir == track.id]
        best = max(former, key=lambda old: (len(tracks.items[old].sources & track.sources), -old), default=None)
        number = tracks.next_id if best is None else best
        tracks.next_id += best is None
        tracks.merged += [(old, number) for old in former if old != best]
        track.id = number
        items[number] = track
    if fresh.space == tracks.space:
        items |= {number: track for number, track in tracks.items.items() if not _archived(tracks, track)}
    tracks.space, tracks.items, tracks.changed = fresh.space, dict(sorted(items.items())), True


def _archived(tracks: Tracks, track: Track) -> bool:
    """Whether any of its detections is in the archive."""
    return any((tracks.space, detector, frame_id) in tracks.archive for detector, frame_id, _ in track.sources)


def _heirs(before: list[Track], after: list[Track]) -> dict[int, int]:
    """The new object that holds most of each former one's detections, by id."""
    holder = {source: track.id for track in after for source in track.sources}
    heirs = {}
    for track in before:
        held = [holder[source] for source in track.sources if source in holder]
        if held:
            heirs[track.id] = max(sorted(set(held)), key=held.count)
    return heirs
