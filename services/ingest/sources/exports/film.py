"""Single pictures of a film."""

import weakref
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.sources.base import FrameError
from prior_sg.services.ingest.sources.tables import SourceError
from prior_sg.services.opencv import cv2

UNKNOWN = 1 << 62  # where a film is that could not be read: it is jumped in before the next picture
NEAR = 30  # pictures ahead that are passed over rather than jumped to


class Film:
    """A film that stays open; pictures in their order cost least."""

    def __init__(self, path: Path) -> None:
        """Raises SourceError."""
        self.path, self._next = path, 0
        self._open()
        self.size_px = (
            int(self._film.get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(self._film.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        if not self._film.isOpened() or not all(size > 0 for size in self.size_px):
            raise SourceError(f"{path} cannot be read as a film: OpenCV finds no pictures in it")

    def _open(self) -> None:
        self._film = cv2.VideoCapture(str(self.path))
        self._film.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # cameras are for pixels as they are stored
        self._close = weakref.finalize(self, self._film.release)

    def picture(self, number: int) -> np.ndarray:
        """Colour (h, w, 3) uint8, blue green red. Raises FrameError."""
        if not self._next <= number <= self._next + NEAR:
            self._film.set(cv2.CAP_PROP_POS_FRAMES, number)
            self._next = number
        while self._next < number and self._film.grab():
            self._next += 1
        held, picture = self._film.read() if self._next == number else (False, None)
        self._next = number + 1 if held else UNKNOWN
        if not held or picture is None:
            raise FrameError(f"{self.path.name} ends before picture {number}, or is damaged there")
        return picture
