"""What to do about losses, by what their reasons say."""

from collections.abc import Sequence

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running.job import Result
from prior_sg.schemas.status import Loss

ADVICE = (  # the first whose words are in the reason or its example; before all others those about single numbers
    ("stamps", "--rate HZ numbers the frames in place of their stamps; --stamp-unit says what unit they have"),
    ("numbers do not rise", "give every frame a number of its own"),
    (
        "poses jump",
        "--poses, --axes and --position-scale say how poses are written; ingest.max_speed_m_s=0 believes all",
    ),
    (
        "pose jumps",
        "--set place_graph.max_speed_m_s=SPEED believes a camera that moves so fast; --poses, --quaternion and --axes"
        " say how poses are written",
    ),
    ("no depth image", "--sync-tolerance SECONDS takes more together; --clock received counts arrival"),
    ("no pose lies within", "--sync-tolerance SECONDS takes poses farther away"),
    ("from the origin", "--origin auto moves the world's zero to the recording"),
    ("no measurement", "--depth-scale, --depth-min and --depth-max say what depth means"),
    ("no depth within range", "--depth-scale says how many metres a unit of depth is"),
    ("sees enough space", "--depth-scale says how many metres a unit of depth is"),
    ("principal point", "--intrinsics gives the camera of these images"),
    ("intrinsics are for", "--intrinsics gives the camera of these images; colour and depth must be registered"),
    ("orthonormal", "--quaternion says in which order quaternions are written"),
    ("bits per pixel", "store depth as 16-bit PNG"),
    ("decoded", "copy the recording again: its images are damaged"),
)
DEPTH_USELESS = "the depth shows no free space within range: check --depth-scale, --depth-min and --depth-max"


class NothingMappedError(UserError):
    """A run came to its end without a map."""


def check_mapped(result: Result, source: str) -> None:
    """Raise NothingMappedError, with the top reason and what to do, when a run mapped nothing."""
    if len(result.scene.place_ids):
        return
    told = list(zip(result.losses, result.loss_lines, strict=True))
    why = next((text for loss, text in told if loss.what != "clock jumps"), "")
    if not why:
        why = DEPTH_USELESS if result.counts.keyframes else "no frame of the source was read"
    advice = mend(result.losses)
    mends = f"; {advice}" if advice else ""
    raise NothingMappedError(f"nothing was mapped: {why}{mends}; `prior-sg check {source}` says more")


def mend(losses: Sequence[Loss]) -> str:
    """What to do about the most frequent of them for which something is known; empty = nothing is."""
    for loss in losses:
        for words, advice in ADVICE:
            if words in loss.reason or words in loss.example:
                return advice
    return ""
