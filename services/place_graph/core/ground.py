"""2D places: the ground a robot can drive on, in pieces (Hydra, `place_2d_segmenter`, `place_2d_split_logic`; pure).

Hydra takes mesh vertices that a network has labelled as ground. Here the ground is found in the map: obstacle voxels
with enough free height above them, reached from their neighbours by small steps, on gentle slopes. It is cut into
square tiles, so that a change concerns its tiles only; in each tile every connected part is halved across the long side
of its smallest rectangle until the pieces are small. A piece becomes a place with its hull and with Hydra's ellipse,
whose axes are those of the rectangle times the square root of two. Pieces whose ground touches, all along the
line between them, and whose ellipses overlap are joined.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.opencv import cv2
from prior_sg.services.place_graph.core.columns import GroundColumns
from prior_sg.services.place_graph.core.skeleton.graph import Changes, GraphRules, Place, PlaceGraph, Voxel
from prior_sg.services.place_graph.core.terrain import connected, edge_of, ground_voxels
from prior_sg.services.place_graph.core.volume.grid import Box, VoxelGrid

TILE_PIECES = 4  # side of a tile in pieces of the final size


@dataclass(frozen=True)
class GroundRules:
    """What is ground and how it is divided; lengths in voxels."""

    clearance: int  # free height above
    step: int  # greatest difference in height of neighbours
    slope: float  # greatest rise over run
    piece: float  # a piece with a longer side is halved ...
    points: int  # ... if it has more voxels than this
    cluster: int  # connected ground of fewer voxels is an outlier
    overlap: float  # smallest overlap of two ellipses that are joined
    rise: float  # greatest difference in height of two pieces that are joined
    furniture: int = 0  # connected ground of fewer voxels is none where one falls from most of its edge

    @property
    def tile(self) -> int:
        """Side of a tile."""
        return max(1, round(TILE_PIECES * self.piece))


class Piece(NamedTuple):
    """One place on the ground: its voxels (n, 3), the middle one, the ellipse and the hull, in voxels."""

    voxels: np.ndarray
    middle: Voxel
    center: np.ndarray  # (2,)
    half_axes: np.ndarray  # (2,) long, short
    angle_rad: float
    hull: np.ndarray  # (n, 2)


class GroundGraph(PlaceGraph):
    """Places on the ground with lasting ids, and the edges between them."""

    def __init__(self, rules: GroundRules) -> None:
        super().__init__(GraphRules(cell=max(1, round(rules.piece)), merge=rules.piece, edge=0, reach=0, free=0))
        self.ground = rules
        self.pieces: dict[int, Piece] = {}

    def renew(self, grid: VoxelGrid, tiles: np.ndarray) -> Changes:
        """Divide the ground of tiles (m, 2), m > 0, again, and join it anew."""
        changes, whole = Changes(), self.box_of(tiles, grid.bounds)
        for x, y in tiles.tolist():
            self._renew_tile(grid, (x, y), changes)
        self._relink(whole, changes)
        return changes

    def box_of(self, tiles: np.ndarray, bounds: Box) -> Box:
        """The box around tiles (m, 2), as high as `bounds`."""
        low, high = tiles.min(axis=0) * self.ground.tile, (tiles.max(axis=0) + 1) * self.ground.tile
        return Box(np.array((*low, bounds.low[2])), np.array((*high, bounds.high[2])))

    def concerned(self, changed: np.ndarray) -> np.ndarray:
        """Tiles (m, 2), in order, with one of the voxels (n, 3), n > 0, in them or up to half a tile beside them."""
        side = self.ground.tile
        first, last = (np.floor_divide(changed[:, :2] + beside, side) for beside in (-(side // 2), side // 2))
        low = first.min(axis=0)
        concerned = np.zeros(last.max(axis=0) - low + 1, np.bool_)
        for x in (first[:, 0], last[:, 0]):
            for y in (first[:, 1], last[:, 1]):
                concerned[x - low[0], y - low[1]] = True
        return np.argwhere(concerned) + low

    def renumber(self, number: Mapping[int, int], next_id: int) -> None:
        """Give every place another id."""
        super().renumber(number, next_id)
        self.pieces = {number[i]: piece for i, piece in self.pieces.items()}

    def shapes(self, ids: Iterable[int], voxel_m: float) -> GroundColumns:
        """Ellipse and hull of places, ids ascending."""
        pieces = {i: self.pieces[i] for i in sorted(ids) if i in self.pieces}
        ellipses = [(*(piece.half_axes * voxel_m), piece.angle_rad) for piece in pieces.values()]
        hulls = [np.empty((0, 2)), *((piece.hull + 0.5) * voxel_m for piece in pieces.values())]
        return GroundColumns(
            surface_ids=np.array(list(pieces), np.int64),
            ellipses=np.array(ellipses, np.float32).reshape(-1, 3),
            hull_counts=np.array([len(piece.hull) for piece in pieces.values()], np.int64),
            hulls_m=np.concatenate(hulls).astype(np.float32),
        )

    def _renew_tile(self, grid: VoxelGrid, tile: tuple[int, int], changes: Changes) -> None:
        side = self.ground.tile
        low = np.array((tile[0] * side, tile[1] * side, grid.bounds.low[2]))
        inside = Box(low, np.array((low[0] + side, low[1] + side, grid.bounds.high[2])))
        pieces = divide(grid, inside, self.ground)
        old_ids = [i for i in self.within(inside) if i not in self.frozen or _observed(grid, self.places[i].voxel)]
        self.frozen.difference_update(old_ids)
        id_of = _continued([(i, self.pieces[i]) for i in old_ids], pieces, self.ground.piece)
        for index, piece in enumerate(pieces):
            place_id = id_of.get(index)
            if place_id is None:
                place_id, self._next_id = self._next_id, self._next_id + 1
            d2 = max(1, round(float(np.prod(piece.half_axes))))
            place = Place(piece.middle, d2, d2, 0)
            known = self.pieces.get(place_id)
            if self.places.get(place_id) != place or known is None or not np.array_equal(known.hull, piece.hull):
                changes.touched.add(place_id)
            self._put(place_id, place)
            self.pieces[place_id] = piece
        for place_id in set(old_ids) - set(id_of.values()):
            changes.touched.update((place_id, *self.edges.get(place_id, ())))
            self._drop(place_id)
            del self.pieces[place_id]

    def _relink_near(self, box: Box) -> dict[tuple[int, int], int]:
        """Edges between pieces near a box: smaller id, larger id, squared overlap."""
        ids = [i for i in self.within(box.grown(self.ground.tile)) if i not in self.frozen]
        found: dict[tuple[int, int], int] = {}
        for one, two in touching_pieces([self.pieces[i] for i in ids], self.ground.step):
            a, b = self.pieces[ids[one]], self.pieces[ids[two]]
            overlap = overlap_of(a, b)
            if overlap > self.ground.overlap and abs(a.middle[2] - b.middle[2]) < self.ground.rise:
                found[min(ids[one], ids[two]), max(ids[one], ids[two])] = max(1, round(overlap**2))
        return found

    def _relink(self, region: Box, changes: Changes) -> None:  # type: ignore[override]
        """Renew the edges with an end in `region`."""
        inside = set(self.within(region)) - self.frozen
        renewed: dict[int, dict[int, int]] = {a: {} for a in inside}
        for a in inside:
            for b, weight in self.edges.get(a, {}).items():
                if b in self.frozen:
                    renewed[a][b] = weight
        links = {pair: w for pair, w in self._relink_near(region).items() if inside.intersection(pair)}
        outside = {b for a in inside for b in self.edges.get(a, ())} | {i for pair in links for i in pair}
        for b in outside - inside - self.frozen:
            renewed[b] = {a: w for a, w in self.edges.get(b, {}).items() if a not in inside}
        for (a, b), weight in links.items():
            renewed[a][b] = renewed[b][a] = weight
        for a, neighbours in renewed.items():
            if neighbours != self.edges.get(a, {}):
                changes.touched.add(a)
            self.edges[a] = neighbours


def divide(grid: VoxelGrid, tile: Box, rules: GroundRules) -> list[Piece]:
    """The pieces of ground inside a tile, in a fixed order. What lies up to half a tile around it counts too."""
    margin = np.array((rules.tile // 2, rules.tile // 2, 0))
    window = tile.grown(margin).clipped(grid.bounds)
    if 0 in window.shape:
        return []
    label = grid.gather("label", window)
    ground = ground_voxels(label, rules.clearance, rules.step, rules.slope)
    parts, count = connected(ground, rules.step)
    voxels = np.argwhere(ground)
    part = parts[tuple(voxels.T)]
    sizes = np.bincount(part, minlength=count)
    falls, edges = edge_of(label, parts, count, rules.step)
    furniture = (sizes < rules.furniture) & (2 * falls >= np.maximum(edges, 1))
    voxels += window.low
    kept = tile.contains(voxels) & ((sizes >= rules.cluster) & ~furniture)[part]
    pieces: list[Piece] = []
    for number in np.unique(part[kept]).tolist():
        pieces += (_piece(points) for points in _halved(voxels[kept & (part == number)], rules))
    return pieces


def _halved(voxels: np.ndarray, rules: GroundRules) -> list[np.ndarray]:
    """Voxels (n, 3) in pieces: halved across the long side of the smallest rectangle around them."""
    center, half_axes, angle_rad = _rectangle(voxels)
    if len(voxels) <= rules.points or 2 * half_axes[0] <= rules.piece:
        return [voxels]
    side = (voxels[:, :2] - center) @ (np.cos(angle_rad), np.sin(angle_rad)) > 0
    if side.all() or not side.any():
        return [voxels]
    return _halved(voxels[side], rules) + _halved(voxels[~side], rules)


def _rectangle(voxels: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre, half sides (long, short) with half a voxel around, and the angle of the long side."""
    (x, y), (width, height), degrees = cv2.minAreaRect(voxels[:, :2].astype(np.float32))
    angle_rad = np.deg2rad(degrees) + (np.pi / 2 if height > width else 0.0)
    half = np.array((max(width, height), min(width, height))) / 2 + 0.5
    return np.array((x, y)), half, float((angle_rad + np.pi / 2) % np.pi - np.pi / 2)


