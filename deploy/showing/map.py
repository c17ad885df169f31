"""The scene from above: free space coloured by region, walls, objects, the place graph, the trajectory and a legend.

World coordinates are turned by a quarter when the map is taller than wide, so that pictures are always landscape; the
small axes in the corner say so. Everything is drawn at twice the size and scaled down, which smooths what OpenCV does
not.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from prior_sg.deploy.showing.colors import UNLABELLED, Color, label_colors
from prior_sg.deploy.truth import voxel_owners
from prior_sg.schemas.names import shown
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.scene import Scene

LONGEST_LINE = 300  # characters of a text that are looked at
WIDTH_PX, MARGIN_PX, LEGEND_PX, TITLE_PX, FOOT_PX = 1600, 44, 330, 96, 64
MAX_MAP_HEIGHT_PX, MIN_MAP_HEIGHT_PX = 1100, 420
SUPERSAMPLING = 2
BORDER_M = 0.35  # white around the map
BAND_M = (0.3, 1.9)  # heights above the floor that make walls and walkable space
CEILING_GAP_M = 0.3
FURNITURE_SHARE, WALL_SHARE = 0.15, 0.7  # occupied part of a column within the band
REGION_OPACITY = 0.62
FURNITURE_M = 3.0  # a long sofa or kitchen counter

INK, MUTED, WALL, FURNITURE = (31, 35, 40), (107, 114, 128), (75, 82, 92), (176, 182, 190)
FREE, EDGE, PATH = (241, 243, 245), (70, 76, 84), (20, 20, 24)


@dataclass(frozen=True)
class Layers:
    """Top view on a grid: cell (i, j) is centred at (origin + (i, j) + 0.5) * cell_m of the drawing plane."""

    origin: np.ndarray  # (2,) int
    cell_m: float
    free: np.ndarray  # (i, j) bool
    walls: np.ndarray  # (i, j) share of the band that is occupied
    labels: np.ndarray  # (i, j) index into `shown_labels`, of the region that owns most of the column; -1 = none


@dataclass(frozen=True)
class _Mark:
    """One object as it is drawn."""

    corners_m: np.ndarray  # (4, 2) of its box, drawing plane
    label: str  # empty = unnamed

    @classmethod
    def of(cls, item: SceneObject, turned: bool) -> "_Mark":
        (x0, y0, _), (x1, y1, _) = item.min_m, item.max_m
        return cls(_plane(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), turned), item.label)


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
    _draw_trajectory(view, _plane(scene.trajectory, turned))
    for outline_m in outlines_m:
        _draw_dashed(view, _plane(outline_m, turned))
    taken = _draw_names(view, scene, turned)
    _draw_object_names(view, shown, taken)
    _draw_title(view, scene)
    _draw_legend(view, scene, colors, with_truth=bool(outlines_m), with_walls=voxel_map is not None)
    _draw_scale(view, turned)
    encoded, data = cv2.imencode(".png", cv2.cvtColor(view.finished(), cv2.COLOR_RGB2BGR))
    if not encoded:
        raise OSError("the picture could not be encoded as PNG")
    return data.tobytes()


def _plane(points: np.ndarray, turned: bool) -> np.ndarray:
    """World points (n, 2 or 3) in the drawing plane: x, y, or turned clockwise by a quarter."""
    x, y = np.asarray(points, float)[:, 0], np.asarray(points, float)[:, 1]
    return np.stack((y, -x) if turned else (x, y), axis=1)


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
    points = np.concatenate([*corners, _plane(scene.trajectory, turned), *(_plane(o, turned) for o in outlines_m)])
    if not len(points):
        points = np.zeros((1, 2))
    return points.min(axis=0) - BORDER_M, points.max(axis=0) + BORDER_M


def layers_of(scene: Scene, voxel_map: VoxelMap | None, turned: bool) -> Layers:
    """Walls and free space within the band; free columns are coloured by the places that own their voxels."""
    if voxel_map is None:
        voxel_m, occupied = 0.05, np.zeros((0, 3), int)
        places_m = np.concatenate((scene.positions_m[:, :2], np.full((len(scene.place_ids), 1), voxel_m / 2)), axis=1)
        free = _voxels_around(places_m, scene.radii_m, voxel_m)
    else:
        voxel_m, places_m = voxel_map.voxel_m, scene.positions_m
        low_m, high_m = _band(scene, voxel_map)
        free, occupied = (v[_between(v, voxel_m, low_m, high_m)] for v in (voxel_map.free, voxel_map.occupied))
    owners = voxel_owners(free, voxel_m, places_m, scene.radii_m)
    if voxel_map is None:
        free, owners = free[owners >= 0], owners[owners >= 0]
    return _columns(scene, voxel_m, _cells(free, turned), _cells(occupied, turned), owners)


def _columns(scene: Scene, cell_m: float, free: np.ndarray, occupied: np.ndarray, owners: np.ndarray) -> Layers:
    """Count voxels per cell: `free`, `occupied` are cells (n, 2) of the drawing plane, `owners` places of `free`."""
    cells = np.concatenate((free, occupied))
    if not len(cells):
        return Layers(np.zeros(2, int), cell_m, np.zeros((1, 1), bool), np.zeros((1, 1)), np.full((1, 1), -1))
    origin = cells.min(axis=0) - 1
    shape = tuple((cells.max(axis=0) - origin + 2).tolist())
    names, shown = {region.id: region.label for region in scene.regions}, shown_labels(scene)
    label_of_row = np.array([shown.index(names.get(region, "")) for region in scene.place_regions.tolist()] + [-1], int)
    votes = np.zeros((len(shown), *shape), np.int32)
    voters = owners >= 0
    np.add.at(votes, (label_of_row[owners[voters]], *(free[voters] - origin).T), 1)
    open_cells, walls = np.zeros(shape), np.zeros(shape)
    np.add.at(open_cells, tuple((free - origin).T), 1)
    np.add.at(walls, tuple((occupied - origin).T), 1)
    seen = walls + open_cells
    share = np.divide(walls, seen, out=np.zeros(shape), where=seen > 0)
    return Layers(origin, cell_m, open_cells > 0, share, np.where(votes.any(axis=0), votes.argmax(axis=0), -1))


def shown_labels(scene: Scene) -> list[str]:
    """Labels that may colour a cell; the empty one stands for places without a region."""
    return ["", *label_colors(scene)]


def _cells(voxels: np.ndarray, turned: bool) -> np.ndarray:
    return np.floor(_plane(voxels + 0.5, turned)).astype(int)


def _voxels_around(places_m: np.ndarray, radii_m: np.ndarray, voxel_m: float) -> np.ndarray:
    """One flat layer of voxels (n, 3) that covers all discs."""
    if not len(places_m):
        return np.zeros((0, 3), int)
    low = np.floor((places_m[:, :2].min(axis=0) - radii_m.max()) / voxel_m).astype(int)
    high = np.ceil((places_m[:, :2].max(axis=0) + radii_m.max()) / voxel_m).astype(int)
    return np.stack([axis.ravel() for axis in np.mgrid[low[0] : high[0], low[1] : high[1], 0:1]], axis=1)


def _band(scene: Scene, voxel_map: VoxelMap) -> tuple[float, float]:
    """Heights that make the picture: above the floor, below the ceiling, found as the fullest occupied layers."""
    heights = np.concatenate((scene.trajectory[:, 2], scene.positions_m[:, 2]))
    if not len(heights) or not len(voxel_map.occupied):
        return -np.inf, np.inf
    middle_m = float(np.median(scene.trajectory[:, 2] if len(scene.trajectory) else heights))
    layers, counts = np.unique(voxel_map.occupied[:, 2], return_counts=True)
    layers_m = (layers + 0.5) * voxel_map.voxel_m
    below, above = layers_m < middle_m - BAND_M[0], layers_m > middle_m + BAND_M[0]
    floor_m = layers_m[below][counts[below].argmax()] if below.any() else middle_m - 1.5
    ceiling_m = layers_m[above][counts[above].argmax()] if above.any() else np.inf
    return floor_m + BAND_M[0], min(floor_m + BAND_M[1], max(ceiling_m - CEILING_GAP_M, middle_m))


def _between(voxels: np.ndarray, voxel_m: float, low_m: float, high_m: float) -> np.ndarray:
    z_m = (voxels[:, 2] + 0.5) * voxel_m
    return (z_m >= low_m) & (z_m <= high_m)


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
) -> None:
    """Small names in the middle of their boxes, the largest first; one that would cover another name is left out."""
    for mark in sorted(marks, key=lambda mark: -float(np.ptp(mark.corners_m, axis=0).prod())):
        if not mark.label:
            continue
        width, height = _text_width(mark.label, size * SUPERSAMPLING), size * SUPERSAMPLING
        x, y = view.pixels(mark.corners_m.mean(axis=0)[None])[0] - (width / 2, -height / 3)
        box = (float(x), float(y), float(width), float(height))
        if any(_overlap(box, other) for other in taken):
            continue
        taken.append(box)
        _outlined_text(view, mark.label, box, size, rim=1)


def _draw_graph(view: View, scene: Scene, turned: bool) -> None:
    at_m = _plane(scene.positions_m, turned)
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
        at_m = _plane(scene.positions_m[rows], turned)
        middle = at_m[np.linalg.norm(at_m - at_m.mean(axis=0), axis=1).argmin()]
        width, height = _text_width(region.label, size * SUPERSAMPLING, True), size * SUPERSAMPLING
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


def _draw_title(view: View, scene: Scene) -> None:
    left = SUPERSAMPLING * MARGIN_PX
    room_px = WIDTH_PX - 2 * MARGIN_PX
    title = scene.task or "no task yet"
    size = next((size for size in range(34, 22, -2) if _fitted(title, size, room_px, True) == title), 24)
    view.text(_fitted(title, size, room_px, True), (left, SUPERSAMPLING * 62), size, INK, True)
    counts = f"{len(scene.regions)} regions, {len(scene.place_ids)} places, {len(scene.edges)} edges"
    under = "   ·   ".join(part for part in (scene.environment, f"robot {scene.robot}", counts) if part)
    view.text(_fitted(under, 19, room_px), (left, SUPERSAMPLING * 94), 19, MUTED)


def _draw_legend(view: View, scene: Scene, colors: dict[str, Color], *, with_truth: bool, with_walls: bool) -> None:
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
    _draw_symbols(view, scene, left, top + SUPERSAMPLING * 30, with_truth=with_truth, with_walls=with_walls)


def _draw_symbols(view: View, scene: Scene, left: int, top: int, *, with_truth: bool, with_walls: bool) -> None:
    """What the other marks mean."""
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
        start, end = row("object")
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


def _draw_scale(view: View, turned: bool) -> None:
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
        along = _plane(np.array([axis]), turned)[0] * (1, -1)
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
    while len(text) > 1 and _text_width(text, size * SUPERSAMPLING, bold) > width_px * SUPERSAMPLING:
        text = text.rstrip("…")[:-1] + "…"
    return text


def _text_right(view: View, text: str, at_px: tuple[float, float], size: int, color: Color = INK) -> None:
    view.text(text, (at_px[0] - _text_width(text, size * SUPERSAMPLING), at_px[1]), size, color)


if hasattr(cv2, "FontFace"):  # OpenCV 5 brings a real font
    _FACE = cv2.FontFace("sans")

    def _put_text(canvas: np.ndarray, text: str, at: tuple[int, int], size: int, *, color: Color, bold: bool) -> None:
        cv2.putText(canvas, text, at, color, _FACE, size, 600 if bold else 400)

    def _text_width(text: str, size: int, bold: bool = False) -> int:
        return cv2.getTextSize((0, 0), text, (0, 0), _FACE, size, 600 if bold else 400)[2]

else:
    _STROKES = cv2.FONT_HERSHEY_DUPLEX
    _STROKES_PX = 30.0  # height of its capitals with descenders at scale 1

    def _put_text(canvas: np.ndarray, text: str, at: tuple[int, int], size: int, *, color: Color, bold: bool) -> None:
        plain = text.replace("²", "2").replace("·", "-").replace("…", "..")
        cv2.putText(canvas, plain, at, _STROKES, size / _STROKES_PX, color, 3 if bold else 2, cv2.LINE_AA)

    def _text_width(text: str, size: int, bold: bool = False) -> int:
        return cv2.getTextSize(text, _STROKES, size / _STROKES_PX, 3 if bold else 2)[0][0]
