"""Where the page's scenes come from: what it asks of a running system and of a file alike."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from prior_sg.deploy.api.client import Health
from prior_sg.deploy.viewing.cloud import Cloud
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import PosteriorReply
from prior_sg.schemas.scene import Scene

Say = Callable[[str], None]  # tells whoever waits what is going on


@dataclass(frozen=True)
class Camera:
    """One image and where it was taken."""

    frame_id: int
    stamp_ns: int
    intrinsics: Intrinsics
    world_from_camera: np.ndarray  # (4, 4)
    image: np.ndarray  # (row, column, 3) uint8, made smaller
    depth: Keyframe | None = None  # the keyframe without its colour, to decode its depth of; none = there is none


@dataclass(frozen=True)
class Likeness:
    """How probably regions and objects answer a text, by label; what was missing to find it out, as a sentence."""

    regions: dict[str, float]
    objects: dict[str, float]
    missing: str = ""


class Source(Protocol):
    """One robot's scene over time. Its methods may be called from any thread and raise PriorSgError."""

    robot: str
    title: str  # what it is, in a few words
    live: bool  # whether more comes by itself
    cloud: Cloud

    def stamps(self) -> list[int]:
        """When each moment was that can be shown, in order (nanoseconds)."""

    def scene(self, moment: int | None = None) -> Scene:
        """The scene at one of `stamps`; None = the newest."""

    def wait(self, timeout_s: float) -> bool:
        """Wait so long for something new; whether there is any since the last call that said so."""

    def camera(self, until_ns: float = np.inf) -> Camera | None:
        """The last image no later than that."""

    def likeness(self, scene: Scene, text: str) -> Likeness:
        """How probably what carries a label answers a text, found out in the scene's embedding space; may take long."""

    def explain(self, place_id: int, say: Say) -> PosteriorReply:
        """Why a place carries its label, at the newest moment; may take long, then it says why."""

    def prior(self, digest: str) -> Prior | None:
        """The prior of that digest, if it is known."""

    def health(self) -> Health | None:
        """Every process; None where nothing runs."""

    def switch(self, task: str, environment: str, say: Say) -> str:
        """Give the robot another task and wait for its regions; a sentence about how it went."""

    def close(self) -> None:
        """Leave the system, close the files."""
