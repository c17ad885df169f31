"""Networks of the user's that see depth in pictures, as ONNX files.

A file with two inputs matches two rectified pictures, left and right, and gives the disparity of the left one in pixels
of its own size. A file with one input gives, for each pixel of one picture, inverse depth up to a scale and a shift, or
depth up to a scale: its metadata (`depth_output`: inverse or metric) or --depth-output says which, else inverse. Inputs
are (1, 3 or 1, h, w) of 32 bit floats, red green blue from 0 to 255; h and w are the file's, or where they are open the
picture's, made larger to a multiple of 32. What a network wants beside this (means, other scales) belongs into the
file.
"""

from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.ingest.core import stereo
from prior_sg.services.ingest.core.mono.scale import INVERSE, KINDS
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.sources.base import FrameError, SourceError
from prior_sg.services.opencv import cv2
from prior_sg.services.runtime import extras

MULTIPLE_PX = 32
PAIR, SINGLE = 2, 1
AXES = 4
OUTPUT = "depth_output"  # a file's metadata: what it gives


def matcher_of(options: ReadOptions) -> tuple[stereo.Matcher, str]:
    """What matches two pictures, and a phrase on it. Raises SourceError, and ExtraMissing without onnxruntime."""
    if not options.depth_model:
        return stereo.semi_global, "by OpenCV's semi-global matching"
    path = Path(options.depth_model)
    return Network(path), f"by {path.name}"


def sees_one(options: ReadOptions) -> bool:
    """Whether the file that is told takes one picture. Raises SourceError, and ExtraMissing without onnxruntime."""
    return bool(options.depth_model) and len(Loaded(Path(options.depth_model)).inputs) == SINGLE


class Loaded:
    """A loaded file."""

    def __init__(self, path: Path) -> None:
        """Raises SourceError, and ExtraMissing without onnxruntime."""
        extras.require("encode", f"{path}, a network,")
        import onnxruntime

        try:
            self._session: Any = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own errors have no common parent
            said = " ".join(str(error).split())[:150]
            raise SourceError(f"{path} cannot be loaded as a network: {said}") from error
        self.path, self.inputs = path, self._session.get_inputs()

    def check(self, pictures: int, what: str) -> None:
        """Raise SourceError unless the file takes so many pictures."""
        shapes = [list(one.shape) for one in self.inputs]
        if len(shapes) != pictures or any(len(shape) != AXES or shape[1] not in (1, 3) for shape in shapes):
            count = {SINGLE: "one", PAIR: "two, each"}[pictures]
            raise SourceError(f"{self.path} has the inputs {shapes}: {what} has {count} 1 x 3 x height x width")

    def told(self, key: str) -> str:
        """A word of the file's metadata; empty where it has none."""
        return str(self._session.get_modelmeta().custom_metadata_map.get(key, ""))

    def run(self, *pictures: np.ndarray) -> np.ndarray:
        """What the network gives of pictures (h, w) or (h, w, 3), blue green red: (h', w'). Raises FrameError."""
        fed = {
            one.name: _blob(picture, _size(one.shape, picture.shape[:2]), int(one.shape[1]))
            for one, picture in zip(self.inputs, pictures, strict=True)
        }
        try:
            found = np.squeeze(np.asarray(self._session.run(None, fed)[-1], np.float32))
        except Exception as error:
            raise FrameError(f"{self.path.name} fails: {' '.join(str(error).split())[:150]}") from error
        if found.ndim != 2 or not found.size:
            raise FrameError(f"{self.path.name} gives an array of the shape {found.shape} instead of an image")
        return found


class Network(Loaded):
    """A file that matches two pictures."""

    def __init__(self, path: Path) -> None:
        """Raises SourceError, and ExtraMissing without onnxruntime."""
        super().__init__(path)
        self.check(PAIR, "a network that matches")

    def __call__(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Disparity (h, w), pixels of the left picture. Raises FrameError."""
        height, width = left.shape[:2]
        found = self.run(left, right)
        return cv2.resize(found, (width, height), interpolation=cv2.INTER_NEAREST) * (width / found.shape[1])


class Seer(Loaded):
    """A file that sees depth in one picture."""

    def __init__(self, options: ReadOptions) -> None:
        """Raises SourceError, and ExtraMissing without onnxruntime."""
        super().__init__(Path(options.depth_model))
        self.check(SINGLE, "a network that sees depth in one picture")
        self.kind = options.depth_output or self.told(OUTPUT) or INVERSE
        if self.kind not in KINDS:
            raise SourceError(f"{self.path} says that it gives {self.kind[:40]!r}: --depth-output inverse or metric")

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """The network's output (h, w) for a picture (h, w) or (h, w, 3), without unit. Raises FrameError."""
        height, width = picture.shape[:2]
        return cv2.resize(self.run(picture), (width, height), interpolation=cv2.INTER_NEAREST)


def _size(shape: list[Any], picture: tuple[int, ...]) -> tuple[int, int]:
    """Height and width that an input takes."""
    height, width = (
        int(axis) if isinstance(axis, int) and axis > 0 else -(-side // MULTIPLE_PX) * MULTIPLE_PX
        for axis, side in zip(shape[2:], picture, strict=True)
    )
    return height, width


def _blob(picture: np.ndarray, size: tuple[int, int], channels: int) -> np.ndarray:
    """A picture (h, w) or (h, w, 3), blue green red, as an input (1, channels, *size)."""
    color = picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    fitting = cv2.resize(color, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    rows = cv2.cvtColor(fitting, cv2.COLOR_BGR2RGB if channels == 3 else cv2.COLOR_BGR2GRAY).astype(np.float32)
    return np.ascontiguousarray(rows.reshape(*size, channels).transpose(2, 0, 1)[None])
