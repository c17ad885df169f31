"""A source as one MCAP log of ours: what the sample's packer and `prior-sg pack` share."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from prior_sg.schemas.codec import Message, encode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.topics import KEYFRAME, POSE_UPDATE, Topic
from prior_sg.services.ingest.core.selection import Correction, RawFrame
from prior_sg.services.ingest.sources import Source
from prior_sg.services.ingest.sources.recording import ORIGIN, REGIONS, SOURCE_METADATA
from prior_sg.services.runtime.record import LogWriter


class PackError(RuntimeError):
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


def write_log(  # noqa: PLR0917
    path: Path, source: Source, messages: Iterable[Message], writer: str, provenance: str, truth: dict[str, Any] | None
) -> None:
    """Write keyframes and pose updates, the ground truth and where all of it comes from. Raises LogError."""
    with LogWriter(path) as log:
        moved = {ORIGIN: " ".join(map(repr, source.origin_m))} if any(source.origin_m) else {}
        log.metadata(SOURCE_METADATA, {"provenance": provenance, **moved})
        if truth is not None:
            log.attach(REGIONS, "application/json", json.dumps(truth).encode())
        for sequence, (topic, message) in enumerate(_topics(messages)):
            stamp_ns = max(message.stamp_ns, 0)
            log.add(
                topic, topic.key_of(message), encode(message), writer, sequence, sent_ns=stamp_ns, received_ns=stamp_ns
            )


def _topics(messages: Iterable[Message]) -> Iterator[tuple[Topic, Any]]:
    return ((KEYFRAME if isinstance(message, Keyframe) else POSE_UPDATE, message) for message in messages)
