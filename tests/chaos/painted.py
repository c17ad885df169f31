"""Pictures painted by what they show, and an encoder that reads the paint: the network of these tests costs nothing.

Each label has one colour, and surface in no region is black. A crop looks like the mean of the labels that it covers;
texts look as those of `deploy/evaluation/simulated.py`, so that similarities are read as of its encoder `sim:0`.
"""

import hashlib
import json
import os

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.evaluation.oracles import NOISE
from prior_sg.deploy.evaluation.simulated import DIM, NUDGE_M, SimulatedEncoder, look_of
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.features import TextEmbeddings
from prior_sg.schemas.frames import Intrinsics

SPACE = "painted/labels"
LABELS = "CHAOS_LABELS"  # the environment variable that holds them, as JSON
VOID = "surface in no region"


def paint_of(label: str) -> int:
    """24 bits: red, green, blue."""
    return int.from_bytes(hashlib.blake2b(label.encode(), digest_size=3).digest()) | 1


def painted(depth_m: np.ndarray, camera: Intrinsics, world_from_camera: np.ndarray, truth: GroundTruth) -> bytes:
    """A PNG of what a depth image (h, w) shows: each pixel in the colour of the region that it lies in."""
    v, u = np.indices(depth_m.shape)
    rays = np.stack(((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones(u.shape)), axis=-1)
    points_m = (rays * depth_m[..., None]).reshape(-1, 3) @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    towards_m = world_from_camera[:3, 3] - points_m
    points_m += NUDGE_M * towards_m / np.maximum(np.linalg.norm(towards_m, axis=1, keepdims=True), 1e-6)
    regions = np.where(depth_m.reshape(-1) > 0, truth.region_of(points_m), -1)
    colours = np.zeros((len(regions), 3), np.uint8)
    for region in truth.regions:
        colours[regions == region.id] = list(paint_of(region.label).to_bytes(3))
    return cv2.imencode(".png", colours.reshape(*depth_m.shape, 3)[..., ::-1])[1].tobytes()


class Painted:
    """The encoder."""

    space, dim, side_px, batch_size = SPACE, DIM, 32, 8

    def __init__(self, labels: list[str]) -> None:
        self._paints = np.array([0, *map(paint_of, labels)])
        self._looks = np.array([look_of(VOID), *map(look_of, labels)])
        self._text = SimulatedEncoder("sim", 0.0)

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Unit vectors (crop, DIM)."""
        if not crops:
            return np.zeros((0, DIM), np.float32)
        shares = np.stack([self._shares(crop) for crop in crops])
        looks = shares @ self._looks
        return (looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), NOISE)).astype(np.float32)

    def _shares(self, crop: np.ndarray) -> np.ndarray:
        paints = crop.reshape(-1, 3).astype(np.int64) @ (1 << 16, 1 << 8, 1)
        return (paints[:, None] == self._paints).mean(axis=0)

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Descriptors of concepts."""
        return msgspec.structs.replace(self._text.text(concepts), space=SPACE)


def load(choice: str, options: object) -> Painted:
    """The encoder of this process's labels."""
    return Painted(json.loads(os.environ[LABELS]))


def space_of(choice: str) -> str:
    """The only one."""
    return SPACE


def check(choice: str) -> None:
    """Nothing is needed."""
