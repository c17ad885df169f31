"""A robot that walks through a generated world with a simulated encoder: what its services would tell, keyframe by
keyframe, in a frame of its own. Worlds have no colour, so that a real encoder would see nothing in them.
"""

from collections.abc import Callable, Iterator, Sequence

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Pyramid, TextEmbeddings
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.schemas.places import MapRequest, VoxelMap
from prior_sg.schemas.priors import Prior, Task
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import (
    KEYFRAME,
    OBJECT_DELTA,
    PLACE_DELTA,
    PRIOR,
    PYRAMID,
    REGION_DELTA,
    TASK,
    TEXT,
    VOXEL_MAP,
    Topic,
)
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core.config import Config

EVERY = 5  # keyframes from one look at regions and objects to the next
TOLD = (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA)
Concepts = list[list[str]]


class WalkingRobot:
    """`frames` and `pyramids` stand in the robot's frame; `detect` tells the objects in what is mapped."""

    def __init__(
        self,
        name: str,
        frames: Sequence[Keyframe],
        pyramids: Sequence[Pyramid],
        *,
        prior: Prior,
        text: Callable[[Concepts], TextEmbeddings],
        detect: Callable[[VoxelMap], list[SceneObject]],
    ) -> None:
        self.name, self.frames = name, frames
        self._pyramids = {one.frame_id: one for one in pyramids}
        self._prior, self._detect = prior, detect
        places, segmenter = BY_NAME["place_graph"], BY_NAME["segmenter"]
        space = pyramids[0].space if pyramids else ""
        self._mapper = Runner(places, places.config(), Identity(name, "place_graph", 1))
        self._labeller = Runner(
            segmenter,
            Config(space=space) if space else Config(),
            Identity(name, "segmenter", 1),
            {TEXT: lambda request: text(request.concepts)},
        )
        self._pipeline = Pipeline((self._mapper, self._labeller))
        self._objects: dict[int, SceneObject] = {}
        self._revision = -1

    @property
    def task(self) -> Task:
        """What its prior answers."""
        prior = self._prior
        return Task(
            robot=self.name, stamp_ns=1, environment=prior.environment, task=prior.task, regions=prior.vocabulary
        )

    def steps(self) -> Iterator[list[tuple[Topic, Message]]]:
        """What the robot tells after each keyframe: changes of places, regions and objects."""
        published = self._pipeline.publish(TASK, self.task) + self._pipeline.publish(PRIOR, self._prior)
        for number, frame in enumerate(self.frames, 1):
            published += self._pipeline.publish(KEYFRAME, msgspec.structs.replace(frame, robot=self.name))
            if (pyramid := self._pyramids.get(frame.frame_id)) is not None:
                published += self._pipeline.publish(PYRAMID, msgspec.structs.replace(pyramid, robot=self.name))
            told = [(topic, message) for topic, message in published if topic in (PLACE_DELTA, REGION_DELTA)]
            if number % EVERY == 0 or number == len(self.frames):
                looked = self._pipeline.feed(self._labeller, Tick(stamp_ns=frame.stamp_ns))
                told += [(topic, message) for topic, message in looked if topic is REGION_DELTA]
                told += self._things(frame.stamp_ns)
            yield told
            published = []

    def close(self) -> None:
        """Let its services end."""
        self._pipeline.close()

    def _things(self, stamp_ns: int) -> list[tuple[Topic, Message]]:
        voxels = self._mapper.answer(VOXEL_MAP, MapRequest(robot=self.name))
        now = {item.id: item for item in self._detect(voxels)}
        news = [item for number, item in sorted(now.items()) if self._objects.get(number) != item]
        gone = sorted(self._objects.keys() - now.keys())
        self._objects = now
        if not (news or gone):
            return []
        self._revision += 1
        delta = ObjectDelta(
            robot=self.name,
            epoch=1,
            revision=self._revision,
            stamp_ns=stamp_ns,
            prior_digest=self._prior.digest(),
            objects=news,
            removed_ids=np.array(gone, np.int64),
        )
        return [(OBJECT_DELTA, delta)]
