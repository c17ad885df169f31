"""Camera info messages of ROS as the cameras of a source (pure)."""

from typing import Any

import numpy as np

LENGTHS = (4, 5, 8)  # numbers of coefficients that a lens may have


def camera_fields(info: Any, rectified: bool) -> dict[str, Any]:
    """Size, focal lengths, centre, lens and coefficients of a CameraInfo of ROS 1 or 2, by our names.

    Of a rectified image the projection matrix counts and the lens is none. The region of interest and the binning of
    the sensor are applied. Raises ValueError with one sentence.
    """
    matrix = _matrix(info, "p", (3, 4)) if rectified else _matrix(info, "k", (3, 3))
    fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (fx > 0 and fy > 0):
        raise ValueError("it is not calibrated: its focal lengths are not positive")
    width, height = int(info.width), int(info.height)
    if info.roi.width and info.roi.height:
        width, height = int(info.roi.width), int(info.roi.height)
        cx, cy = cx - info.roi.x_offset, cy - info.roi.y_offset
    x, y = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    camera = {"width": width // x, "height": height // y, "fx": fx / x, "fy": fy / y}
    camera |= {"cx": (cx + 0.5) / x - 0.5, "cy": (cy + 0.5) / y - 0.5}
    coefficients = [] if rectified else _coefficients(info)
    return camera | ({"model": info.distortion_model, "distortion": coefficients} if coefficients else {})


def _matrix(info: Any, name: str, shape: tuple[int, int]) -> np.ndarray:
    """A matrix whose name is in capitals in ROS 1."""
    values = np.asarray(_field(info, name), np.float64)
    if values.size != shape[0] * shape[1] or not np.isfinite(values).all():
        raise ValueError(f"its matrix {name.upper()} is not {shape[0]} x {shape[1]} finite numbers")
    return values.reshape(shape)


def _coefficients(info: Any) -> list[float]:
    """Those up to the last that is not zero, in one of the known lengths; empty where all are zero."""
    values = np.asarray(_field(info, "d"), np.float64).tolist()
    last = max((i for i, value in enumerate(values) if value), default=-1)
    if last < 0:
        return []
    length = 4 if info.distortion_model == "equidistant" else next((n for n in LENGTHS if n > last), len(values))
    return (values + [0.0] * length)[: max(length, last + 1)]


def _field(info: Any, name: str) -> Any:
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
