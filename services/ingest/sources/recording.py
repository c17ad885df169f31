"""MCAP logs of ours: the KEYFRAME and POSE_UPDATE messages of a recording or of the packed sample."""

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.frames import Intrinsics, Keyframe, PoseUpdate
from prior_sg.schemas.topics import KEYFRAME, POSE_UPDATE
from prior_sg.services.ingest.core.frames import BadFrame, Correction, RawFrame
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import Camera, Found, Images, Source, SourceError, Wanted, shifted_truth
from prior_sg.services.ingest.sources.normalise import LOOKED_AT, prepare
from prior_sg.services.ingest.sources.normaliser import UNUSABLE, Normaliser
from prior_sg.services.runtime.record import (
    Content,
    LogError,
    attachments,
    contents,
    foreign_topics,
    is_whole,
    loss,
    read_log,
)

NAME = "log"
REGIONS = "regions.json"
log = logging.getLogger(__name__)
Rig = tuple[Intrinsics, float]


@dataclass(frozen=True)
class Log:
    """One robot's stream in a log."""

    path: Path
    key: str
    total: int
    first: Keyframe
    truth: dict[str, Any] | None
    notes: tuple[str, ...]  # on what of the file is not read


def load(path: Path, options: ReadOptions) -> Source:
    """A log as a source. Raises SourceError."""
    try:
        return _load(path, options)
    except LogError as error:
        raise SourceError(str(error)) from error


def _load(path: Path, options: ReadOptions) -> Source:
    recorded, corrected = _opened(path, options.source_robot)
    samples = _samples(recorded, Convention().changed(options))
    found = Found(NAME, path, Camera(recorded.first.intrinsics), recorded.first.depth_scale_m, ())
    moved, prepared = prepare(found, options, samples)
    notes = (*recorded.notes, *prepared)
    normaliser = replace(moved, origin_m=_sum(recorded.first.origin_m, moved.origin_m))
    if options.rate_hz:
        notes = (*notes, f"{options.rate_hz:g} frames a second, as told, in place of the stamps")

    @cache
    def normaliser_of(rig: Rig) -> Normaliser:
        """A robot may change its camera, or its settings, on the way."""
        if rig == (recorded.first.intrinsics, recorded.first.depth_scale_m):
            return normaliser
        other = prepare(replace(found, camera=Camera(rig[0]), depth_scale_m=rig[1]), options, ())[0]
        return replace(other, world_from_source=normaliser.world_from_source, origin_m=normaliser.origin_m)

    return Source(
        layout=NAME,
        path=path,
        intrinsics=normaliser.intrinsics,
        total=recorded.total,
        frames=lambda: _frames(recorded, normaliser_of, options),
        ground_truth=shifted_truth(recorded.truth, moved.origin_m),
        corrections=lambda: _corrections(recorded, normaliser, options) if corrected else iter(()),
        why=("it is an MCAP log of ours",),
        notes=notes,
        origin_m=normaliser.origin_m,
        convention=Convention().changed(options),
        depth_unit_m=normaliser.depth.unit_m,
        world_from_source=normaliser.world_from_source,
        thinned=lambda wanted: _frames(recorded, normaliser_of, options, wanted),
    )


