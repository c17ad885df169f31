"""How far a source was read, as it is kept on disk beside the keyframes (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Stamp
from prior_sg.schemas.frames import Keyframe, Pose
from prior_sg.schemas.status import Loss


class Checkpoint(Message, frozen=True, kw_only=True):
    """The state of ingest when a keyframe was accepted. Numbers and stamps are those of the stream unless named so."""

    index: NumberOrNone  # position of the frame in the source
    frame_id: Number
    stamp_ns: Stamp
    world_from_camera: Pose  # as the source gave it
    keyframe_id: Number  # of the newest keyframe, against which the next one is due
    keyframe_stamp_ns: Stamp
    world_from_keyframe: Pose
    trail_from: NumberOrNone  # the first keyframe since the poses last jumped; -1 = there is none
    offset_ns: Stamp  # from the source's stamps to the stream's
    number_offset: Stamp
    interval_ns: Stamp
    read: Number
    total: Number
    rejected: Number
    keyframes: Number
    encoded: Number
    skipped: Number
    backfilled: tuple[NumberOrNone, NumberOrNone]  # epoch and number of the newest wish to encode again that was heard
    losses: list[Loss]

    @property
    def source_frame(self) -> tuple[int, int]:
        """Number and stamp of the frame as the source gives them."""
        return self.frame_id - self.number_offset, self.stamp_ns - self.offset_ns


@dataclass(frozen=True)
class Kept:
    """What a process left: its checkpoint, its keyframes, oldest first, and which of them have jobs not done."""

    checkpoint: Checkpoint
    keyframes: Sequence[Keyframe]
    owed: set[int] = field(default_factory=set)


class Keeper(Protocol):
    """Where keyframes and checkpoints are kept beyond the end of the process. All raise NotKeptError."""

    def keep(self, keyframe: Keyframe, oldest_frame_id: int, checkpoint: Checkpoint) -> None:
        """Keep one more keyframe, whose job is owed if it has colour, and drop those older than `oldest_frame_id`."""

    def ended(self, frame_id: int, checkpoint: Checkpoint) -> None:
        """The job of a keyframe is done, or given up."""

    def correct(self, keyframes: Sequence[Keyframe]) -> None:
        """Keyframes have other poses."""

    def mark(self, checkpoint: Checkpoint) -> None:
        """Nothing but the checkpoint has changed."""

    def begin(self) -> None:
        """Forget everything."""

    def close(self) -> None:
        """Keep nothing more."""


class NotKeptError(Exception):
    """Nothing can be kept; the text says why."""
