"""OpenCV, loaded when the first of its members is asked for: with the first image, not at a service's start."""

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from prior_sg.services.errors import PriorSgError

if find_spec("cv2") is None:  # told at the start, not at the first image
    raise ModuleNotFoundError("No module named 'cv2'", name="cv2")


class OpenCvBroken(PriorSgError):
    """OpenCV is installed and cannot be loaded."""


def require() -> None:
    """Load it. Raises OpenCvBroken: whoever starts services says so before they have images to read."""
    _loaded()


def _loaded() -> ModuleType:
    try:
        return import_module("cv2")
    except ImportError as error:  # of a library of the system that it lacks, or of files that were damaged
        why = " ".join(str(error).split())[:200].rstrip(".")
        mend = "run `pip install --force-reinstall opencv-python-headless`"
        raise OpenCvBroken(f"OpenCV is installed and cannot be loaded ({why}): {mend}") from error


class _OpenCv:
    def __getattr__(self, name: str) -> Any:
        value = getattr(_loaded(), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import cv2
else:
    cv2 = _OpenCv()
