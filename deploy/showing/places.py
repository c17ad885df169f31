"""The place graph in three dimensions: a parallel view from above at an angle, far things first.

Obstacles are grey cubes, cut off a little above the cameras so that rooms lie open; places are balls in the colour of
their region, larger ones with more room around them; edges are red where narrow and blue where wide; arrows lead out of
openings to unobserved space. 2D places are their ellipses.
"""

import cv2
import numpy as np

from prior_sg.deploy.showing.canvas import INK, MUTED
from prior_sg.deploy.showing.colors import UNLABELLED, Color, label_colors
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.scene import Scene

WIDTH_PX, HEIGHT_PX, MARGIN_PX, TITLE_PX = 1600, 1100, 60, 70
SUPERSAMPLING = 2
AZIMUTH_RAD, ELEVATION_RAD = np.deg2rad(35.0), np.deg2rad(42.0)
CUT_M = 0.3  # obstacles higher than this above the middle of the cameras are left out
FLOOR_COLOR, WALL_COLOR = np.array((236, 238, 241)), np.array((168, 175, 184))
NARROW, WIDE, OPENING = np.array((178, 60, 40)), np.array((60, 90, 130)), (230, 120, 20)
WIDE_M = 1.0  # clearance from which an edge has the colour of wide ones
SHOWN_AREA_M2 = 0.3  # smaller openings have no arrow


