"""Convolutions in 8-bit integers, for processors that multiply those faster than floating-point numbers.

Weights are rounded per channel, activations per tensor. The ranges of activations are found on made-up pictures that
share the statistics of natural ones, dead leaves (Lee, Mumford & Huang, 2001; Baradad et al., 2021): no picture has to
be at hand, and everybody's network is the same. Where rounding hurts most, at the first convolutions, and where it
gains nothing, numbers stay as they are.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.feature_pyramid.encoders.base import package
from prior_sg.services.opencv import cv2

PICTURES = 32  # that ranges are found on
LEAVES = 400  # of a picture
LARGEST_LEAF = 1.0  # radius, of the picture's side
SMALLEST_LEAF = 0.05
KEPT_CONVOLUTIONS = 6  # the first ones, with two thirds of the error; all others have a tenth of the rest at most
FLAGS = {"avx512_vnni", "avx_vnni"}  # of such processors; those of ARM have not been measured
PROCESSOR_FILE = Path("/proc/cpuinfo")


def multiplies_bytes() -> bool:
    """Whether this processor has instructions for products of 8-bit numbers; elsewhere sums of them could overflow."""
    try:
        told = PROCESSOR_FILE.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return not FLAGS.isdisjoint(told.split())


def dead_leaves(rng: np.random.Generator, side_px: int) -> np.ndarray:
    """RGB picture (side, side, 3) uint8 of discs and rectangles that hide each other; P(radius) falls with its cube."""
    picture = np.zeros((side_px, side_px, 3), np.uint8)
    tone = rng.uniform(0, 255, 3)
    for _ in range(LEAVES):
        radius_px = side_px * min(SMALLEST_LEAF * (1 - rng.uniform()) ** -0.5, LARGEST_LEAF)
        middle_px = tuple(rng.uniform(0, side_px, 2).tolist())
        colour = np.clip(0.3 * tone + 0.7 * rng.uniform(0, 255) * rng.uniform(0.6, 1.2, 3), 0, 255).tolist()
        if rng.uniform() < 0.5:
            cv2.circle(picture, tuple(map(int, middle_px)), int(radius_px), colour, cv2.FILLED, cv2.LINE_AA)
        else:
            sides_px = (2 * radius_px, 2 * radius_px * rng.uniform(0.2, 1))
            corners_px = cv2.boxPoints((middle_px, sides_px, rng.uniform(0, 180))).astype(np.int32)
            cv2.fillPoly(picture, [corners_px], colour, cv2.LINE_AA)
    return picture


def quantise(network: Path, path: Path, side_px: int) -> None:
    """Write the ONNX file `network`, whose one input is RGB pixels (crop, side, side, 3), with rounded convolutions."""
    library, quantization = package("onnx"), package("onnxruntime.quantization", "onnxruntime")
    shape_inference = package("onnxruntime.quantization.shape_inference", "onnxruntime")
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        prepared = Path(folder) / "prepared.onnx"
        shape_inference.quant_pre_process(str(network), str(prepared), skip_symbolic_shape=True)
        nodes = library.load(str(prepared)).graph.node
        convolutions = [node.name for node in nodes if node.op_type == "Conv"]
        quantization.quantize_static(
            str(prepared),
            str(path),
            _Pictures(side_px),
            quant_format=quantization.QuantFormat.QDQ,
            per_channel=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
            calibrate_method=quantization.CalibrationMethod.MinMax,
            nodes_to_quantize=[
                node.name
                for node in nodes
                if node.op_type in ("Add", "Clip", "Conv") and node.name not in convolutions[:KEPT_CONVOLUTIONS]
            ],
        )


class _Pictures:
    """What the library reads ranges from."""

    def __init__(self, side_px: int) -> None:
        rng = np.random.default_rng(0)
        self._left: Iterator[np.ndarray] = (dead_leaves(rng, side_px) for _ in range(PICTURES))

    def get_next(self) -> dict[str, Any] | None:
        """The next input of the network; None at the end."""
        picture = next(self._left, None)
        return None if picture is None else {"pixels": picture[None]}
