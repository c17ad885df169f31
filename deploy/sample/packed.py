"""A source as one MCAP log of ours: what the sample's packer and `prior-sg pack` share."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.codec import Message, encode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.topics import KEYFRAME, POSE_UPDATE, Topic
from prior_sg.services.ingest.core.frames import BadFrame, Correction, RawFrame
from prior_sg.services.ingest.sources import ReadOptions, Source, open_source
from prior_sg.services.ingest.sources.recording import REGIONS
from prior_sg.services.runtime.record import LogWriter


class PackError(UserError):
    """The source cannot be packed; the text is one sentence."""


def keyframe_of(frame: RawFrame, robot: str, color: bytes, depth: bytes) -> Keyframe:
    """A frame of a source as the message that a log holds."""
    return Keyframe(
        robot=robot,
        frame_id=frame.frame_id,
        stamp_ns=frame.stamp_ns,
        intrinsics=frame.intrinsics,
        world_from_camera=frame.world_from_camera,
        color=color,
        depth=depth,
        depth_scale_m=frame.depth_scale_m,
        mask=frame.mask,
        origin_m=frame.origin_m,
        camera=frame.camera,
    )


def pose_update_of(correction: Correction, robot: str, revision: int) -> PoseUpdate:
    """A correction of a source as the message that a log holds."""
    return PoseUpdate(
        robot=robot,
        epoch=0,
        revision=revision,
        stamp_ns=correction.stamp_ns,
        frame_ids=correction.frame_ids,
        world_from_camera=correction.world_from_camera,
    )


def write_log(
    path: Path, messages: Iterable[Message], writer: str, provenance: str, truth: dict[str, Any] | None
) -> None:
    """Write keyframes and pose updates, the ground truth and where all of it comes from. Raises LogError."""
    with LogWriter(path) as log:
        log.metadata("source", {"provenance": provenance})
        if truth is not None:
            log.attach(REGIONS, "application/json", json.dumps(truth).encode())
        for sequence, (topic, message) in enumerate(_topics(messages)):
            stamp_ns = max(message.stamp_ns, 0)
            log.add(
                topic, topic.key_of(message), encode(message), writer, sequence, sent_ns=stamp_ns, received_ns=stamp_ns
            )


def _topics(messages: Iterable[Message]) -> Iterator[tuple[Topic, Any]]:
    return ((KEYFRAME if isinstance(message, Keyframe) else POSE_UPDATE, message) for message in messages)


def pack_source(  # noqa: PLR0917
    path: str | Path,
    log_path: Path,
    options: ReadOptions | None = None,
    robot: str = "robot1",
    provenance: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Source, Counter[str]]:
    """Write what a source gives to a log; the source, and how many frames were refused for which reason.

    The log is complete or absent. Raises PackError, SourceError or LogError.
    """
    source = open_source(path, options=options)
    if source.live is not None:
        raise PackError(f"{path} is live: record it (of a robot, `ros2 bag record`), or pack the log.mcap of a run")
    refused: Counter[str] = Counter()
    partial = log_path.with_name(f"{log_path.name}.partial")
    try:
        write_log(partial, _messages(source, robot, refused, progress), robot, provenance, _truth(source))
        if refused.total() == source.total:
            top = refused.most_common(1)
            raise PackError(f"no frame of {path} can be packed: {top[0][0] if top else 'it holds none'}")
        partial.replace(log_path)
    finally:
        partial.unlink(missing_ok=True)
    return source, refused


def _messages(
    source: Source, robot: str, refused: Counter[str], progress: Callable[[int, int], None]
) -> Iterator[Message]:
    revision = 0
    for event in source.events():
        if isinstance(event, BadFrame):
            refused[event.reason] += 1
        elif isinstance(event, RawFrame):
            progress(event.index + 1, source.total)
            yield keyframe_of(event, robot, event.color, event.depth)
        elif isinstance(event, Correction):
            yield pose_update_of(event, robot, revision)
            revision += 1


def _truth(source: Source) -> dict[str, Any] | None:
    """The source's regions where they are ours; somebody else's file of that name stays behind."""
    try:
        return source.ground_truth if source.ground_truth and GroundTruth.from_json(source.ground_truth) else None
    except ValueError:
        return None