def draw_places(scene: Scene, voxel_map: VoxelMap | None) -> bytes:
    """A PNG file of places, edges and openings over the obstacles of the map, if there is one."""
    canvas = np.full((HEIGHT_PX * SUPERSAMPLING, WIDTH_PX * SUPERSAMPLING, 3), 255, np.uint8)
    occupied_m = _cut(scene, voxel_map)
    view = _View(np.concatenate((occupied_m, scene.positions_m, np.zeros((0, 3)))))
    if voxel_map is not None:
        _paint_obstacles(canvas, view, occupied_m, voxel_map.voxel_m)
    over = (_draw_edges, _draw_places) if not len(scene.surface_ids) else (_draw_places, _draw_edges)
    for draw in over:
        draw(canvas, view, scene)
    _draw_openings(canvas, view, scene)
    _write(canvas, scene)
    small = cv2.resize(canvas, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA)
    encoded, data = cv2.imencode(".png", cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
    if not encoded:
        raise OSError("the picture could not be encoded as PNG")
    return data.tobytes()


class _View:
    """A parallel projection that fits points (n, 3) into the canvas."""

    def __init__(self, points_m: np.ndarray) -> None:
        cosine, sine = np.cos(AZIMUTH_RAD), np.sin(AZIMUTH_RAD)
        up, level = np.cos(ELEVATION_RAD), np.sin(ELEVATION_RAD)
        self._axes = np.array(((cosine, sine, 0.0), (-sine * level, cosine * level, up)))  # right, up
        self._depth = np.array((-sine * up, cosine * up, -level))  # away from the eye
        points_m = points_m if len(points_m) else np.zeros((1, 3))
        plane = points_m @ self._axes.T
        low, high = plane.min(axis=0), plane.max(axis=0)
        room = SUPERSAMPLING * np.array((WIDTH_PX - 2 * MARGIN_PX, HEIGHT_PX - 2 * MARGIN_PX - TITLE_PX))
        self.px_per_m = float(min(room / np.maximum(high - low, 0.5)))
        middle = SUPERSAMPLING * np.array((WIDTH_PX / 2, (HEIGHT_PX + TITLE_PX) / 2))
        self._origin = middle - (low + high) / 2 * self.px_per_m * (1, -1)

    def pixels(self, points_m: np.ndarray) -> np.ndarray:
        """Canvas positions (n, 2) of world points (n, 3)."""
        return points_m @ self._axes.T * self.px_per_m * (1, -1) + self._origin

    def depths(self, points_m: np.ndarray) -> np.ndarray:
        """How far points lie from the eye, up to a constant."""
        return points_m @ self._depth


def _cut(scene: Scene, voxel_map: VoxelMap | None) -> np.ndarray:
    """Centres of the obstacle voxels that are shown."""
    if voxel_map is None:
        return np.zeros((0, 3))
    centers_m = (voxel_map.occupied + 0.5) * voxel_map.voxel_m
    heights = scene.trajectory[:, 2] if len(scene.trajectory) else scene.positions_m[:, 2]
    return centers_m[centers_m[:, 2] < np.median(heights) + CUT_M] if len(heights) else centers_m


def _paint_obstacles(canvas: np.ndarray, view: _View, centers_m: np.ndarray, voxel_m: float) -> None:
    """Far voxels first, each a square as large as the voxel looks, darker the higher it is."""
    order = np.argsort(-view.depths(centers_m), kind="stable")
    centers_m = centers_m[order]
    heights = centers_m[:, 2] - (centers_m[:, 2].min() if len(centers_m) else 0.0)
    share = np.clip(heights / 1.2, 0, 1)[:, None]
    colors = (FLOOR_COLOR + (WALL_COLOR - FLOOR_COLOR) * share).astype(np.uint8)
    side = max(1, round(view.px_per_m * voxel_m * 1.2))
    corners = np.round(view.pixels(centers_m) - side / 2).astype(int)
    height, width = canvas.shape[:2]
    for (x, y), color in zip(np.clip(corners, 0, (width - side, height - side)).tolist(), colors, strict=True):
        canvas[y : y + side, x : x + side] = color


def _draw_edges(canvas: np.ndarray, view: _View, scene: Scene) -> None:
    at = np.round(view.pixels(scene.positions_m.astype(float)) * 16).astype(int)
    rows = np.searchsorted(scene.place_ids, scene.edges)
    share = np.clip(scene.clearances_m / WIDE_M, 0, 1)[:, None]
    colors = (NARROW + (WIDE - NARROW) * share).astype(int)
    for (a, b), color in zip(rows.tolist(), colors.tolist(), strict=True):
        cv2.line(canvas, at[a].tolist(), at[b].tolist(), color, 2 * SUPERSAMPLING, cv2.LINE_AA, 4)


def _draw_places(canvas: np.ndarray, view: _View, scene: Scene) -> None:
    colors, names = label_colors(scene), {region.id: region.label for region in scene.regions}
    at = view.pixels(scene.positions_m.astype(float))
    ellipses = dict(zip(scene.surface_ids.tolist(), scene.ellipses.tolist(), strict=True))
    for row in np.argsort(-view.depths(scene.positions_m.astype(float)), kind="stable").tolist():
        color = colors.get(names.get(int(scene.place_regions[row]), ""), UNLABELLED)
        ellipse = ellipses.get(int(scene.place_ids[row]))
        if ellipse is None:
            radius = SUPERSAMPLING * (3.0 + 5.0 * min(float(scene.radii_m[row]), 2.0))
            _disc(canvas, at[row], radius, color)
        else:
            _draw_ellipse(canvas, view, scene.positions_m[row], ellipse, color)


def _disc(canvas: np.ndarray, at_px: np.ndarray, radius: float, color: Color) -> None:
    center = np.round(at_px * 16).astype(int).tolist()
    cv2.circle(canvas, center, round(16 * (radius + SUPERSAMPLING)), INK, -1, cv2.LINE_AA, 4)
    cv2.circle(canvas, center, round(16 * radius), color, -1, cv2.LINE_AA, 4)


def _draw_ellipse(canvas: np.ndarray, view: _View, center_m: np.ndarray, ellipse: list[float], color: Color) -> None:
    long_m, short_m, angle_rad = ellipse
    turn = np.linspace(0, 2 * np.pi, 40)
    along, across = long_m * np.cos(turn) / np.sqrt(2), short_m * np.sin(turn) / np.sqrt(2)
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    offsets = np.stack((along * cosine - across * sine, along * sine + across * cosine, np.zeros_like(turn)), axis=1)
    outline = np.round(view.pixels(center_m + offsets) * 16).astype(np.int32)
    drawn = canvas.copy()
    cv2.fillPoly(drawn, [outline], color, cv2.LINE_AA, 4)
    x, y = outline.min(axis=0) // 16 - 2
    w, h = outline.max(axis=0) // 16 + 3
    part = np.s_[max(y, 0) : h, max(x, 0) : w]
    canvas[part] = cv2.addWeighted(drawn[part], 0.5, canvas[part], 0.5, 0)
    cv2.polylines(canvas, [outline], True, INK, SUPERSAMPLING, cv2.LINE_AA, 4)


def _draw_openings(canvas: np.ndarray, view: _View, scene: Scene) -> None:
    """An arrow as long as the opening is wide, from the place outwards."""
    shown = scene.frontier_areas_m2 >= SHOWN_AREA_M2
    rows = np.searchsorted(scene.place_ids, scene.frontier_ids[shown])
    start_m = scene.positions_m[rows].astype(float)
    lengths_m = np.minimum(np.sqrt(scene.frontier_areas_m2[shown]), 1.5)[:, None]
    start, stop = view.pixels(start_m), view.pixels(start_m + scene.frontier_directions[shown] * lengths_m)
    for a, b in zip(np.round(start).astype(int).tolist(), np.round(stop).astype(int).tolist(), strict=True):
        cv2.arrowedLine(canvas, a, b, OPENING, round(1.5 * SUPERSAMPLING), cv2.LINE_AA, tipLength=0.3)


def _write(canvas: np.ndarray, scene: Scene) -> None:
    components = f"{len(scene.place_ids)} places, {len(scene.edges)} edges, {len(scene.frontier_ids)} openings"
    for text, y, size, color in ((f"{scene.robot}: places", 40, 0.9, INK), (components, 68, 0.6, MUTED)):
        at = (MARGIN_PX * SUPERSAMPLING, y * SUPERSAMPLING)
        cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size * SUPERSAMPLING, color, SUPERSAMPLING, cv2.LINE_AA)
