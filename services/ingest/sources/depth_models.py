"""Networks of the user's that see depth in pictures, as ONNX files.

A file with two inputs matches two rectified pictures, left and right, and gives the disparity of the left one in pixels
of its own size. Inputs are (1, 3 or 1, h, w) of 32 bit floats, red green blue from 0 to 255; h and w are the file's, or
where they are open the picture's, made larger to a multiple of 32. What a network wants beside this (means, other
scales) belongs into the file.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from prior_sg.services.ingest.core import stereo
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.sources.base import FrameError, SourceError
from prior_sg.services.runtime import extras

MULTIPLE_PX = 32
PICTURES = 2
AXES = 4


def matcher_of(options: ReadOptions) -> tuple[stereo.Matcher, str]:
    """What matches two pictures, and a phrase on it. Raises SourceError, and ExtraMissing without onnxruntime."""
    if not options.depth_model:
        return stereo.semi_global, "by OpenCV's semi-global matching"
    path = Path(options.depth_model)
    return Network(path), f"by {path.name}"


class Network:
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
        self.path, self._inputs = path, self._session.get_inputs()
        shapes = [list(one.shape) for one in self._inputs]
        if len(shapes) != PICTURES or any(len(shape) != AXES or shape[1] not in (1, 3) for shape in shapes):
            raise SourceError(
                f"{path} has the inputs {shapes}: a network that matches has two, each 1 x 3 x height x width"
            )

    def __call__(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Disparity (h, w), pixels of the left picture. Raises FrameError."""
        height, width = left.shape[:2]
        sizes = [self._size(one.shape, (height, width)) for one in self._inputs]
        fed = {
            one.name: _blob(picture, size, int(one.shape[1]))
            for one, picture, size in zip(self._inputs, (left, right), sizes, strict=True)
        }
        try:
            found = np.squeeze(np.asarray(self._session.run(None, fed)[-1], np.float32))
        except Exception as error:
            raise FrameError(f"{self.path.name} fails: {' '.join(str(error).split())[:150]}") from error
        if found.ndim != 2 or not found.size:
            raise FrameError(f"{self.path.name} gives an array of the shape {found.shape} instead of an image")
        return cv2.resize(found, (width, height), interpolation=cv2.INTER_NEAREST) * (width / found.shape[1])

    @staticmethod
    def _size(shape: list[Any], picture: tuple[int, int]) -> tuple[int, int]:
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
