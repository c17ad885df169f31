"""What stands around the map: title, regions in figures, the meaning of each mark, scale and axes."""

import cv2
import numpy as np

from prior_sg.deploy.showing.canvas import (
    EDGE,
    FREE,
    FURNITURE,
    INK,
    LEGEND_PX,
    MARGIN_PX,
    MUTED,
    PATH,
    SUPERSAMPLING,
    TITLE_PX,
    WALL,
    WIDTH_PX,
    View,
    text_width,
)
from prior_sg.deploy.showing.colors import UNLABELLED, Color
from prior_sg.deploy.showing.top_view import plane
from prior_sg.schemas.members import headline
from prior_sg.schemas.names import shown
from prior_sg.schemas.scene import Scene

LONGEST_LINE = 300  # characters of a text that are looked at


def draw_title(view: View, scene: Scene) -> None:
    """The task, and below it what the map is of."""
    left = SUPERSAMPLING * MARGIN_PX
    room_px = WIDTH_PX - 2 * MARGIN_PX
    title = headline(scene.task, scene.merged_of, scene.plain)
    size = next((size for size in range(34, 22, -2) if _fitted(title, size, room_px, True) == title), 24)
    view.text(_fitted(title, size, room_px, True), (left, SUPERSAMPLING * 62), size, INK, True)
    counts = f"{len(scene.regions)} regions, {len(scene.place_ids)} places, {len(scene.edges)} edges"
    under = "   ·   ".join(part for part in (scene.environment, f"robot {scene.robot}", counts) if part)
    view.text(_fitted(under, 19, room_px), (left, SUPERSAMPLING * 94), 19, MUTED)


def draw_legend(
    view: View, scene: Scene, colors: dict[str, Color], nameless: int, *, with_truth: bool, with_walls: bool
) -> None:
    """The regions, the largest first, with probability and area; below them what the other marks mean. So many objects
    are `nameless` for want of room.
    """
    left = view.shape[1] - SUPERSAMPLING * (LEGEND_PX + MARGIN_PX)
    top = SUPERSAMPLING * (TITLE_PX + MARGIN_PX)
    symbols = 4 + with_truth + 2 * with_walls + bool(scene.objects)
    room = int((view.shape[0] / SUPERSAMPLING - TITLE_PX - 2 * MARGIN_PX) / 36) - symbols - 3
    regions = sorted(scene.regions, key=lambda region: (-region.area_m2, region.id))
    view.text("region", (left, top), 16, MUTED)
    _text_right(view, "probability", (left + SUPERSAMPLING * 250, top), 16, MUTED)
    _text_right(view, "m²", (left + SUPERSAMPLING * LEGEND_PX, top), 16, MUTED)
    shown = regions if len(regions) <= room else regions[: max(1, room - 1)]
    for region in shown:
        top += SUPERSAMPLING * 36
        _swatch(view, left, top, colors[region.label])
        view.text(_fitted(region.label, 20, 140), (left + SUPERSAMPLING * 34, top), 20)
        _text_right(view, f"{region.probability:.2f}", (left + SUPERSAMPLING * 250, top), 20)
        _text_right(view, f"{region.area_m2:.1f}", (left + SUPERSAMPLING * LEGEND_PX, top), 20, MUTED)
    if len(shown) < len(regions):
        top += SUPERSAMPLING * 36
        view.text(f"and {len(regions) - len(shown)} smaller ones", (left, top), 20, MUTED)
    top += SUPERSAMPLING * 30
    _draw_symbols(view, scene, (left, top), nameless, with_truth=with_truth, with_walls=with_walls)


def object_row(nameless: int) -> str:
    """What stands beside the mark of objects."""
    return f"object ({nameless} names left out)" if nameless else "object"


