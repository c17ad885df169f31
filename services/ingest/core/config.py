"""Settings of ingest (pure)."""

from typing import Literal

from prior_sg.services.ingest.core.options import ReadOptions, check_posed


class Config(ReadOptions, frozen=True, kw_only=True):
    """Where frames come from, how they are read, and which of them become keyframes.

    The paper does not publish its selection; this one is chosen on the development sequences so that neighbouring
    keyframes overlap by more than half at 60 to 75 degrees of view.
    """

    source: str = ""  # a folder of a layout in docs/sources.md, an MCAP log, ros2:/, realsense: or oak:; empty = none
    speed: float = 0.0  # times real time, by stamps; 0 = as fast as the pipeline drains
    when_behind: Literal["wait", "skip"] = "wait"  # wait for slow workers, or keep pace and encode only the newest, as
    # a live source always does
    # Keyframes under way before the source waits, or older ones are skipped; below the publisher's cache.
    window: int = 8
    every_frame: bool = False  # make every frame a keyframe
    min_translation_m: float = 0.25  # camera motion since the last keyframe that makes the next
    min_rotation_deg: float = 12.0  # the same for turning
    max_interval_s: float = 2.0  # the same for time, so that a resting camera still reports; 0 = never
    max_speed_m_s: float = 10.0  # faster camera motion is a jump of the tracker, and refused; 0 = believe everything
    archive_mb: float = 256.0  # compressed keyframes kept for ARCHIVE, oldest dropped first
    archive_path: str = ""  # file that keeps them beyond the end of the process; empty = none does

    def __post_init__(self) -> None:
        super().__post_init__()
        check_posed(self.source, self.pose_source)
        if self.window < 1:
            raise ValueError(f"window is {self.window}: with less than 1 the source would wait for ever")
