"""`prior-sg demo --fleet`: two robots in one generated house of several storeys, merged live.

Each robot walks a part of the house in a frame of its own. What its services would tell goes onto a bus, where the
scene store and the bridge run as they do anywhere; the page shows the merged map as it grows. The house has no colour:
the robots see it by a simulated encoder.
"""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from prior_sg.deploy.evaluation.partial_walks import Part, Walks
from prior_sg.deploy.evaluation.robots import WalkingRobot
from prior_sg.deploy.fleet.bridge import SERVICE as FLEET
from prior_sg.deploy.fleet.core.update import Config
from prior_sg.deploy.running.inprocess import InProcess
from prior_sg.schemas.levels import regions_in
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.topics import PLACE_DELTA, SCENE, TASK
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.bus import BusError, LocalBus, message_in
from prior_sg.services.runtime.client import BusClient

KIND, SEED = "tower", 1
NAME, ROBOTS = "home", ("robot1", "robot2")
PARTS = (Part(0.0, 0.65, 1), Part(0.35, 1.0, 2))
STEP_S = 0.4  # between two keyframes of a robot
SETTLES_S = 3.0  # after the last keyframe, until the bridge has told all


class FleetDemo:
    """The house, its robots, and the services that merge what they tell."""

    def __init__(self, out: Path, say: Callable[[str], None], kind: str = KIND, seed: int = SEED) -> None:
        self.say = say
        out.mkdir(parents=True, exist_ok=True)
        say(f"building world:{kind}:{seed} and what can be seen in it")
        walks = Walks(out / "cache", kind=kind)
        self.robots = [walks.robot(seed, part, name) for part, name in zip(PARTS, ROBOTS, strict=True)]
        self._services = InProcess(NAME, out)
        store = BY_NAME["scene_store"]
        self._services.host(store, store.config(path=str(out / "scene.sqlite")), "scene_store-1")
        gateway = BY_NAME["prior_gateway"]
        self._services.host(gateway, gateway.config(archive=""), "prior_gateway-1")
        self._services.host(FLEET, Config(robots=ROBOTS), "fleet-1")
        self.client = BusClient(self.bus())
        self.client.listen(PLACE_DELTA, NAME, self._saw)
        self._stopping = threading.Event()

    def bus(self) -> LocalBus:
        """Another end of the bus, for a page."""
        return LocalBus(self._services.hub)

    def walk(self, step_s: float = STEP_S) -> None:
        """Both robots at once, until they have arrived or `stop` is called. Raises ChildFailed."""
        for robot in self.robots:
            self.client.publish(TASK, robot.task)
        for told in _in_turn(self.robots):
            started_s = time.monotonic()
            for topic, message in told:
                self.client.publish(topic, message)
            self._services.check()
            if self._stopping.wait(max(0.0, step_s / len(self.robots) - (time.monotonic() - started_s))):
                return
        self._stopping.wait(SETTLES_S)

    def stop(self) -> None:
        """Walk no farther."""
        self._stopping.set()

    def scene(self) -> Scene | None:
        """The merged map as stored; None before there is any."""
        try:
            scene: Scene = self.client.ask(SCENE, SceneRequest(robot=NAME))
        except BusError:
            return None
        return scene

    def close(self) -> None:
        """End everything."""
        self.stop()
        for robot in self.robots:
            robot.close()
        self.client.bus.close()
        self._services.stop()

    def _saw(self, sample: object) -> None:
        delta = message_in(sample)  # type: ignore[arg-type]
        if isinstance(delta, PlaceDelta) and delta.event:
            self.say(delta.event)


def _in_turn(robots: list[WalkingRobot]) -> Iterator[list]:
    """The steps of all robots, one of each in turn."""
    walking = [robot.steps() for robot in robots]
    while walking:
        for steps in list(walking):
            told = next(steps, None)
            if told is None:
                walking.remove(steps)
            else:
                yield told


def summary(scene: Scene) -> str:
    """The merged map in one sentence, its regions by floor."""
    on, counts = regions_in(scene.nodes, "floor"), f"{len(scene.place_ids)} places, {len(scene.objects)} objects"
    floors = [
        f"{node.label}: "
        + ", ".join(f"{one.label} {one.area_m2:.0f} m2" for one in scene.regions if on[one.id] == node.id)
        for node in sorted(scene.nodes, key=lambda node: node.position_m[2])
        if node.level == "floor"
    ]
    return f"{counts}, {len(scene.regions)} regions; {'; '.join(floors)}"
