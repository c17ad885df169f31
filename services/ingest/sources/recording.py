"""MCAP logs of ours: the KEYFRAME and POSE_UPDATE messages of a recording or of the packed sample."""

import json
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.topics import KEYFRAME, POSE_UPDATE
from prior_sg.services.ingest.core.selection import BadFrame, Correction, RawFrame
from prior_sg.services.ingest.sources.base import UP, FrameError, Rig, Source, SourceError, levelling
from prior_sg.services.runtime.record import Content, LogError, attachments, contents, read_log

REGIONS = "regions.json"
log = logging.getLogger(__name__)


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0, robot: str = "") -> Source:
    """A log as a source. Raises SourceError."""
    try:
        found = contents(path)
        streams = [content for content in found if content.topic == KEYFRAME.name]
        key = KEYFRAME.pattern(robot) if robot else streams[0].key if streams else ""
        total = sum(content.messages for content in streams if content.key == key)
        if total == 0:
            raise SourceError(f"{path} holds no keyframes{f' of {robot}' if robot else ''}{_robots(streams)}")
        first = _first(path, key)
        files = attachments(path)
        ground_truth = json.loads(files[REGIONS]) if REGIONS in files else None
    except (LogError, ValueError) as error:
        raise SourceError(str(error)) from error
    world_from_source = levelling(world_up or UP, floor_m)
    corrected = any(content.topic == POSE_UPDATE.name for content in found)
    return Source(
        "log",
        path,
        first.intrinsics,
        total,
        lambda: _frames(path, key, total, world_from_source),
        ground_truth,
        lambda: _corrections(path, first.robot, world_from_source) if corrected else iter(()),
    )


def _frames(path: Path, key: str, total: int, world_from_source: np.ndarray | None) -> Iterator[RawFrame | BadFrame]:
    for index, payload in enumerate(_payloads(path, key)):
        frame_id = -1
        try:
            keyframe = decode(Keyframe, payload)
            frame_id = keyframe.frame_id
            rig = Rig(keyframe.intrinsics, keyframe.depth_scale_m, total, world_from_source)
            pose = np.array(keyframe.world_from_camera)
            images = {"color": keyframe.color, "depth": keyframe.depth, "mask": keyframe.mask}
            yield rig.frame(index, frame_id, keyframe.stamp_ns, pose, **images)
        except (DecodeError, FrameError) as error:
            yield BadFrame(frame_id=frame_id, reason=str(error), index=index, total=total)


def _corrections(path: Path, robot: str, world_from_source: np.ndarray | None) -> Iterator[Correction]:
    """Pose updates, each stamped as the newest keyframe before it: who wrote it may have had another clock."""
    stamp_ns = 0
    for logged in read_log(path, (KEYFRAME, POSE_UPDATE)):
        if logged.key not in (KEYFRAME.pattern(robot), POSE_UPDATE.pattern(robot)):
            continue
        try:
            message = decode(logged.topic.type, logged.payload)
        except DecodeError as error:
            log.warning("message unreadable", extra={"topic": logged.topic.name, "reason": str(error)})
            continue
        if isinstance(message, Keyframe):
            stamp_ns = message.stamp_ns
        elif isinstance(message, PoseUpdate):
            poses = np.array(message.world_from_camera)
            yield Correction(
                stamp_ns=stamp_ns,
                frame_ids=np.array(message.frame_ids),
                world_from_camera=poses if world_from_source is None else world_from_source @ poses,
            )


def _payloads(path: Path, key: str) -> Iterator[bytes]:
    return (logged.payload for logged in read_log(path, (KEYFRAME,)) if logged.key == key)


def _first(path: Path, key: str) -> Keyframe:
    for payload in _payloads(path, key):
        try:
            return decode(Keyframe, payload)
        except DecodeError:
            continue
    raise SourceError(f"no keyframe in {path} can be read: they come from another version")


def _robots(streams: list[Content]) -> str:
    names = sorted({content.key.split("/")[1] for content in streams})
    return f"; it holds those of {', '.join(names)}" if names else ""
