"""What is streamed: walks through generated worlds, and the demo's sample played back and forth, as painted logs."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice, repeat
from pathlib import Path

import cv2
import numpy as np

from prior_sg.deploy.evaluation.datasets import named_worlds, world_source
from prior_sg.deploy.evaluation.worlds import world_of
from prior_sg.deploy.sample import SAMPLE
from prior_sg.deploy.sample.packed import keyframe_of, write_log
from prior_sg.deploy.settings import DEMO_ENVIRONMENT
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.sources import Source, open_source
from tests.chaos.painted import painted

ROBOT = "robot1"
MOVED_M, TURNED_RAD = 0.3, 0.25  # between two frames of a stream
STEP_NS = 500_000_000
SHORTER_PX = 120  # side of the images
SAMPLE_NAME = "sample"


@dataclass(frozen=True)
class Stream:
    """A log of painted keyframes."""

    name: str
    path: Path
    frames: int
    environment: str
    labels: tuple[str, ...]


def made(name: str, frames: int, folder: Path) -> Stream:
    """The stream of a name: `sample`, or a world such as `world:home:3`. It is written once."""
    path = folder / f"{name.replace(':', '-')}-{frames}.mcap"
    if name == SAMPLE_NAME:
        source, environment = open_source(SAMPLE), DEMO_ENVIRONMENT
        assert source.ground_truth is not None
        truth = GroundTruth.from_json(source.ground_truth)
    else:
        (world,) = named_worlds(name)
        source = world_source(world)
        built = world_of(world.kind, world.seed)
        environment, truth = built.environment, built.truth
    labels = tuple(dict.fromkeys(region.label for region in truth.regions))
    if not path.exists():
        partial = path.with_suffix(".partial")
        write_log(partial, _keyframes(source, truth, frames), "chaos", f"{name}, painted", source.ground_truth)
        partial.replace(path)
    return Stream(name, path, frames, environment, labels)


def _keyframes(source: Source, truth: GroundTruth, frames: int) -> Iterator[Keyframe]:
    """Views far enough from each other, forwards, then backwards and so on."""
    views = list(islice(_views(source, truth), frames))
    turns = chain.from_iterable(chain(views, reversed(views[1:-1])) for _ in repeat(None))
    for number, (camera, pose, color, depth) in enumerate(islice(turns, frames)):
        frame = RawFrame(
            frame_id=number,
            stamp_ns=(number + 1) * STEP_NS,
            intrinsics=camera,
            world_from_camera=pose,
            color=color,
            depth=depth,
            depth_scale_m=0.001,
            index=number,
            total=0,
        )
        yield keyframe_of(frame, ROBOT, color, depth)


def _views(source: Source, truth: GroundTruth) -> Iterator[tuple[Intrinsics, np.ndarray, bytes, bytes]]:
    last = None
    for frame in source:
        if not isinstance(frame, RawFrame):
            continue
        pose = frame.world_from_camera
        if last is not None:
            moved = inverse(last) @ pose
            if np.linalg.norm(moved[:3, 3]) < MOVED_M and rotation_angle_rad(moved) < TURNED_RAD:
                continue
        last = pose
        stored = cv2.imdecode(np.frombuffer(frame.depth, np.uint8), cv2.IMREAD_UNCHANGED)
        camera, depth_m = _smaller(frame.intrinsics, stored * frame.depth_scale_m)
        millimetres = np.rint(depth_m * 1000).astype(np.uint16)
        yield camera, pose, painted(depth_m, camera, pose, truth), cv2.imencode(".png", millimetres)[1].tobytes()


def _smaller(camera: Intrinsics, depth_m: np.ndarray) -> tuple[Intrinsics, np.ndarray]:
    """Every n-th pixel, so that the shorter side is about SHORTER_PX."""
    step = max(1, min(camera.width_px, camera.height_px) // SHORTER_PX)
    depth_m = depth_m[step // 2 :: step, step // 2 :: step]
    height, width = depth_m.shape
    centre = [(at - step // 2) / step for at in (camera.cx_px, camera.cy_px)]
    return Intrinsics(width, height, camera.fx_px / step, camera.fy_px / step, *centre), depth_m
