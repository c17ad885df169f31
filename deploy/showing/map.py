"""The scene from above: free space coloured by region, walls, objects, the place graph, the trajectory and a legend.

World coordinates are turned by a quarter when the map is taller than wide, so that pictures are always landscape; the
small axes in the corner say so.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from prior_sg.deploy.showing.canvas import (
    EDGE,
    FREE,
    FURNITURE,
    INK,
    MUTED,
    PATH,
    SUPERSAMPLING,
    WALL,
    View,
    text_width,
)
from prior_sg.deploy.showing.colors import UNLABELLED, Color, label_colors
from prior_sg.deploy.showing.legend import draw_legend, draw_scale, draw_title
from prior_sg.deploy.showing.top_view import FURNITURE_SHARE, WALL_SHARE, Layers, layers_of, plane
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.scene import Scene

BORDER_M = 0.35  # white around the map
REGION_OPACITY = 0.62
FURNITURE_M = 3.0  # a long sofa or kitchen counter


@dataclass(frozen=True)
class _Mark:
    """One object as it is drawn."""

    corners_m: np.ndarray  # (4, 2) of its box, drawing plane
    label: str  # empty = unnamed

    @classmethod
    def of(cls, item: SceneObject, turned: bool) -> "_Mark":
        (x0, y0, _), (x1, y1, _) = item.min_m, item.max_m
        return cls(plane(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), turned), item.label)


def draw_map(scene: Scene, voxel_map: VoxelMap | None, outlines_m: list[np.ndarray]) -> bytes:
    """A PNG file of the scene; `outlines_m` are ground-truth polygons (corner, 2). Spheres stand for a missing map."""
    turned = _is_tall(scene, voxel_map, outlines_m)
    layers = layers_of(scene, voxel_map, turned)
    view = View(*_bounds(scene, layers, outlines_m, turned))
    colors = label_colors(scene)
    _paint_floor(view, layers, colors)
    objects = [_Mark.of(item, turned) for item in scene.objects]
    shown = [mark for mark in objects if view.holds(mark.corners_m.mean(axis=0))]
    _draw_objects(view, shown)
    _draw_graph(view, scene, turned)
    _draw_trajectory(view, plane(scene.trajectory, turned))
    for outline_m in outlines_m:
        _draw_dashed(view, plane(outline_m, turned))
    taken = _draw_names(view, scene, turned)
    nameless = _draw_object_names(view, shown, taken)
    draw_title(view, scene)
    draw_legend(view, scene, colors, nameless, with_truth=bool(outlines_m), with_walls=voxel_map is not None)
    draw_scale(view, turned)
    encoded, data = cv2.imencode(".png", cv2.cvtColor(view.finished(), cv2.COLOR_RGB2BGR))
    if not encoded:
        raise OSError("the picture could not be encoded as PNG")
    return data.tobytes()


def _is_tall(scene: Scene, voxel_map: VoxelMap | None, outlines_m: list[np.ndarray]) -> bool:
    points = [scene.positions_m[:, :2], scene.trajectory[:, :2], *outlines_m]
    if voxel_map is not None:
        points.append(voxel_map.free[:, :2] * voxel_map.voxel_m)
    every = np.concatenate(points)
    width_m, height_m = np.ptp(every, axis=0) if len(every) else (0.0, 0.0)
    return bool(height_m > 1.15 * width_m)


def _bounds(scene: Scene, layers: Layers, outlines_m: list[np.ndarray], turned: bool) -> tuple[np.ndarray, np.ndarray]:
    """Corners of what is to be seen, drawing plane, metres."""
    cells = np.argwhere(layers.free | (layers.walls > 0))
    corners = [(layers.origin + cells + offset) * layers.cell_m for offset in (0, 1)]
    points = np.concatenate([*corners, plane(scene.trajectory, turned), *(plane(o, turned) for o in outlines_m)])
    if not len(points):
        points = np.zeros((1, 2))
    return points.min(axis=0) - BORDER_M, points.max(axis=0) + BORDER_M


def _paint_floor(view: View, layers: Layers, colors: dict[str, Color]) -> None:
    """Free space, regions and walls, each layer enlarged smoothly and cut at one half: cells do not show."""
    _fill(view, layers, layers.free, FREE)
    tints = np.array([UNLABELLED, *colors.values()], np.float32)
    total = np.zeros(tuple(view.map_px[::-1]), np.float32)
    best, winner = total.copy(), total.astype(np.int16)
    for index in np.unique(layers.labels[layers.labels >= 0]).tolist():
        mask = _enlarged(view, layers, layers.labels == index)
        total += mask
        winner[mask > best] = index
        best = np.maximum(best, mask)
    _blend(view, (total > 0.5).astype(np.float32), tints[winner], REGION_OPACITY)
    _fill(view, layers, layers.walls > FURNITURE_SHARE, FURNITURE)
    _fill(view, layers, layers.walls > WALL_SHARE, WALL)


def _fill(view: View, layers: Layers, cells: np.ndarray, color: Color) -> None:
    """Cover cells with a colour; the mask falls over about a cell, which is cut down to a rim of two pixels."""
    steepness = max(1.0, view.px_per_m * layers.cell_m / 2)
    _blend(view, np.clip((_enlarged(view, layers, cells) - 0.5) * steepness + 0.5, 0, 1), color, 1.0)


def _blend(view: View, mask: np.ndarray, color: Color | np.ndarray, opacity: float) -> None:
    """Mix a colour, or one per pixel, into the map where the mask (h, w) in [0, 1] says so."""
    (column, row), (width, height) = view.corner_px, view.map_px
    part = view.canvas[row : row + height, column : column + width]
    weight = (mask * np.float32(opacity))[..., None]
    part[:] = np.round(part * (1 - weight) + np.asarray(color, np.float32) * weight).astype(np.uint8)


def _enlarged(view: View, layers: Layers, cells: np.ndarray) -> np.ndarray:
    """A cell mask (i, j) resampled smoothly to the map's pixels (h, w), float32."""
    scale = 1 / (view.px_per_m * layers.cell_m)
    first = view.low_m / layers.cell_m - layers.origin - 0.5
    top = view.high_m[1] / layers.cell_m - layers.origin[1] - 0.5
    to_cell = np.array([[scale, 0, first[0] + scale / 2], [0, -scale, top - scale / 2]])
    soft = cv2.GaussianBlur(cells.T.astype(np.float32), (0, 0), 0.55)
    size = (int(view.map_px[0]), int(view.map_px[1]))
    return cv2.warpAffine(soft, to_cell, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderValue=0)


