"""Draws a prior: its graph, and its matrices with their numbers; as SVG, or as PNG through the same strokes."""

import html
import math
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from prior_sg.schemas.names import shown
from prior_sg.schemas.priors import Prior

Color = tuple[int, int, int]  # red, green, blue
Point = tuple[float, float]
INK: Color = (38, 42, 48)
FAINT: Color = (120, 126, 134)
ZONES: tuple[Color, ...] = (
    (86, 143, 201),
    (232, 147, 70),
    (107, 175, 110),
    (201, 104, 118),
    (148, 125, 190),
    (120, 170, 175),
    (190, 160, 90),
)
GRAPH_PX, CELL_PX, MARGIN_PX, TITLE_PX = 760, 26, 24, 64
SMALL_GRAPH_PX = 440  # beside other things on a page
LABEL_PX, HEAD_PX = 150, 130  # room for the names of rows and, slanted, of columns
SHOWN_EDGE = 0.25  # P(ri <-> rj) below which no line is drawn
MOST_OBJECTS = 36  # columns of the containment matrix
CHARACTER = 0.56  # width of a character over the height of its font


class Canvas(Protocol):
    """What a picture is drawn on; coordinates in pixels, y down."""

    def line(self, a: Point, b: Point, color: Color, width: float) -> None:
        """A line."""

    def disc(self, center: Point, radius: float, color: Color) -> None:
        """A filled circle."""

    def box(self, corner: Point, size: Point, color: Color) -> None:
        """A filled rectangle."""

    def text(
        self, at: Point, text: str, size: float, color: Color, *, anchor: str = "start", halo: bool = False
    ) -> None:
        """Text whose baseline starts, ends or has its middle at a point; anchor `slant` climbs from it. A halo keeps it
        readable on lines."""

    def save(self, path: Path) -> None:
        """Write the file."""


class Svg:
    """Strokes as SVG elements."""

    def __init__(self, width: float, height: float) -> None:
        self._head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
            f'height="{height:.0f}" font-family="Helvetica, Arial, sans-serif">'
            '<rect width="100%" height="100%" fill="#fff"/>'
        )
        self._parts: list[str] = []

    def line(self, a: Point, b: Point, color: Color, width: float) -> None:
        self._parts.append(
            f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" stroke="rgb{color}" '
            f'stroke-width="{width:.1f}"/>'
        )

    def disc(self, center: Point, radius: float, color: Color) -> None:
        self._parts.append(f'<circle cx="{center[0]:.1f}" cy="{center[1]:.1f}" r="{radius:.1f}" fill="rgb{color}"/>')

    def box(self, corner: Point, size: Point, color: Color) -> None:
        self._parts.append(
            f'<rect x="{corner[0]:.1f}" y="{corner[1]:.1f}" width="{size[0]:.1f}" height="{size[1]:.1f}" '
            f'fill="rgb{color}"/>'
        )

    def text(
        self, at: Point, text: str, size: float, color: Color, *, anchor: str = "start", halo: bool = False
    ) -> None:
        turn = f' transform="rotate(-60 {at[0]:.1f} {at[1]:.1f})"' if anchor == "slant" else ""
        around = ' paint-order="stroke" stroke="#fff" stroke-width="3"' if halo else ""
        placed = {"middle": "middle", "end": "end"}.get(anchor, "start")
        self._parts.append(
            f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" font-size="{size:.0f}" fill="rgb{color}" '
            f'text-anchor="{placed}"{turn}{around}>'
            f"{html.escape(shown(text))}</text>"
        )

    def document(self) -> str:
        """The whole picture."""
        return self._head + "".join(self._parts) + "</svg>\n"

    def save(self, path: Path) -> None:
        path.write_text(self.document(), encoding="utf-8")