def _sum(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _opened(path: Path, robot: str) -> tuple[Log, bool]:
    """The stream that was asked for, and whether its poses were corrected. Raises SourceError and LogError."""
    try:
        found = contents(path)
        streams = [content for content in found if content.topic == KEYFRAME.name]
        key = KEYFRAME.pattern(robot) if robot else streams[0].key if streams else ""
        total = sum(content.messages for content in streams if content.key == key)
        if total == 0:
            raise SourceError(
                f"{path} holds no keyframes{f' of {robot}' if robot else ''}{_robots(streams) or _others(path, found)}"
            )
        truth, damaged = _truth(path)
    except ValueError as error:
        raise SourceError(f"the ground truth in {path} cannot be read: {error}") from error
    recorded = Log(path, key, total, _first(path, key), truth, (*_notes(path, streams, key), *damaged))
    return recorded, any(content.topic == POSE_UPDATE.name for content in found)


def _truth(path: Path) -> tuple[dict[str, Any] | None, list[str]]:
    """The ground truth, and a note where it may be in a part that is damaged. Raises ValueError."""
    try:
        files = attachments(path)
    except LogError as error:
        return None, [f"it is read without ground truth: {error}"]
    return json.loads(files[REGIONS]) if REGIONS in files else None, []


def _samples(recorded: Log, convention: Convention) -> list[tuple[np.ndarray, Images]]:
    """Poses and images of the first frames that have the first one's camera."""
    samples: list[tuple[np.ndarray, Images]] = []
    for payload in _payloads(recorded.path, recorded.key):
        try:
            keyframe = decode(Keyframe, payload)
        except DecodeError:
            continue
        if keyframe.intrinsics == recorded.first.intrinsics and keyframe.depth_scale_m == recorded.first.depth_scale_m:
            samples.append((convention.of_matrix(np.array(keyframe.world_from_camera)), _images(keyframe)))
        if len(samples) == LOOKED_AT:
            break
    return samples


def _images(keyframe: Keyframe) -> Images:
    return Images(bytes(keyframe.color), bytes(keyframe.depth), bytes(keyframe.mask))


def _frames(
    recorded: Log, normaliser_of: Callable[[Rig], Normaliser], options: ReadOptions, wanted: Wanted | None = None
) -> Iterator[RawFrame | BadFrame]:
    total, convention = recorded.total, Convention().changed(options)
    index = -1
    for index, payload in enumerate(_payloads(recorded.path, recorded.key)):
        frame_id = -1
        try:
            keyframe = decode(Keyframe, payload)
            frame_id = keyframe.frame_id
            stamp_ns = options.told_ns(index, keyframe.stamp_ns)
            pose = convention.of_matrix(np.array(keyframe.world_from_camera))
            rig = keyframe.intrinsics, keyframe.depth_scale_m
            normaliser = replace(normaliser_of(rig), camera=keyframe.camera)
            make = normaliser.frame if wanted is None or wanted(index, normaliser.pose(pose)) else normaliser.bare
            yield make(index, total, frame_id, stamp_ns, pose, _images(keyframe))
        except (DecodeError, SourceError, *UNUSABLE) as error:
            yield BadFrame(frame_id=frame_id, reason=str(error), index=index, total=total)
    for lost in range(index + 1, total):
        yield BadFrame(frame_id=-1, reason="it lies in a damaged part of the log", index=lost, total=total)


def _corrections(recorded: Log, normaliser: Normaliser, options: ReadOptions) -> Iterator[Correction]:
    """Pose updates, each stamped as the newest keyframe before it: who wrote it may have had another clock."""
    stamp_ns, robot, convention = 0, recorded.first.robot, Convention().changed(options)
    for logged in read_log(recorded.path, (KEYFRAME, POSE_UPDATE), _damaged):
        if logged.key not in (KEYFRAME.pattern(robot), POSE_UPDATE.pattern(robot)):
            continue
        try:
            message = decode(logged.topic.type, logged.payload)
        except DecodeError as error:
            log.warning("message unreadable", extra={"topic": logged.topic.name, "why": str(error)})
            continue
        if isinstance(message, Keyframe):
            stamp_ns = message.stamp_ns
        elif isinstance(message, PoseUpdate):
            yield Correction(
                stamp_ns=stamp_ns,
                frame_ids=np.array(message.frame_ids),
                world_from_camera=normaliser.pose(
                    np.stack([convention.of_matrix(pose) for pose in np.array(message.world_from_camera)])
                ),
            )


def _payloads(path: Path, key: str) -> Iterator[bytes]:
    """What is damaged is left out, and warned of."""
    return (logged.payload for logged in read_log(path, (KEYFRAME,), _damaged) if logged.key == key)


def _damaged(error: LogError) -> None:
    log.warning("%s", error)


def _first(path: Path, key: str) -> Keyframe:
    for payload in _payloads(path, key):
        try:
            return decode(Keyframe, payload)
        except DecodeError:
            continue
    raise SourceError(f"no keyframe in {path} can be read: they are damaged, or of another version")


def _notes(path: Path, streams: Sequence[Content], key: str) -> Iterator[str]:
    """What of the log is not read. Raises LogError."""
    counts = {content.key: 0 for content in streams}
    for content in streams:
        counts[content.key] += content.messages
    if len(counts) > 1:
        told = ", ".join(f"{other.split('/')[1]} ({count} keyframes)" for other, count in counts.items())
        yield f"it holds the robots {told}: {key.split('/')[1]} is read; --set ingest.source_robot=NAME reads another"
    if lost := loss(path):
        yield f"of the log the {counts[key]} keyframes that are complete are read: {lost}"


def _others(path: Path, found: Sequence[Content]) -> str:
    """What a log without keyframes holds instead, as the end of a sentence. Raises LogError."""
    if ours := sorted({content.topic[:60] for content in found}):
        return f"; of ours it holds {', '.join(ours[:5])}: record a system with its ingest"
    topics = foreign_topics(path)
    if not topics:
        return "; it holds no messages of ours" if is_whole(path) else ": it was cut off before its first complete part"
    told = ", ".join(topic[:60] for topic in topics[:5])
    if not is_whole(path):
        mend = f"`mcap recover {path.name} -o whole.mcap` keeps what is complete"
        return f": it was written by another program (topics {told}), and its end is missing or damaged; {mend}"
    return f": it was written by another program (topics {told}); export its images, depth and poses into a folder"


def _robots(streams: Sequence[Content]) -> str:
    names = sorted({content.key.split("/")[1] for content in streams})
    return f"; it holds those of {', '.join(names)}" if names else ""
