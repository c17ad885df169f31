"""Scenes at hand, for programs that have them in memory."""

import threading

import numpy as np

from prior_sg.deploy.api.client import Health
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.viewing.cloud import Cloud
from prior_sg.deploy.viewing.sources import Camera, Likeness, Say
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import PosteriorReply
from prior_sg.schemas.scene import Scene


class Held:
    """One scene after another, as they are put here; without images, votes and processes."""

    live = False

    def __init__(self, scene: Scene, title: str = "in memory") -> None:
        self.robot, self.title, self.cloud = scene.robot, title, Cloud()
        self._scenes = [scene]
        self._changed = threading.Event()

    def put(self, scene: Scene) -> None:
        """One more scene, the newest."""
        self._scenes.append(scene)
        self._changed.set()

    def stamps(self) -> list[int]:
        return [scene.stamp_ns for scene in self._scenes]

    def scene(self, moment: int | None = None) -> Scene:
        return self._scenes[-1 if moment is None else min(moment, len(self._scenes) - 1)]

    def wait(self, timeout_s: float) -> bool:
        changed = self._changed.wait(timeout_s)
        self._changed.clear()
        return changed

    def camera(self, until_ns: float = np.inf) -> Camera | None:
        return None

    def likeness(self, scene: Scene, text: str) -> Likeness:
        return Likeness({}, {}, "a scene alone has no encoder")

    def explain(self, place_id: int, say: Say) -> PosteriorReply:
        raise UserError("a scene alone holds beliefs but no votes")

    def prior(self, digest: str) -> Prior | None:
        return None

    def health(self) -> Health | None:
        return None

    def switch(self, task: str, environment: str, say: Say) -> str:
        raise UserError("a task is given to a running system (`prior-sg up`)")

    def close(self) -> None:
        self._changed.set()
