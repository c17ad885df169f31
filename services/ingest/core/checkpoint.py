"""How far a source was read, as it is kept on disk beside the keyframes (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Stamp
from prior_sg.schemas.frames import Keyframe, Pose
from prior_sg.schemas.status import Loss


class Sight(Message, frozen=True, kw_only=True):
    """A frame that a camera has seen, at the pose that the source gave it."""

    camera: str  # its name, where the robot has several
    frame_id: Number
    stamp_ns: Stamp
    world_from_camera: Pose


class Checkpoint(Message, frozen=True, kw_only=True):
    """The state of ingest when a keyframe was accepted. Numbers and stamps are those of the stream unless named so."""

    index: NumberOrNone  # position of the frame in the source
    frames: list[Sight]  # the newest believed of each camera, oldest first
    keyframes_seen: list[Sight]  # the newest keyframe of each camera, against which its next one is due
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

    def check(self) -> None:
        """A checkpoint is of a keyframe, which a camera has seen."""
        if not (self.frames and self.keyframes_seen):
            raise ValueError("a checkpoint without a frame or a keyframe")

    @property
    def frame_id(self) -> int:
        """Of the newest frame."""
        return self.frames[-1].frame_id

    @property
    def source_frame(self) -> tuple[int, int]:
        """Number and stamp of the frame as the source gives them."""
        return self.frame_id - self.number_offset, self.frames[-1].stamp_ns - self.offset_ns


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