def _draw_objects(view: View, marks: list[_Mark]) -> None:
    """The outline of each object's box, darker with a name, on a white rim that tells it from the graph.

    Boxes wider than furniture are pieces of walls, or several things that touch: they stay without an outline.
    """
    drawn = [mark for mark in marks if float(np.ptp(mark.corners_m, axis=0).max()) <= FURNITURE_M]
    boxes = [np.clip(mark.corners_m, view.low_m, view.high_m)[[0, 1, 2, 3, 0]] for mark in drawn]
    view.lines(boxes, (255, 255, 255), 1.5, 0.5)
    for color, named in ((MUTED, False), (INK, True)):
        view.lines([box for box, mark in zip(boxes, drawn, strict=True) if bool(mark.label) == named], color, 0.5)


def _draw_object_names(
    view: View, marks: list[_Mark], taken: list[tuple[float, float, float, float]], size: int = 13
) -> int:
    """Small names in the middle of their boxes, the largest first; how many are left out, for want of room."""
    left_out = 0
    for mark in sorted(marks, key=lambda mark: -float(np.ptp(mark.corners_m, axis=0).prod())):
        if not mark.label:
            continue
        width, height = text_width(mark.label, size * SUPERSAMPLING), size * SUPERSAMPLING
        x, y = view.pixels(mark.corners_m.mean(axis=0)[None])[0] - (width / 2, -height / 3)
        box = (float(x), float(y), float(width), float(height))
        if any(_overlap(box, other) for other in taken):
            left_out += 1
            continue
        taken.append(box)
        _outlined_text(view, mark.label, box, size, rim=1)
    return left_out