class Png:
    """The same strokes as pixels, twice as fine as the coordinates."""

    def __init__(self, width: float, height: float) -> None:
        self._image = np.full((math.ceil(height) * 2, math.ceil(width) * 2, 3), 255, np.uint8)

    def line(self, a: Point, b: Point, color: Color, width: float) -> None:
        cv2.line(self._image, _twice(a), _twice(b), color[::-1], max(1, round(2 * width)), cv2.LINE_AA)

    def disc(self, center: Point, radius: float, color: Color) -> None:
        cv2.circle(self._image, _twice(center), round(2 * radius), color[::-1], -1, cv2.LINE_AA)

    def box(self, corner: Point, size: Point, color: Color) -> None:
        last = (corner[0] + size[0], corner[1] + size[1])
        cv2.rectangle(self._image, _twice(corner), _twice(last), color[::-1], -1)

    def text(
        self, at: Point, text: str, size: float, color: Color, *, anchor: str = "start", halo: bool = False
    ) -> None:
        scale, plain = 2 * size / 30, shown(text).encode("ascii", "replace").decode()
        (width, height), below = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, scale, 2)
        if anchor == "slant":
            self._slanted(_twice(at), plain, scale, (width, height + below), color)
            return
        x, y = _twice(at)
        left = x - (width // 2 if anchor == "middle" else width if anchor == "end" else 0)
        if halo:
            corners = (left - 3, y - height - 3), (left + width + 3, y + below)
            cv2.rectangle(self._image, *corners, (255, 255, 255), -1)
        cv2.putText(self._image, plain, (left, y), cv2.FONT_HERSHEY_SIMPLEX, scale, color[::-1], 2, cv2.LINE_AA)

    def _slanted(self, at: tuple[int, int], text: str, scale: float, size: tuple[int, int], color: Color) -> None:
        side = size[0] + size[1] + 8
        upright = np.full((2 * side, 2 * side, 3), 255, np.uint8)
        cv2.putText(upright, text, (side, side), cv2.FONT_HERSHEY_SIMPLEX, scale, color[::-1], 2, cv2.LINE_AA)
        patch = cv2.warpAffine(
            upright, cv2.getRotationMatrix2D((side, side), 60, 1), upright.shape[1::-1], borderValue=(255, 255, 255)
        )
        top, left = max(at[1] - side, 0), max(at[0] - side, 0)
        part = self._image[top : at[1] + side, left : at[0] + side]
        cut = patch[top - at[1] + side :, left - at[0] + side :][: part.shape[0], : part.shape[1]]
        np.minimum(part, cut, out=part)

    def save(self, path: Path) -> None:
        path.write_bytes(cv2.imencode(".png", self._image)[1].tobytes())


def _twice(point: Point) -> tuple[int, int]:
    return round(2 * point[0]), round(2 * point[1])


def draw(prior: Prior, path: Path) -> None:
    """Write the picture; the suffix says which kind. Raises ValueError for another than .svg and .png."""
    kinds: dict[str, type[Svg] | type[Png]] = {".svg": Svg, ".png": Png}
    if path.suffix not in kinds:
        raise ValueError(f"a picture is a .svg or a .png, not {path.suffix or 'a file without suffix'}")
    columns = discriminative(prior, MOST_OBJECTS)
    rows = len(prior.regions)
    wide = LABEL_PX + CELL_PX * max(rows, len(columns)) + HEAD_PX // 2
    width = max(GRAPH_PX, wide) + 2 * MARGIN_PX
    matrix_px = HEAD_PX + CELL_PX * rows + 50
    height = TITLE_PX + GRAPH_PX + 2 * matrix_px + MARGIN_PX
    canvas: Canvas = kinds[path.suffix](width, height)
    made = prior.provenance
    canvas.text((MARGIN_PX, 28), f"{prior.environment}: {prior.task or 'no task'}", 18, INK)
    canvas.text((MARGIN_PX, 50), f"{made.source}, {prior.digest()[:12]}", 12, FAINT)
    _graph(canvas, prior, ((width - GRAPH_PX) / 2, TITLE_PX), GRAPH_PX)
    names = [region.name for region in prior.regions]
    top = TITLE_PX + GRAPH_PX
    _matrix(canvas, (MARGIN_PX, top), "P(ri - rj): regions that touch", (names, names), prior.adjacency)
    more = len(prior.objects) - len(columns)
    title = "P(o | r): objects in regions" + (f", the {len(columns)} most telling; {more} more" if more else "")
    things = [prior.objects[column].name for column in columns]
    _matrix(canvas, (MARGIN_PX, top + matrix_px), title, (names, things), prior.containment[:, columns])
    canvas.save(path)


def graph_svg(prior: Prior) -> str:
    """The graph alone, for a page."""
    canvas = Svg(SMALL_GRAPH_PX, SMALL_GRAPH_PX)
    _graph(canvas, prior, (0.0, 0.0), SMALL_GRAPH_PX)
    return canvas.document()


def merits(prior: Prior) -> np.ndarray:
    """How much an object speaks for a region, (region, object): P(o | r) log(P(o | r) / mean over regions)."""
    held = np.maximum(prior.containment.astype(float), 1e-9)
    return held * np.log(held / held.mean(axis=0))


def discriminative(prior: Prior, most: int) -> list[int]:
    """The most telling objects, grouped by the region they tell."""
    if not prior.objects:
        return []
    merit = merits(prior)
    best = np.argsort(-merit.max(axis=0), kind="stable")[:most]
    return sorted(best.tolist(), key=lambda column: (int(merit[:, column].argmax()), -merit[:, column].max()))


def layout(adjacency: np.ndarray) -> np.ndarray:
    """Positions (region, 2) in the unit square: likely neighbours near each other (stress majorisation of distances
    1 - log P over shortest paths, from a circle; deterministic)."""
    count = len(adjacency)
    wanted = 1.0 - np.log(np.maximum(adjacency.astype(float), 1e-3))
    np.fill_diagonal(wanted, 0)
    for middle in range(count):
        wanted = np.minimum(wanted, wanted[:, middle, None] + wanted[None, middle])
    turn = 2 * np.pi * np.arange(count) / count
    at = np.column_stack((np.cos(turn), np.sin(turn)))
    weight = 1 / np.maximum(wanted, 1e-9) ** 2
    np.fill_diagonal(weight, 0)
    for _ in range(300 if count > 1 else 0):
        apart = at[:, None] - at[None]
        length = np.maximum(np.linalg.norm(apart, axis=2), 1e-6)
        pull = at[None] + apart * (wanted / length)[:, :, None]
        at = (weight[:, :, None] * pull).sum(axis=1) / weight.sum(axis=1, keepdims=True)
    at -= at.min(axis=0)
    return at / np.maximum(at.max(axis=0), 1e-9)


def _graph(canvas: Canvas, prior: Prior, corner: Point, side_px: float) -> None:
    """Discs as large as P(r | E0), coloured by zone; lines as dark as P(ri <-> rj); each region's telling objects."""
    space = side_px - 190
    at = layout(prior.adjacency) * space + np.array(corner) + (95, 70)
    zones = list(dict.fromkeys(filter(None, prior.zones)))
    for i in range(len(prior.regions)):
        for j in range(i):
            if (touch := float(prior.adjacency[i, j])) >= SHOWN_EDGE:
                shade = round(225 - 150 * touch)
                canvas.line(tuple(at[i]), tuple(at[j]), (shade, shade, shade), 0.6 + 4 * touch)
    for (x, y), region, zone, merit in zip(at.tolist(), prior.regions, prior.zones, merits(prior), strict=True):
        radius = 8 + 60 * math.sqrt(region.existence / math.pi)
        canvas.disc((x, y), radius, _zone_color(zones, zone))
        best = [prior.objects[j].name for j in np.argsort(-merit, kind="stable")[:3]]
        canvas.text(
            (x, y + radius + 15), f"{region.name} {100 * region.existence:.0f} %", 14, INK, anchor="middle", halo=True
        )
        for line, name in enumerate(best):
            canvas.text((x, y + radius + 29 + 12 * line), name, 11, FAINT, anchor="middle", halo=True)
    for row, zone in enumerate(zones):
        y = corner[1] + 14 + 18 * row
        canvas.disc((corner[0] + 8, y - 4), 6, _zone_color(zones, zone))
        canvas.text((corner[0] + 20, y), zone, 12, INK)


def _zone_color(zones: list[str], zone: str) -> Color:
    return ZONES[zones.index(zone) % len(ZONES)] if zone else FAINT


def _matrix(canvas: Canvas, corner: Point, title: str, names: tuple[list[str], list[str]], values: np.ndarray) -> None:
    """A heat map in percent."""
    (rows, columns), left, top = names, corner[0] + LABEL_PX, corner[1] + HEAD_PX
    canvas.text((corner[0], corner[1] + 4), title, 14, INK)
    for j, name in enumerate(columns):
        canvas.text((left + CELL_PX * (j + 0.6), top - 6), _short(name, HEAD_PX / 0.87), 12, INK, anchor="slant")
    for i, name in enumerate(rows):
        canvas.text((left - 8, top + CELL_PX * (i + 0.65)), _short(name, LABEL_PX - 10), 12, INK, anchor="end")
        for j in range(len(columns)):
            value = float(values[i, j])
            shade: Color = (round(255 - 190 * value), round(255 - 130 * value), round(255 - 60 * value))
            at = (left + CELL_PX * j, top + CELL_PX * i)
            canvas.box(at, (CELL_PX - 1, CELL_PX - 1), shade)
            color: Color = (255, 255, 255) if value > 0.6 else INK
            canvas.text((at[0] + CELL_PX / 2, at[1] + CELL_PX * 0.65), f"{100 * value:.0f}", 11, color, anchor="middle")


def _short(name: str, width_px: float) -> str:
    most = int(width_px / (12 * CHARACTER))
    return name if len(name) <= most else f"{name[: most - 1]}."
