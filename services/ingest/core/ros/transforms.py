"""The tree of transforms of a robot, over time (pure).

A transform `parent_from_child` places a frame in its parent; stamps are nanoseconds.
"""

import math
import struct
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from prior_sg.services.geometry import inverse, pose_from_quaternion
from prior_sg.services.ingest.core.poses import PoseError

LONGEST_GAP_NS = 1_000_000_000  # between two stamps over which is interpolated
FARTHEST_M = 1e8  # a position beyond, or none, is of a damaged message
LONGEST_QUATERNION = 1e6  # one beyond, or below its inverse, is no rotation but a damaged message
NEARLY_PARALLEL = 1 - 1e-9  # cosine of half an angle beyond which an arc is a line
FIXED_FRAMES = ("map", "world", "odom")  # by preference


def frame_name(name: str) -> str:
    """A frame's name as ROS 2 writes it: ROS 1 may begin it with a slash."""
    return str(name).lstrip("/")


def stamp_ns_of(header: Any) -> int:
    """The stamp of a std_msgs/Header, of ROS 1 or 2, as numbers of its library."""
    stamp = header.stamp
    seconds = stamp.sec if hasattr(stamp, "sec") else stamp.secs
    rest = stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nsecs
    return int(seconds) * 1_000_000_000 + int(rest)


def written_stamp_ns(data: bytes, ros1: bool = False) -> int:
    """The stamp of a message, as bytes, that begins with a header. Raises ValueError with one sentence."""
    try:
        if ros1:
            seconds, rest = struct.unpack_from("<II", data, 4)
        else:
            seconds, rest = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    except (struct.error, IndexError) as error:
        raise ValueError("a message has no header") from error
    return int(seconds) * 1_000_000_000 + int(rest)


@dataclass(frozen=True)
class Stamped:
    """A transform as a message says it."""

    stamp_ns: int
    parent: str
    child: str  # empty = the message does not say of what its pose is
    position_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]

    def is_motion(self) -> bool:
        """Whether the position is on earth and the quaternion is one of a rotation, if not normalised."""
        length = math.hypot(*self.quaternion_xyzw)
        return math.hypot(*self.position_m) < FARTHEST_M and 1 / LONGEST_QUATERNION < length < LONGEST_QUATERNION

    def matrix(self) -> np.ndarray:
        """parent_from_child (4, 4) of a motion."""
        turn = np.array(self.quaternion_xyzw)
        return pose_from_quaternion(np.array(self.position_m), turn / np.linalg.norm(turn))


def transforms_of(message: Any) -> Iterator[Stamped]:
    """Those of a TFMessage, or the one of Odometry, TransformStamped, PoseStamped, PoseWithCovarianceStamped."""
    if hasattr(message, "transforms"):
        for one in message.transforms:
            yield from transforms_of(one)
        return
    if hasattr(message, "transform"):
        position, turn = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        position, turn = pose.position, pose.orientation
    yield Stamped(
        stamp_ns_of(message.header),
        frame_name(message.header.frame_id),
        frame_name(getattr(message, "child_frame_id", "")),
        (float(position.x), float(position.y), float(position.z)),
        (float(turn.x), float(turn.y), float(turn.z), float(turn.w)),
    )


class Track:
    """One transform over time, interpolated between its stamps."""

    def __init__(self, samples: Sequence[Stamped], fixed: bool = False, moves: bool = False) -> None:
        """`fixed`: it holds at all times; so does one that never changes, unless it is said that it `moves`.

        Of equal stamps the last counts.
        """
        by_stamp = {sample.stamp_ns: sample for sample in samples if sample.is_motion()}
        ordered = [by_stamp[stamp] for stamp in sorted(by_stamp)]
        self.stamps_ns = np.array([sample.stamp_ns for sample in ordered], np.int64)
        self.positions_m = np.array([sample.position_m for sample in ordered], np.float64).reshape(-1, 3)
        turns = np.array([sample.quaternion_xyzw for sample in ordered], np.float64).reshape(-1, 4)
        self.quaternions_xyzw = turns / np.linalg.norm(turns, axis=1, keepdims=True)
        still = len(ordered) > 1 and bool((np.ptp(np.hstack((self.positions_m, turns)), axis=0) == 0).all())
        self.fixed = bool(ordered) and (fixed or (still and not moves))

    def at(self, stamp_ns: int, within_ns: int) -> np.ndarray:
        """parent_from_child (4, 4); before the first and after the last stamp at most `within_ns` away.

        Raises PoseError.
        """
        if self.fixed:
            return self._sample(-1)
        right = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if right < len(self.stamps_ns) and self.stamps_ns[right] == stamp_ns:
            return self._sample(right)
        around = self.stamps_ns[max(0, right - 1) : right + 1]
        if len(around) == 2 and right > 0 and around[1] - around[0] <= LONGEST_GAP_NS:
            return self._between(right, (stamp_ns - int(around[0])) / int(around[1] - around[0]))
        nearest = min(range(len(self.stamps_ns))[max(0, right - 1) : right + 1], key=self._away(stamp_ns), default=None)
        if nearest is None or self._away(stamp_ns)(nearest) > within_ns:
            raise PoseError(f"no pose lies within {within_ns / 1e6:.0f} ms of it")
        return self._sample(nearest)

    def _away(self, stamp_ns: int) -> Any:
        return lambda index: abs(int(self.stamps_ns[index]) - stamp_ns)

    def _sample(self, index: int) -> np.ndarray:
        return pose_from_quaternion(self.positions_m[index], self.quaternions_xyzw[index])

    def _between(self, right: int, share: float) -> np.ndarray:
        """On the line of positions and the shortest arc of rotations."""
        position_m = (1 - share) * self.positions_m[right - 1] + share * self.positions_m[right]
        first, second = self.quaternions_xyzw[right - 1], self.quaternions_xyzw[right]
        cosine = float(first @ second)
        if cosine < 0:
            second, cosine = -second, -cosine
        if cosine > NEARLY_PARALLEL:
            return pose_from_quaternion(position_m, (1 - share) * first + share * second)
        angle = np.arccos(cosine)
        turn = (np.sin((1 - share) * angle) * first + np.sin(share * angle) * second) / np.sin(angle)
        return pose_from_quaternion(position_m, turn)


