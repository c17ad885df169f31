"""What recordings of telephones with a lidar have in common: fine pictures, coarse depth, and how sure it is."""

from collections.abc import Callable

import numpy as np

from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.pixels import encoded, stored
from prior_sg.services.ingest.sources.base import FrameError, Images
from prior_sg.services.opencv import cv2

UP = (0.0, 1.0, 0.0)  # of ARKit's world
FINER = 3  # pixels of a picture for one of depth, along each side: encoders see little in 256 x 192 pixels
UNSURE = 0  # ARKit's confidence: 0 low, 1 medium, 2 high
NOTE = f"depth is enlarged {FINER} times, for the pictures' sake; what has low confidence is left out"


def images(picture: np.ndarray, depth_m: np.ndarray, confidence: np.ndarray | None) -> Images:
    """A frame of a picture (h, w, 3), depth (a, b), metres, and where there is one its confidence (a, b).

    Raises FrameError.
    """
    if confidence is not None:
        if confidence.shape != depth_m.shape:
            raise FrameError(f"its confidence has the shape {confidence.shape}, its depth {depth_m.shape}")
        depth_m = np.where(confidence > UNSURE, depth_m, 0.0)
    finer_m = np.repeat(np.repeat(depth_m, FINER, axis=0), FINER, axis=1)
    size = (finer_m.shape[1], finer_m.shape[0])
    return Images(encoded(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), ".jpg"), finer_m)


def pixels(read: Callable[[], bytes], what: str) -> np.ndarray:
    """Numbers (a, b) of an image file. Raises FrameError."""
    try:
        image = stored(read())
    except ImageError as error:
        raise FrameError(f"its {what} is damaged: {error}") from error
    if image.ndim != 2:
        raise FrameError(f"its {what} has {image.shape[2]} channels instead of one")
    return image
