"""Following a stream of deltas: tell the next one from a repeat, a gap and a restarted writer; and the poses that
updates have corrected (pure)."""

from dataclasses import dataclass, field
from typing import Generic, Literal, Protocol, TypeVar

import numpy as np

from prior_sg.schemas.codec import LAST_NUMBER
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.services.refusals import InputRefused

Verdict = Literal["apply", "stale", "gap"]
MOST_DELTAS = 4096  # that wait for a missing one
BELIEVED_REVISIONS = 2**32  # how far one revision may lie above the one before: years of an absent reader
LAST_BELIEVED = 3 * LAST_NUMBER // 4  # of the year 2079: no clock's epoch; one message must not use up the numbers
BELIEVED_STEP = 2**20  # how far one epoch beyond may lie above the one before: restarts
BELIEVED_NS = 10 * 365 * 86400 * 10**9  # how far one epoch may lie above the one before: clocks mended, long rests


def next_epoch(now_ns: int, known: int) -> int:
    """The epoch of a writer that starts now, where `known` is the highest seen (-1 = none): the time, which no other
    draws, unless the clock is behind what was seen or too far ahead to be believed.
    """
    believed = now_ns <= LAST_BELIEVED and (known < 0 or known < now_ns <= known + BELIEVED_NS)
    return now_ns if believed else max(known, 0) + 1


def fault_of_epoch(epoch: int, known: int) -> str:
    """Why no writer can have drawn an epoch where `known` is the highest seen (-1 = none); empty when one can."""
    if epoch <= max(LAST_BELIEVED, known + BELIEVED_STEP) and epoch < LAST_NUMBER:
        return ""
    return f"epoch {epoch} leaves hardly a number above itself: not believed"


class Delta(Protocol):
    """What PlaceDelta and RegionDelta share."""

    @property
    def epoch(self) -> int:
        """New at every start of the writer."""

    @property
    def revision(self) -> int:
        """Grows by one per delta, from 0."""

    @property
    def snapshot(self) -> bool:
        """Whether it holds the whole state."""


D = TypeVar("D", bound=Delta)


class Follower(Generic[D]):
    """Puts deltas of one writer in order. Feed each arrival to `take`; apply what comes back, and ask for a snapshot
    while `needs_snapshot` is set. Deltas that arrive during a gap wait for the snapshot.
    """

    def __init__(self, epoch: int = -1, revision: int = -1, waiting_limit: int = MOST_DELTAS) -> None:
        self.epoch, self.revision = epoch, revision
        self.needs_snapshot = False
        self._waiting: dict[tuple[int, int], D] = {}  # by epoch and revision
        self._waiting_limit = waiting_limit

    def verdict(self, delta: D) -> Verdict:
        """What to do with a delta, given what was applied so far. Revisions of a new writer begin at 0. Raises
        InputRefused for an epoch or a revision that no writer can have come to meanwhile.
        """
        self._believe(delta)
        if delta.epoch < self.epoch or (delta.epoch == self.epoch and delta.revision <= self.revision):
            return "stale"
        if delta.snapshot or (delta.epoch == self.epoch and delta.revision == self.revision + 1):
            return "apply"
        return "apply" if delta.epoch > self.epoch and delta.revision == 0 else "gap"

    def _believe(self, delta: D) -> None:
        if self.epoch >= 0 and delta.epoch > self.epoch + BELIEVED_NS:
            raise InputRefused(f"epoch {delta.epoch} lies years above {self.epoch}, the one followed: not believed")
        if fault := fault_of_epoch(delta.epoch, self.epoch):
            raise InputRefused(fault)
        last = self.revision if delta.epoch == self.epoch else 0
        if delta.revision > max(last, 0) + BELIEVED_REVISIONS:
            raise InputRefused(f"revision {delta.revision} lies far above {last}, the one followed: not believed")

    def take(self, delta: D) -> list[D]:
        """The deltas to apply now, in order: none for a repeat or a gap, several when a gap closes."""
        verdict = self.verdict(delta)
        ready = [delta] if verdict == "apply" else []
        if verdict == "gap" and len(self._waiting) < self._waiting_limit:
            self._waiting[delta.epoch, delta.revision] = delta
        if ready:
            self.epoch, self.revision = delta.epoch, delta.revision
        while (following := self._waiting.pop((self.epoch, self.revision + 1), None)) is not None:
            ready.append(following)
            self.revision = following.revision
        self._waiting = {name: kept for name, kept in self._waiting.items() if name > (self.epoch, self.revision)}
        self.needs_snapshot = bool(self._waiting)
        return ready


@dataclass
class PoseCorrections:
    """Newest corrected pose of each frame, also of frames that are still to come."""

    world_from_camera: dict[int, np.ndarray] = field(default_factory=dict)  # (4, 4) by frame id
    revisions: dict[int, int] = field(default_factory=dict)  # of the newest update by the epoch of its writer

    def take(self, update: PoseUpdate) -> dict[int, np.ndarray] | None:
        """The poses (4, 4) by frame id that an update gives; None where it is a repeat or older than one before."""
        known = self.revisions.get(update.epoch, -1)
        if update.revision <= known:
            return None
        if known >= 0 and update.revision > known + BELIEVED_NS:
            raise InputRefused(f"revision {update.revision} of poses lies far above the one before, {known}")
        self.revisions[update.epoch] = update.revision
        poses = dict(zip(update.frame_ids.tolist(), np.array(update.world_from_camera), strict=True))
        self.world_from_camera.update(poses)
        return poses

    def pose(self, frame_id: int, otherwise: np.ndarray) -> np.ndarray:
        """The corrected pose of a frame, or `otherwise`, as it was announced."""
        return self.world_from_camera.get(frame_id, otherwise)

    def __contains__(self, frame_id: int) -> bool:
        return frame_id in self.world_from_camera
