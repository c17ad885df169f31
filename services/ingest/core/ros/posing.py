"""How the pose of a robot's camera is found: through tf, or from a topic of poses and on through tf (pure)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.topics import NAMED, TF_TYPES, Topic
from prior_sg.services.ingest.core.ros.transforms import Stamped, Track, TransformTree


@dataclass(frozen=True)
class Way:
    """From a camera to the world."""

    camera: str  # its frame
    fixed: str = ""  # the world, of tf; empty = a topic's poses are in the world
    topic: str = ""  # of poses
    body: str = ""  # the frame whose poses the topic has
    said: str = ""  # one phrase
    drifting: str = ""  # the frame below the world that a SLAM corrects; empty = none

    def at(self, tree: TransformTree, track: Track, stamp_ns: int, within_ns: int) -> np.ndarray:
        """world_from_camera (4, 4) at a stamp; `track` is of the topic's poses. Raises PoseError."""
        if self.fixed:
            return tree.at(self.fixed, self.camera, stamp_ns, within_ns)
        pose = track.at(stamp_ns, within_ns)
        return pose if self.body == self.camera else pose @ tree.at(self.body, self.camera, stamp_ns, within_ns)


def way_of(
    camera: str,
    tree: TransformTree,
    options: ReadOptions,
    topics: Sequence[Topic],
    poses: Mapping[str, Sequence[Stamped]],
) -> Way:
    """tf, where it moves the camera and no topic is told, else a topic of poses. Raises PoseError."""
    posing = [topic for topic in topics if topic.type not in TF_TYPES]
    if not (options.pose_topic and posing):
        fixed = options.fixed_frame or tree.fixed_frame(camera)
        if options.fixed_frame and not tree.connects(options.fixed_frame, camera):
            raise PoseError(f"tf does not connect {camera} with {fixed}, which is asked for")
        if fixed:
            said = f"poses of {camera} in {fixed}"
            return Way(camera, fixed=fixed, said=said, drifting=_drifting(tree, camera, fixed))
    if not posing:
        where = tree.ancestors(camera)[-1]
        raise PoseError(
            f"nothing says how the camera moves: in tf its frame {camera!r} stays where it is in {where!r}, and "
            "there is no topic of odometry or poses"
        )
    return _of_topic(camera, tree, options, posing[0], poses.get(posing[0].name, ()))


def _of_topic(camera: str, tree: TransformTree, options: ReadOptions, topic: Topic, samples: Sequence[Stamped]) -> Way:
    """Poses of a topic, carried on to the camera's frame. Raises PoseError."""
    if not any(sample.is_motion() for sample in samples):
        raise PoseError(f"{topic.name} has no poses that can be read")
    bodies = {sample.child for sample in samples}
    if len(bodies) > 1:
        raise PoseError(f"{topic.name} has poses of several frames: {', '.join(sorted(bodies)[:NAMED])}")
    body = options.pose_frame or bodies.pop() or camera
    if not tree.connects(body, camera):
        raise PoseError(
            f"{topic.name} has poses of {body!r}, and tf does not connect it with the camera's {camera!r}; "
            f"give --pose-frame {camera} when they are the camera's own"
        )
    said = f"poses of {topic.name} ({topic.type.rpartition('/')[2]} of {body or 'the camera'})"
    return Way(camera, topic=topic.name, body=body, said=said)


def _drifting(tree: TransformTree, camera: str, fixed: str) -> str:
    """The frame right below the world, where the camera moves in it too: odom below map (REP 105)."""
    chain = tree.ancestors(camera)
    if fixed not in chain[1:]:
        return ""
    below = chain[chain.index(fixed) - 1]
    return below if tree.moves(below, camera) else ""
