"""2D places and true ground, seen from above: a picture with one panel for each floor."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

PX_PER_M = 32.0
LARGEST_PX = 1600  # a panel that would be wider or higher has smaller pixels to the metre
MARGIN_PX = 16
ABOVE_M = 0.3  # what lies less below a floor is of it already
LEGEND_PX = 26
FONT, LETTERS = cv2.FONT_HERSHEY_SIMPLEX, 0.4

# Blue, green, red.
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
UNSEEN, MISSED, RIGHT, WRONG, OUTLINE = (225, 225, 225), (60, 170, 255), (110, 190, 90), (60, 60, 220), (90, 90, 90)
LEGEND = (
    ("true ground, not seen", UNSEEN),
    ("seen, no place", MISSED),
    ("place on true ground", RIGHT),
    ("place elsewhere", WRONG),
)


class Seen(NamedTuple):
    """What is drawn; all points (n, 3) in the world, metres."""

    truth_m: np.ndarray  # ground there is
    seen_m: np.ndarray  # ... and was seen
    tops_m: Sequence[np.ndarray]  # of each place, the ground it stands on
    true: Sequence[np.ndarray]  # of each of those points, whether it is true ground


def drawn(seen: Seen, floors_m: np.ndarray, cell_m: float, voxel_m: float) -> np.ndarray:
    """The picture (h, w, 3), blue, green, red; true ground comes in cells of `cell_m`, places in voxels."""
    everything = np.concatenate((seen.truth_m, *seen.tops_m))
    low_m, high_m = everything[:, :2].min(axis=0), everything[:, :2].max(axis=0)
    scale = min(PX_PER_M, LARGEST_PX / float((high_m - low_m).max() + 1e-6))
    size = np.ceil((high_m - low_m) * scale).astype(int) + 2 * MARGIN_PX
    levels = np.unique(np.round(floors_m, 2))
    panels = []
    for number in range(len(levels)):
        panel = np.full((int(size[1]), int(size[0]), 3), 255, np.uint8)
        for points_m, side_m, color in ((seen.truth_m, cell_m, UNSEEN), (seen.seen_m, cell_m, MISSED)):
            _squares(panel, _pixels(_of_level(points_m, levels, number), low_m, scale), side_m * scale, color)
        for top_m, true in zip(seen.tops_m, seen.true, strict=True):
            here = _levels_of(top_m, levels) == number
            for side, color in ((true, RIGHT), (~true, WRONG)):
                _squares(panel, _pixels(top_m[here & side], low_m, scale), voxel_m * scale, color)
            if here.any():
                hull = cv2.convexHull(_pixels(top_m[here], low_m, scale).astype(np.int32))
                cv2.polylines(panel, [hull], isClosed=True, color=OUTLINE, lineType=cv2.LINE_AA)
        panels.append(cv2.flip(panel, 0))
    picture, legend = np.concatenate(panels, axis=1), _legend()
    width = max(picture.shape[1], legend.shape[1])
    return np.concatenate([_padded(part, width) for part in (legend, picture)])


def _levels_of(points_m: np.ndarray, levels_m: np.ndarray) -> np.ndarray:
    """The floor that each point is on, or goes up from."""
    return np.clip(np.searchsorted(levels_m, points_m[:, 2] + ABOVE_M, side="right") - 1, 0, None)


def _of_level(points_m: np.ndarray, levels_m: np.ndarray, number: int) -> np.ndarray:
    return points_m[_levels_of(points_m, levels_m) == number]


def _pixels(points_m: np.ndarray, low_m: np.ndarray, scale: float) -> np.ndarray:
    return (points_m[:, :2] - low_m) * scale + MARGIN_PX


def _squares(panel: np.ndarray, pixels: np.ndarray, side_px: float, color: tuple[int, int, int]) -> None:
    """Fill a square around each of the pixels (n, 2)."""
    reach = max(1, round(side_px / 2))
    x, y = np.rint(pixels).astype(int).T
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            panel[np.clip(y + dy, 0, panel.shape[0] - 1), np.clip(x + dx, 0, panel.shape[1] - 1)] = color


def _padded(picture: np.ndarray, width_px: int) -> np.ndarray:
    return cv2.copyMakeBorder(picture, 0, 0, 0, width_px - picture.shape[1], cv2.BORDER_CONSTANT, value=WHITE)


def _legend() -> np.ndarray:
    """A line that says what the colours are."""
    widths = [30 + cv2.getTextSize(text, FONT, LETTERS, 1)[0][0] for text, _ in LEGEND]
    strip = np.full((LEGEND_PX, MARGIN_PX + sum(widths), 3), WHITE, np.uint8)
    x = MARGIN_PX
    for (text, color), width in zip(LEGEND, widths, strict=True):
        cv2.rectangle(strip, (x, 7), (x + 12, 19), color, -1)
        cv2.putText(strip, text, (x + 17, 17), FONT, LETTERS, BLACK, 1, cv2.LINE_AA)
        x += width
    return strip
