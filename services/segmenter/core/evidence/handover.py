"""Embedding spaces that may take over from the one in force, so that an encoder can be exchanged in mid-run (pure).

Similarities of two spaces do not mix. Pyramids of another space are therefore kept apart, the keyframes it has not seen
are asked for (Backfill), and it comes into force when it covers the map; until then the old one serves. A space that
has been left, or was there from the start, comes into force only when the present one has fallen silent: two pools side
by side do not make the map flicker.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.schemas.features import Backfill, Pyramid
from prior_sg.services.segmenter.core.evidence.archive import FrameArchive
from prior_sg.services.segmenter.core.evidence.kernel import Evidence, compact


class SpacesConfig(msgspec.Struct, frozen=True, kw_only=True):
    """When another embedding space takes over. One tick is half a second."""

    follow: bool = True  # take up a space whose workers join; False = stay with `space` for good
    coverage: float = 0.98  # share of the observed places that the new space must have observed too
    backfill_ticks: int = 6  # after a start, a newcomer, or the last pyramid, before asking: late ones may yet arrive
    repeat_ticks: int = 40  # between questions while keyframes are missing
    late_frames: int = 3  # newest keyframes that it may lack when it takes over: their pyramids are on the way
    patience_ticks: int = 20  # without growth, after which a newcomer is tried although keyframes are missing
    silent_frames: int = (
        8  # pyramids of another space since the last of this one, after which this one counts as silent
    )


@dataclass
class Rival:
    """A space that is not in force."""

    archive: FrameArchive = field(default_factory=FrameArchive)
    waits: bool = False  # comes into force only when the present space is silent
    heard: int = 0  # pyramids since the last one of the space in force
    ticks: int = 0  # since it was first heard
    still_ticks: int = 0  # since it last grew
    tried_frames: int = -1  # how many frames it had when it was last tried and found wanting


@dataclass
class Spaces:
    """The space in force, by name, and the others."""

    force: str = ""
    rivals: dict[str, Rival] = field(default_factory=dict)
    left: set[str] = field(default_factory=set)
    ticks: int = 0
    still_ticks: int = 0  # since the space in force was last heard
    asked: int = 0  # wishes for keyframes


def hear(spaces: Spaces, pyramid: Pyramid, in_force: FrameArchive, cfg: SpacesConfig, limit_bytes: float) -> bool:
    """Keep a pyramid of a space that is not in force, at most so many bytes of each; False when it is not needed."""
    if not cfg.follow:
        return False
    rival = spaces.rivals.get(pyramid.space)
    if rival is None:
        waits = pyramid.space in spaces.left or not len(in_force)
        rival = spaces.rivals[pyramid.space] = Rival(waits=waits)
    rival.heard += 1
    if not _comes(rival, cfg) or not rival.archive.add(pyramid.frame_id, compact(pyramid), limit_bytes):
        return False
    rival.still_ticks = 0
    return True


def heard_in_force(spaces: Spaces) -> None:
    """The space in force lives."""
    spaces.still_ticks = 0
    for rival in spaces.rivals.values():
        rival.heard = 0


def tick(spaces: Spaces) -> None:
    """Half a second has passed."""
    spaces.ticks += 1
    spaces.still_ticks += 1
    for rival in spaces.rivals.values():
        rival.ticks += 1
        rival.still_ticks += 1


def move(spaces: Spaces, frame_id: int, world_from_camera: np.ndarray) -> None:
    """Give a frame its corrected pose in every space that is not in force."""
    for rival in spaces.rivals.values():
        rival.archive.move(frame_id, world_from_camera)


def questions(spaces: Spaces, in_force: FrameArchive, robot: str, epoch: int, cfg: SpacesConfig) -> Iterator[Backfill]:
    """Ask for keyframes: what this process has missed, after its start and whenever the stream rests; and for newcomers
    until they cover."""
    started, rests = spaces.ticks == cfg.backfill_ticks, spaces.still_ticks == cfg.backfill_ticks
    lacking: list[tuple[str, FrameArchive, bool]] = []
    if rests or (started and len(in_force)):
        lacking.append((spaces.force, in_force, rests))
    for name, rival in spaces.rivals.items():
        due = rival.ticks >= cfg.backfill_ticks and (rival.ticks - cfg.backfill_ticks) % cfg.repeat_ticks == 0
        if due and _comes(rival, cfg) and not in_force.frame_ids <= rival.archive.frame_ids:
            lacking.append((name, rival.archive, rival.still_ticks >= cfg.backfill_ticks))
    for space, archive, settled in lacking:
        spaces.asked += 1
        frame_ids = np.array(sorted(archive.frame_ids), np.int64)
        yield Backfill(robot=robot, space=space, frame_ids=frame_ids, settled=settled, epoch=epoch, number=spaces.asked)


def successor(spaces: Spaces, in_force: FrameArchive, cfg: SpacesConfig) -> str | None:
    """A space worth trying: it has every frame that the present one has, but the newest, or has stopped growing."""
    for name, rival in spaces.rivals.items():
        missing = in_force.frame_ids - rival.archive.frame_ids
        newest = max(rival.archive.frame_ids, default=-1)
        complete = len(missing) <= cfg.late_frames and all(frame_id > newest for frame_id in missing)
        grown = len(rival.archive) > max(rival.tried_frames, 0)
        if _comes(rival, cfg) and grown and (complete or rival.still_ticks >= cfg.patience_ticks):
            return name
    return None


def covers(new: Evidence, old: Evidence, slots: np.ndarray, cfg: SpacesConfig) -> bool:
    """Whether nearly every place that the old evidence describes is described by the new; both have the same slots."""
    before, after = old.frames[slots] > 0, new.frames[slots] > 0
    return bool((before & after).sum() >= cfg.coverage * before.sum())


def refuse(spaces: Spaces, name: str) -> None:
    """It does not cover the map yet: try again when it has grown."""
    spaces.rivals[name].tried_frames = len(spaces.rivals[name].archive)


def succeed(spaces: Spaces, name: str) -> FrameArchive:
    """Put a space in force; returns its frames."""
    spaces.left.add(spaces.force)
    spaces.left.discard(name)
    spaces.force = name
    return spaces.rivals.pop(name).archive


def _comes(rival: Rival, cfg: SpacesConfig) -> bool:
    return not rival.waits or rival.heard >= cfg.silent_frames
