"""Reads keyframes, keeps the map and the place graph, writes what changed."""

from collections.abc import Iterator

import cv2
import numpy as np

from schemas.codec import Message
from schemas.frames import ArchiveReply, ArchiveRequest, Keyframe, PoseUpdate
from schemas.places import MapRequest, PlaceDelta, SnapshotRequest, VoxelMap
from schemas.topics import ARCHIVE, KEYFRAME, PLACE_DELTA, PLACE_SNAPSHOT, POSE_UPDATE, VOXEL_MAP
from services.place_graph import core
from services.runtime.service import Ask, Identity, Output, Service


def init(cfg: core.Config, identity: Identity) -> core.State:
    """An empty map."""
    return core.empty(identity.robot, identity.epoch, cfg)


def step(state: core.State, message: Message, cfg: core.Config) -> Iterator[Output]:
    """One keyframe gives one delta, with or without changes; a repeated keyframe gives nothing. A process that joins in
    mid-stream fetches what it has missed from the archive, page by page."""
    match message:
        case Keyframe():
            if not state.cameras_m and message.frame_id > 0:
                state.joined_frame_id = message.frame_id
                yield _ask_archive(state.robot, 0, message.frame_id)
            yield from _map(state, message, cfg)
        case PoseUpdate():
            core.correct(state, message)
        case ArchiveReply():
            for keyframe in message.keyframes:
                yield from _map(state, keyframe, cfg)
            if message.keyframes:
                yield _ask_archive(state.robot, message.keyframes[-1].frame_id + 1, state.joined_frame_id)


def _ask_archive(robot: str, first_frame_id: int, end_frame_id: int) -> Ask:
    return Ask(ARCHIVE, ArchiveRequest(robot=robot, first_frame_id=first_frame_id, end_frame_id=end_frame_id))


def _map(state: core.State, keyframe: Keyframe, cfg: core.Config) -> Iterator[Output]:
    if keyframe.frame_id not in state.cameras_m:
        depth_m = depth_of(keyframe) if core.within_reach(keyframe, cfg) else None
        delta = core.reject(state, keyframe, cfg) if depth_m is None else core.integrate(state, keyframe, depth_m, cfg)
        yield PLACE_DELTA, delta


def depth_of(keyframe: Keyframe) -> np.ndarray | None:
    """Depth (h, w) float32 in metres, 0 = no measurement; None if the image is not a usable 16-bit depth image."""
    try:
        image = cv2.imdecode(np.frombuffer(keyframe.depth, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # empty, or a header that promises an absurd size
        return None
    size = (keyframe.intrinsics.height_px, keyframe.intrinsics.width_px)
    if image is None or image.shape != size or image.dtype != np.uint16 or not image.any():
        return None
    return image.astype(np.float32) * np.float32(keyframe.depth_scale_m)


def _snapshot(state: core.State, request: SnapshotRequest, cfg: core.Config) -> PlaceDelta:
    return core.snapshot(state, cfg)


def _voxel_map(state: core.State, request: MapRequest, cfg: core.Config) -> VoxelMap:
    return core.voxel_map(state, cfg)


SERVICE = Service(
    "place_graph",
    purpose=__doc__ or "",
    scope="robot",
    config=core.Config,
    init=init,
    step=step,
    reads=(KEYFRAME, POSE_UPDATE),
    writes=(PLACE_DELTA,),
    asks=(ARCHIVE,),
    answers={PLACE_SNAPSHOT: _snapshot, VOXEL_MAP: _voxel_map},
)