def _piece(voxels: np.ndarray) -> Piece:
    center, half, angle_rad = _rectangle(voxels)
    mean = voxels.mean(axis=0)
    x, y, z = voxels[int(((voxels - mean) ** 2).sum(axis=1).argmin())].tolist()
    hull = cv2.convexHull(voxels[:, :2].astype(np.int32))[:, 0].astype(float)
    return Piece(voxels, (x, y, z), center, np.sqrt(2.0) * half, angle_rad, hull)


def overlap_of(one: Piece, two: Piece) -> float:
    """How deep two ellipses overlap along the line between their centres, voxels; negative if they do not."""
    between = two.center - one.center
    apart = float(np.linalg.norm(between))
    if not apart:
        return float(2 * min(one.half_axes[1], two.half_axes[1]))
    return _radius(one, between / apart) + _radius(two, between / apart) - apart


def _radius(piece: Piece, direction: np.ndarray) -> float:
    cosine, sine = np.cos(piece.angle_rad), np.sin(piece.angle_rad)
    along, across = direction @ (cosine, sine), direction @ (-sine, cosine)
    return float(1 / np.hypot(along / piece.half_axes[0], across / piece.half_axes[1]))


def touching_pieces(pieces: list[Piece], step: int) -> list[tuple[int, int]]:
    """Pairs of pieces with neighbouring ground and ground all along the line between their middles; sorted."""
    if not pieces:
        return []
    voxels = np.concatenate([piece.voxels for piece in pieces])
    low = voxels.min(axis=0)
    owner = np.full(np.ptp(voxels, axis=0) + 1, -1, np.int32)
    owner[tuple((voxels - low).T)] = np.repeat(np.arange(len(pieces)), [len(piece.voxels) for piece in pieces])
    pairs = np.unique(np.sort(_neighbours(owner, step), axis=1), axis=0)
    middles = np.array([piece.middle for piece in pieces], np.int64) - low
    return [(int(a), int(b)) for a, b in pairs if _over_ground(owner, middles[a], middles[b], step)]