class TransformTree:
    """Frames and their parents. Nothing is said of a tree with loops or two parents until somebody asks through it."""

    def __init__(self, moving: Sequence[Stamped] = (), fixed: Sequence[Stamped] = ()) -> None:
        """`moving` of /tf, `fixed` of /tf_static, which wins."""
        edges: dict[str, dict[str, tuple[list[Stamped], bool]]] = defaultdict(dict)
        for samples, always in ((fixed, True), (moving, False)):
            for sample in samples:
                parents = edges[sample.child]
                if always or not any(fixed_one for _, fixed_one in parents.values()):
                    parents.setdefault(sample.parent, ([], always))[0].append(sample)
        self._edges: dict[str, dict[str, Track]] = {
            child: {parent: Track(samples, always) for parent, (samples, always) in parents.items()}
            for child, parents in edges.items()
        }

    @classmethod
    def of_tracks(cls, tracks: dict[str, dict[str, Track]]) -> "TransformTree":
        """The tree whose transforms are these, by child and parent."""
        tree = cls()
        tree._edges = tracks
        return tree

    def ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root. Raises PoseError for a loop and for two parents."""
        chain = [frame]
        while parents := self._edges.get(chain[-1]):
            if len(parents) > 1:
                raise PoseError(f"tf gives the frame {chain[-1]} several parents: {', '.join(sorted(parents))}")
            (parent,) = parents
            if parent in chain:
                raise PoseError(f"tf is a loop: {' <- '.join([*chain, parent])}")
            chain.append(parent)
        return chain

    def moves(self, ancestor: str, frame: str) -> bool:
        """Whether the frame moves in its ancestor."""
        chain = self.ancestors(frame)
        steps = chain[: chain.index(ancestor)] if ancestor in chain else []
        return any(not track.fixed for child in steps for track in self._edges[child].values())

    def connects(self, target: str, source: str) -> bool:
        """Whether a transform between two frames can be asked for."""
        return target == source or bool(set(self.ancestors(target)) & set(self.ancestors(source)))

    def at(self, target: str, source: str, stamp_ns: int, within_ns: int) -> np.ndarray:
        """target_from_source (4, 4) at a time. Raises PoseError."""
        up, down = self.ancestors(source), self.ancestors(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise PoseError(f"tf does not connect {source} with {target}")
        common_from_target = self._climb(down, common, stamp_ns, within_ns)
        common_from_source = self._climb(up, common, stamp_ns, within_ns)
        return common_from_source if target == common else inverse(common_from_target) @ common_from_source

    def fixed_frame(self, frame: str) -> str:
        """The frame above in which this one moves and in which a map belongs; empty where it moves in none."""
        chain = self.ancestors(frame)
        known = [name for name in FIXED_FRAMES if name in chain]
        return next((name for name in (*known, chain[-1]) if self.moves(name, frame)), "")

    def _climb(self, chain: list[str], ancestor: str, stamp_ns: int, within_ns: int) -> np.ndarray:
        """ancestor_from_frame of a chain that begins with the frame."""
        ancestor_from_frame = np.eye(4)
        for child in chain[: chain.index(ancestor)]:
            (track,) = self._edges[child].values()
            try:
                ancestor_from_frame = track.at(stamp_ns, within_ns) @ ancestor_from_frame
            except PoseError as error:
                raise PoseError(f"tf of {child}: {error}") from error
        return ancestor_from_frame