def _draw_symbols(
    view: View, scene: Scene, corner: tuple[int, int], nameless: int, *, with_truth: bool, with_walls: bool
) -> None:
    """What the other marks mean."""
    left, top = corner
    step, middle = SUPERSAMPLING * 32, SUPERSAMPLING * 11
    x = np.array([left, left + SUPERSAMPLING * 22])

    def row(name: str) -> np.ndarray:
        nonlocal top
        top += step
        view.text(name, (left + SUPERSAMPLING * 34, top), 18, MUTED)
        return np.stack((x, [top - middle * 0.55] * 2), axis=1)

    def stroke(ends: np.ndarray, color: Color, width: int) -> None:
        start, end = np.round(ends).astype(int).tolist()
        cv2.line(view.canvas, start, end, color, width, cv2.LINE_AA)

    if with_walls:
        for name, color in (("wall", WALL), ("furniture", FURNITURE)):
            row(name)
            _swatch(view, left, top, color)
    row("free, in no place" if not (scene.place_regions < 0).any() else "free, not labelled")
    _swatch(view, left, top, UNLABELLED if (scene.place_regions < 0).any() else FREE)
    if scene.objects:
        start, end = row(object_row(nameless))
        half = np.array((0, middle / 2))
        low, high = np.round((start - half, end + half)).astype(int).tolist()
        cv2.rectangle(view.canvas, low, high, MUTED, SUPERSAMPLING // 2, cv2.LINE_AA)
    ends = row("place graph")
    stroke(ends, (150, 155, 162), 2)
    for end in ends:
        view.dot(end, 2.6, EDGE, (255, 255, 255))
    ends = row("trajectory (from circle to dot)")
    stroke(ends, PATH, 2 * SUPERSAMPLING)
    view.dot(ends[0], 4.5, (255, 255, 255), PATH)
    view.dot(ends[1], 4.5, PATH, (255, 255, 255))
    if with_truth:
        ends = row("ground truth")
        for share in (0.0, 0.4, 0.8):
            start = ends[0] + share * (ends[1] - ends[0])
            stroke(np.array([start, start + 0.2 * (ends[1] - ends[0])]), INK, 2 * SUPERSAMPLING)


def draw_scale(view: View, turned: bool) -> None:
    """A bar of one metre (ten on large maps) and the directions of the world's axes."""
    length_m = 1 if view.px_per_m * 1 > 30 * SUPERSAMPLING else 10
    left, bottom = SUPERSAMPLING * MARGIN_PX, view.shape[0] - SUPERSAMPLING * 46
    right = left + round(length_m * view.px_per_m)
    thick = 2 * SUPERSAMPLING
    cv2.line(view.canvas, (left, bottom), (right, bottom), INK, thick, cv2.LINE_AA)
    for x in (left, right):
        cv2.line(view.canvas, (x, bottom - 6 * SUPERSAMPLING), (x, bottom + 6 * SUPERSAMPLING), INK, thick, cv2.LINE_AA)
    view.text(f"{length_m} m", (right + SUPERSAMPLING * 14, bottom + SUPERSAMPLING * 7), 20)
    origin = np.array(
        [right + SUPERSAMPLING * 120, bottom + (SUPERSAMPLING * 12 if not turned else -SUPERSAMPLING * 18)]
    )
    for name, axis in (("x", (1.0, 0.0)), ("y", (0.0, 1.0))):
        along = plane(np.array([axis]), turned)[0] * (1, -1)
        tip = origin + along * SUPERSAMPLING * 30
        start, end = np.round((origin, tip)).astype(int).tolist()
        cv2.arrowedLine(view.canvas, start, end, MUTED, SUPERSAMPLING, cv2.LINE_AA, tipLength=0.3)
        view.text(name, tuple(tip + along * SUPERSAMPLING * 12 + np.array([-5, 6]) * SUPERSAMPLING), 18, MUTED)


def _swatch(view: View, left: int, baseline: int, color: Color) -> None:
    size = SUPERSAMPLING * 20
    top = baseline - SUPERSAMPLING * 17
    cv2.rectangle(view.canvas, (left, top), (left + size, top + size), color, -1)


def _fitted(text: str, size: int, width_px: int, bold: bool = False) -> str:
    """The text, shortened to a width in pixels of the result."""
    text = shown(text)[:LONGEST_LINE].replace("\n", " ")
    while len(text) > 1 and text_width(text, size * SUPERSAMPLING, bold) > width_px * SUPERSAMPLING:
        text = text.rstrip("…")[:-1] + "…"
    return text


def _text_right(view: View, text: str, at_px: tuple[float, float], size: int, color: Color = INK) -> None:
    view.text(text, (at_px[0] - text_width(text, size * SUPERSAMPLING), at_px[1]), size, color)