def _draw_graph(view: View, scene: Scene, turned: bool) -> None:
    at_m = plane(scene.positions_m, turned)
    row_of = {place: row for row, place in enumerate(scene.place_ids.tolist())}
    view.lines([at_m[[row_of[a], row_of[b]]] for a, b in scene.edges.tolist()], EDGE, 1.0, 0.35)
    for at_px in view.pixels(at_m):
        view.dot(at_px, 2.2, EDGE, (255, 255, 255))


def _draw_trajectory(view: View, path_m: np.ndarray) -> None:
    view.lines([path_m], (255, 255, 255), 4.5, 0.7)
    view.lines([path_m], PATH, 2.0)
    if len(path_m):
        start, end = view.pixels(path_m[[0, -1]])
        view.dot(start, 5.5, (255, 255, 255), PATH)
        view.dot(end, 5.5, PATH, (255, 255, 255))


def _draw_dashed(view: View, polygon_m: np.ndarray, dash_m: float = 0.16) -> None:
    """A dashed outline. Dashes begin at fixed points of the edge's whole line, so that shared walls stay dashed."""
    dashes = []
    for one, two in zip(polygon_m, np.roll(polygon_m, -1, axis=0), strict=True):
        a, b = sorted((one.tolist(), two.tolist()))
        along = np.subtract(b, a)
        length_m = float(np.linalg.norm(along))
        if length_m == 0:
            continue
        along = along / length_m
        begin = float(along @ a)
        for start in np.arange(np.floor(begin / dash_m / 2) * 2 * dash_m, begin + length_m, 2 * dash_m):
            ends = np.clip((start - begin, start + dash_m - begin), 0, length_m)
            if ends[1] > ends[0]:
                dashes.append(np.array(a) + ends[:, None] * along)
    view.lines(dashes, INK, 2.0)


def _draw_names(view: View, scene: Scene, turned: bool, size: int = 22) -> list[tuple[float, float, float, float]]:
    """Each region's label at its place nearest to its middle, moved up or down while labels would overlap.

    Returns where they stand: left, baseline, width and height on the canvas.
    """
    taken: list[tuple[float, float, float, float]] = []
    for region in sorted(scene.regions, key=lambda region: -region.area_m2):
        rows = np.flatnonzero(scene.place_regions == region.id)
        if not len(rows):
            continue
        at_m = plane(scene.positions_m[rows], turned)
        middle = at_m[np.linalg.norm(at_m - at_m.mean(axis=0), axis=1).argmin()]
        width, height = text_width(region.label, size * SUPERSAMPLING, True), size * SUPERSAMPLING
        x, y = view.pixels(middle[None])[0] - (width / 2, -height / 3)
        low, high = view.corner_px[0], view.corner_px[0] + view.map_px[0] - width
        x = float(np.clip(x, low, max(low, high)))
        for shift in (0, -1, 1, -2, 2, -3, 3):
            box = (x, y + shift * 1.1 * height, width, height)
            if not any(_overlap(box, other) for other in taken):
                break
        taken.append(box)
        _outlined_text(view, region.label, box, size, rim=2, bold=True)
    return taken


def _outlined_text(view: View, text: str, box: tuple[float, ...], size: int, *, rim: int, bold: bool = False) -> None:
    """Text with a white rim, so that it can be read on anything."""
    steps = range(-rim, rim + 1)
    for offset in np.array([(a, b) for a in steps for b in steps]) * SUPERSAMPLING:
        view.text(text, (box[0] + offset[0], box[1] + offset[1]), size, (255, 255, 255), bold)
    view.text(text, (box[0], box[1]), size, INK, bold)


def _overlap(one: tuple[float, ...], two: tuple[float, ...]) -> bool:
    return all(one[axis] < two[axis] + two[axis + 2] and two[axis] < one[axis] + one[axis + 2] for axis in (0, 1))
