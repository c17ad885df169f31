"""A canvas in metres: lines, discs and text, and the colours of pictures of a scene.

Everything is drawn at twice the size and scaled down, which smooths what OpenCV does not.
"""

import cv2
import numpy as np

from prior_sg.deploy.showing.colors import Color

WIDTH_PX, MARGIN_PX, LEGEND_PX, TITLE_PX, FOOT_PX = 1600, 44, 330, 96, 64
MAX_MAP_HEIGHT_PX, MIN_MAP_HEIGHT_PX = 1100, 420
SUPERSAMPLING = 2
INK, MUTED, WALL, FURNITURE = (31, 35, 40), (107, 114, 128), (75, 82, 92), (176, 182, 190)
FREE, EDGE, PATH = (241, 243, 245), (70, 76, 84), (20, 20, 24)


class View:
    """From drawing plane (metres) to picture (pixels of the supersampled canvas), and the drawing itself."""

    def __init__(self, low_m: np.ndarray, high_m: np.ndarray) -> None:
        extent_m = np.maximum(high_m - low_m, 1.0)
        room_px = WIDTH_PX - LEGEND_PX - 3 * MARGIN_PX
        self.px_per_m = SUPERSAMPLING * min(room_px / extent_m[0], MAX_MAP_HEIGHT_PX / extent_m[1])
        self.map_px = np.ceil(extent_m * self.px_per_m).astype(int)
        height = max(int(self.map_px[1]), SUPERSAMPLING * MIN_MAP_HEIGHT_PX)
        self.shape = (height + SUPERSAMPLING * (TITLE_PX + FOOT_PX + MARGIN_PX), SUPERSAMPLING * WIDTH_PX)
        space = np.array([SUPERSAMPLING * room_px, height]) - self.map_px
        self.corner_px = SUPERSAMPLING * np.array([MARGIN_PX, TITLE_PX + MARGIN_PX // 2]) + space // 2
        self.low_m, self.high_m = low_m, high_m
        self.canvas = np.full((*self.shape, 3), 255, np.uint8)

    def pixels(self, plane_m: np.ndarray) -> np.ndarray:
        """Sub-pixel positions (n, 2) of points (n, 2) of the drawing plane."""
        flipped = np.stack((plane_m[:, 0] - self.low_m[0], self.high_m[1] - plane_m[:, 1]), axis=1)
        return flipped * self.px_per_m + self.corner_px

    def holds(self, at_m: np.ndarray) -> bool:
        """Whether a point (2,) of the drawing plane is on the map."""
        return bool(((at_m >= self.low_m) & (at_m <= self.high_m)).all())

    def lines(self, paths_m: list[np.ndarray], color: Color, width: float, opacity: float = 1.0) -> None:
        """Antialiased polylines through points of the drawing plane; width in pixels of the result."""
        drawn = self.canvas.copy() if opacity < 1 else self.canvas
        paths = [np.round(self.pixels(path) * 16).astype(np.int32) for path in paths_m if len(path) > 1]
        cv2.polylines(drawn, paths, False, color, max(1, round(width * SUPERSAMPLING)), cv2.LINE_AA, 4)
        if opacity < 1:
            cv2.addWeighted(drawn, opacity, self.canvas, 1 - opacity, 0, self.canvas)

    def dot(self, at_px: np.ndarray, radius: float, color: Color, rim: Color | None = None) -> None:
        """Antialiased disc at a canvas position; radius in pixels of the result."""
        center = tuple(np.round(np.asarray(at_px) * 16).astype(int).tolist())
        if rim is not None:
            cv2.circle(self.canvas, center, round((radius + 1.5) * 16 * SUPERSAMPLING), rim, -1, cv2.LINE_AA, 4)
        cv2.circle(self.canvas, center, round(radius * 16 * SUPERSAMPLING), color, -1, cv2.LINE_AA, 4)

    def text(self, text: str, at_px: tuple[float, float], size: int, color: Color = INK, bold: bool = False) -> None:
        """Text whose baseline begins at a canvas position; size in pixels of the result."""
        _put_text(self.canvas, text, (round(at_px[0]), round(at_px[1])), size * SUPERSAMPLING, color=color, bold=bold)

    def finished(self) -> np.ndarray:
        """The picture at its final size."""
        return cv2.resize(self.canvas, None, fx=1 / SUPERSAMPLING, fy=1 / SUPERSAMPLING, interpolation=cv2.INTER_AREA)


if hasattr(cv2, "FontFace"):  # OpenCV 5 brings a real font
    _FACE = cv2.FontFace("sans")

    def _put_text(canvas: np.ndarray, text: str, at: tuple[int, int], size: int, *, color: Color, bold: bool) -> None:
        cv2.putText(canvas, text, at, color, _FACE, size, 600 if bold else 400)

    def text_width(text: str, size: int, bold: bool = False) -> int:
        """Of one line, in pixels of the canvas, as `size` is."""
        return cv2.getTextSize((0, 0), text, (0, 0), _FACE, size, 600 if bold else 400)[2]

else:
    _STROKES = cv2.FONT_HERSHEY_DUPLEX
    _STROKES_PX = 30.0  # height of its capitals with descenders at scale 1

    def _put_text(canvas: np.ndarray, text: str, at: tuple[int, int], size: int, *, color: Color, bold: bool) -> None:
        plain = text.replace("²", "2").replace("·", "-").replace("…", "..")
        cv2.putText(canvas, plain, at, _STROKES, size / _STROKES_PX, color, 3 if bold else 2, cv2.LINE_AA)

    def text_width(text: str, size: int, bold: bool = False) -> int:
        """Of one line, in pixels of the canvas, as `size` is."""
        return cv2.getTextSize(text, _STROKES, size / _STROKES_PX, 3 if bold else 2)[0][0]