def _continued(old: list[tuple[int, Piece]], new: list[Piece], reach: float) -> dict[int, int]:
    """Which old id each new piece continues: nearest first."""
    distances = [
        (float(np.linalg.norm(np.subtract(piece.middle, fresh.middle))), place_id, index)
        for place_id, piece in old
        for index, fresh in enumerate(new)
    ]
    id_of: dict[int, int] = {}
    for distance, place_id, index in sorted(distances):
        if distance <= reach and index not in id_of and place_id not in id_of.values():
            id_of[index] = place_id
    return id_of


def _observed(grid: VoxelGrid, voxel: Voxel) -> bool:
    at = np.array(voxel)
    return bool(grid.gather("label", Box(at, at + 1)).any())


@compiled()
def _neighbours(owner, step):  # noqa: ANN001, ANN202
    """Pairs of owners with voxels side by side, with repeats."""
    nx, ny, nz = owner.shape
    pairs = np.empty((1024, 2), np.int64)
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if owner[i, j, k] < 0:
                    continue
                for side in range(2):
                    a, b = i + (side == 0), j + (side == 1)
                    if a >= nx or b >= ny:
                        continue
                    for c in range(max(0, k - step), min(nz, k + step + 1)):
                        if owner[a, b, c] < 0 or owner[a, b, c] == owner[i, j, k]:
                            continue
                        if count == len(pairs):
                            pairs = np.concatenate((pairs, np.empty_like(pairs)))
                        pairs[count, 0], pairs[count, 1] = owner[i, j, k], owner[a, b, c]
                        count += 1
    return pairs[:count]


@compiled()
def _over_ground(owner, start, stop, step):  # noqa: ANN001, ANN202
    """Whether all of a line lies over ground, or beside it by a voxel, at about its height."""
    nx, ny, nz = owner.shape
    steps = max(abs(stop[0] - start[0]), abs(stop[1] - start[1]), 1)
    for n in range(steps + 1):
        share = n / steps
        x = int(np.floor(start[0] + (stop[0] - start[0]) * share + 0.5))
        y = int(np.floor(start[1] + (stop[1] - start[1]) * share + 0.5))
        z = int(np.floor(start[2] + (stop[2] - start[2]) * share + 0.5))
        found = False
        for a in range(max(0, x - 1), min(nx, x + 2)):
            for b in range(max(0, y - 1), min(ny, y + 2)):
                for c in range(max(0, z - step), min(nz, z + step + 1)):
                    found = found or owner[a, b, c] >= 0
        if not found:
            return False
    return True
