"""All objects, and the archive of detections that they were made from (pure).

Detections stay in the archive, without their images: a corrected pose, or another embedding space, associates them
afresh (`renewal`).
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.schemas.objects import Detections
from prior_sg.services.segmenter.core.objects.track import Track


@dataclass
class Tracks:
    """All objects, and the detections they were made from."""

    space: str = ""  # of the detections that the objects are made from
    items: dict[int, Track] = field(default_factory=dict)  # by id
    archive: dict[tuple[str, str, int], Detections] = field(default_factory=dict)  # by space, detector and frame id
    widths: dict[str, int] = field(default_factory=dict)  # of the embeddings, by space
    next_id: int = 0
    merged: list[tuple[int, int]] = field(default_factory=list)  # (gone, into) since they were last told
    moved: bool = False  # a pose in the archive was corrected since `renewal` began
    newest: tuple[int, str] = (-1, "")  # frame id and detector of what was associated last, in the order of frames
    disordered: bool = False  # something older than that was associated after it
    forgetful: bool = False  # detections have left the archive
    renewal: "Renewal | None" = None
    changed: bool = False  # since they were last told


@dataclass
class Renewal:
    """An association of all detections afresh, under way; until it is done the objects stay as they are."""

    fresh: Tracks
    waiting: deque[tuple[str, str, int]]  # keys of the archive


def move(tracks: Tracks, poses: dict[int, np.ndarray]) -> None:
    """Give frames their corrected poses, world_from_camera by frame id; `renew` then associates afresh."""
    for key, kept in tracks.archive.items():
        if key[2] in poses:
            tracks.archive[key] = msgspec.structs.replace(kept, world_from_camera=poses[key[2]].copy())
            tracks.moved = True


def renumber(tracks: Tracks, number: Mapping[int, int], next_id: int) -> None:
    """Objects have other ids; nothing of them may have been told yet."""
    for track in tracks.items.values():
        track.id = number[track.id]
    tracks.items = dict(sorted((track.id, track) for track in tracks.items.values()))
    tracks.next_id, tracks.merged, tracks.changed = next_id, [], True


def in_order(tracks: Tracks) -> None:
    """Detections that came late, or from several workers, are to be associated afresh in the order of their frames:
    what the objects are does not depend on the way. Not so once some are lost, of which objects would know less."""
    if tracks.disordered and not tracks.forgetful:
        tracks.archive = dict(sorted(tracks.archive.items(), key=lambda kept: order_of(kept[0])))
        tracks.moved, tracks.disordered = True, False


def order_of(key: tuple[str, str, int]) -> tuple[int, str]:
    """Where a key of the archive stands in the order of frames."""
    _, detector, frame_id = key
    return frame_id, detector


def outdated(tracks: Tracks, space: str) -> bool:
    """Whether `renew` has to be called, again, before the objects are those of a space and of the poses as they are."""
    return tracks.moved or tracks.renewal is not None or tracks.space != space
