"""What arrives after a task was given: regions that follow it, and the names of objects."""

import contextlib
import threading
import time
from collections.abc import Mapping

from prior_sg.schemas.codec import DecodeError
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.priors import Task
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import Scene as SceneMessage
from prior_sg.services.runtime.bus import Sample, message_in


class Arrivals:
    """When the regions of a task arrived, by the prior they follow, and what names its objects got."""

    def __init__(self, task: Task) -> None:
        self._task, self._given_ns = task, time.time_ns()
        self._since_s = time.monotonic()
        self._found_s: dict[str, float] = {}
        self._names: dict[str, dict[int, str]] = {}  # by object, by prior
        self._changed = threading.Condition()

    def see(self, sample: Sample) -> None:
        """A delta sent after the task was given counts; the history may hold older ones of the same task."""
        with contextlib.suppress(DecodeError):
            delta: RegionDelta | ObjectDelta = message_in(sample)
            if sample.sent_ns <= self._given_ns:
                return
            with self._changed:
                if isinstance(delta, ObjectDelta):
                    told = {item.id: item.label for item in delta.objects}
                    self._names[delta.prior_digest] = self._names.get(delta.prior_digest, {}) | told
                elif delta.task == self._task.task:
                    self._found_s.setdefault(delta.prior_digest, time.monotonic())
                self._changed.notify()

    def seconds(self) -> float:
        """Since the task was given."""
        return time.monotonic() - self._since_s

    def wait(self, prior_digest: str, end_s: float) -> float | None:
        """Seconds from the task to the first regions of this prior; None when there are none by then."""
        return self._found_s[prior_digest] - self._since_s if self._wait(prior_digest, self._found_s, end_s) else None

    def wait_for_names(self, prior_digest: str, end_s: float) -> bool:
        """Whether objects got names of this prior by then."""
        return self._wait(prior_digest, self._names, end_s)

    def are_in(self, scene: SceneMessage, prior_digest: str) -> bool:
        """Whether the objects of a scene have the names of this prior that have arrived."""
        with self._changed:
            names = dict(self._names[prior_digest])
        return all(names.get(item.id, item.label) == item.label for item in scene.objects)

    def _wait(self, prior_digest: str, arrived: Mapping[str, object], end_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: prior_digest in arrived, max(end_s - time.monotonic(), 0))
