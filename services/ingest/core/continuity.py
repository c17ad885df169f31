"""Whether a frame goes on from those before it, and a clock or a count that has jumped (pure).

A frame whose stamp goes back or lies far ahead, or whose number does not rise, is held back. If the stream then goes on
as before, it was a single fault and is refused. If the next frames go on from it instead, the clock, or the count, has
jumped: all of them are believed, with stamps and numbers that rise for every reader.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import RawFrame, View

BELIEVED_AFTER = 3  # frames that go on from each other
AHEAD_NS, AHEAD_INTERVALS = 60 * 10**9, 20  # a stamp farther ahead than both may be wrong
STAMPS_BACK = "their stamps go back"
STAMPS_AHEAD = "their stamps lie far ahead"
NUMBERS_BACK = "their numbers do not rise"
POSES_JUMP = "their poses jump"


class Refusal(NamedTuple):
    """Why a frame cannot follow the ones before it."""

    kind: str
    text: str


class Held(NamedTuple):
    """A frame, as its source delivered it, that waits for those after it."""

    frame: RawFrame
    refusal: Refusal


@dataclass
class Continuity:
    """How stamps and numbers of the source become those of the stream, and the frames held back."""

    offset_ns: int = 0
    number_offset: int = 0
    interval_ns: int = 0  # between the newest frames that followed each other; 0 = unknown
    held: list[Held] = field(default_factory=list)

    def shifted(self, frame: RawFrame) -> RawFrame:
        """The frame with stamp and number of the stream."""
        if not (self.offset_ns or self.number_offset):
            return frame
        return msgspec.structs.replace(
            frame, stamp_ns=frame.stamp_ns + self.offset_ns, frame_id=frame.frame_id + self.number_offset
        )

    def hold(self, frame: RawFrame, refusal: Refusal, cfg: Config) -> list[Held]:
        """Hold a frame back; those that it does not go on from are no longer held, and returned."""
        goes_on = self.held and self._goes_on(self.held[-1].frame, frame, cfg)
        dropped = [] if goes_on else self.release()
        self.held.append(Held(frame, refusal))
        return dropped

    def release(self) -> list[Held]:
        """All that is held."""
        held, self.held = self.held, []
        return held

    def believe(self, last: View) -> tuple[list[RawFrame], str]:
        """The held frames, so that they go on from the last one, and how the clock or the count jumped."""
        frames = [held.frame for held in self.release()]
        first, interval_ns = frames[0], frames[1].stamp_ns - frames[0].stamp_ns
        told = []
        jump_ns = first.stamp_ns + self.offset_ns - last.stamp_ns
        if jump_ns <= 0 or self._far(jump_ns):
            told.append(f"the clock jumped by {jump_ns / 1e9:+.3f} s at frame {first.frame_id}")
        if jump_ns <= 0:
            self.offset_ns = last.stamp_ns + interval_ns - first.stamp_ns
        if first.frame_id + self.number_offset <= last.frame_id:
            self.number_offset = last.frame_id + 1 - first.frame_id
            told.append(f"the numbers began again with {first.frame_id} after {last.frame_id}")
        self.interval_ns = interval_ns
        return [self.shifted(frame) for frame in frames], " and ".join(told)

    def out_of_line(self, last: View, frame: RawFrame) -> Refusal | None:
        """Why stamp or number of a shifted frame cannot follow the last one's."""
        step_ns = frame.stamp_ns - last.stamp_ns
        if step_ns <= 0:
            return Refusal(STAMPS_BACK, f"its stamp is {-step_ns / 1e9:.3f} s before the previous frame's")
        if frame.frame_id <= last.frame_id:
            return Refusal(NUMBERS_BACK, f"its number does not rise: frame {last.frame_id} came before")
        if self._far(step_ns):
            return Refusal(STAMPS_AHEAD, f"its stamp is {step_ns / 1e9:.3f} s after the previous frame's")
        return None

    def _far(self, step_ns: int) -> bool:
        return self.interval_ns > 0 and step_ns > max(AHEAD_NS, AHEAD_INTERVALS * self.interval_ns)

    def _goes_on(self, one: RawFrame, other: RawFrame, cfg: Config) -> bool:
        step_ns = other.stamp_ns - one.stamp_ns
        rises = step_ns > 0 and other.frame_id > one.frame_id and not self._far(step_ns)
        return rises and (one.camera != other.camera or reachable(View.of(one), other, cfg))


def reachable(view: View, frame: RawFrame, cfg: Config) -> bool:
    """Whether the camera can have moved from there to where the frame was taken."""
    if cfg.max_speed_m_s <= 0:
        return True
    distance_m = np.linalg.norm(frame.world_from_camera[:3, 3] - view.world_from_camera[:3, 3])
    return bool(distance_m <= cfg.max_speed_m_s * (frame.stamp_ns - view.stamp_ns) / 1e9)
