"""MCAP logs of ours: the KEYFRAME messages of a recording or of the packed sample."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from schemas.codec import DecodeError, decode
from schemas.frames import Keyframe
from schemas.topics import KEYFRAME
from services.ingest.core import BadFrame, RawFrame
from services.ingest.sources.base import UP, FrameError, Rig, Source, SourceError, levelling
from services.runtime.record import Content, LogError, attachments, contents, read_log

REGIONS = "regions.json"


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0, robot: str = "") -> Source:
    """A log as a source. Raises SourceError."""
    try:
        streams = [content for content in contents(path) if content.topic == KEYFRAME.name]
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
    return Source(
        "log", path, first.intrinsics, total, lambda: _frames(path, key, total, world_from_source), ground_truth
    )


def _frames(path: Path, key: str, total: int, world_from_source: np.ndarray | None) -> Iterator[RawFrame | BadFrame]:
    for index, payload in enumerate(_payloads(path, key)):
        frame_id = -1
        try:
            keyframe = decode(Keyframe, payload)
            frame_id = keyframe.frame_id
            rig = Rig(keyframe.intrinsics, keyframe.depth_scale_m, total, world_from_source)
            pose = np.array(keyframe.world_from_camera)
            yield rig.frame(index, frame_id, keyframe.stamp_ns, pose, color=keyframe.color, depth=keyframe.depth)
        except (DecodeError, FrameError) as error:
            yield BadFrame(frame_id=frame_id, reason=str(error), index=index, total=total)


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
