"""What speaks for and against two maps lying together in one way (pure)."""

from dataclasses import dataclass

import numpy as np

from prior_sg.deploy.fleet.core.finding.shape import Shape
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import inverse, transform

SEEN_M = -0.1  # a place whose centre is at most that far outside the other's free space lies in the overlap
WALL_M, FACING = 0.2, 0.7  # walls are one within that distance, when the cosine between their directions is above
THROUGH_M = 0.25  # a wall that deep in the other's free space is none there
NEAR_OBJECT_M = 0.7  # between one object in two maps
CLEAR_M = 0.3  # an object that deep in the other's free space is not there
CELL_M = 0.25  # in which the overlap's floor is counted
MOST_CELLS = 40  # along the radius of the widest place: of wider ones cells are larger
MOST_POINTS = 4_000_000  # that are looked at together
LEAST_SHARE = 1e-3
WALL_WORTH, THROUGH_WORTH = 0.1, 0.12  # of a point of a wall that both have, and that only one has
ROOM_M2 = 20.0  # labels of more floor than that count as of that much: neighbours say the same


@dataclass(frozen=True)
class Evidence:
    """Of one motion, from both maps."""

    overlap_m2: float  # floor under the places of one that lie in the other's free space
    walls_same: int  # points of walls that both have
    walls_through: int  # points of walls that stand in the other's free space
    labels: float  # mean log-likelihood ratio of the labels' agreement in the overlap, against chance
    objects_same: int  # objects of both maps that lie together and have one name
    objects_other: int  # that lie together and have others
    objects_gone: int  # that stand in the other's free space
    names: float  # log-likelihood ratio of the names of objects that lie together

    @property
    def fitting(self) -> float:
        """Share of the walls that both maps can tell of and both have."""
        return self.walls_same / max(self.walls_same + self.walls_through, 1)

    @property
    def total(self) -> float:
        """Log-likelihood ratio of all of it, roughly; for comparing motions between two maps."""
        walls = WALL_WORTH * self.walls_same - THROUGH_WORTH * self.walls_through
        return walls + self.names + min(self.overlap_m2, ROOM_M2) * self.labels - 0.5 * self.objects_gone


def evidence_of(b_from_a: np.ndarray, a: tuple[Scene, Shape], b: tuple[Scene, Shape]) -> Evidence:
    """The evidence for one motion."""
    (scene_a, shape_a), (scene_b, shape_b) = a, b
    a_in_b = Shape(transform(b_from_a, shape_a.centers_m), shape_a.radii_m)
    over_a = shape_b.depth_m(a_in_b.centers_m) > SEEN_M
    walls = [walls_of(b_from_a, shape_a, shape_b), walls_of(inverse(b_from_a), shape_b, shape_a)]
    same, other, gone, names = _objects(b_from_a, scene_a.objects, scene_b.objects, a_in_b, shape_b)
    return Evidence(
        overlap_m2=_floor_m2(a_in_b.centers_m[over_a], a_in_b.radii_m[over_a], shape_b),
        walls_same=walls[0][0] + walls[1][0],
        walls_through=walls[0][1] + walls[1][1],
        labels=_labels(a_in_b.centers_m[over_a], np.flatnonzero(over_a), scene_a, scene_b, shape_b),
        objects_same=same,
        objects_other=other,
        objects_gone=gone,
        names=names,
    )


def walls_of(b_from_a: np.ndarray, a: Shape, b: Shape, step: int = 1) -> tuple[int, int]:
    """How many points of a's walls, every `step`-th of them, are walls in b, too, and how many stand in b's free
    space."""
    points_a, out_a = (part[::step] for part in a.walls)
    _, out_b = b.walls
    if not (len(points_a) and len(out_b)):
        return 0, 0
    points_b = transform(b_from_a, points_a)
    distances_m, rows = b.wall_tree.query(points_b, distance_upper_bound=WALL_M)
    near = np.flatnonzero(np.isfinite(distances_m))
    facing = ((out_a[near] @ b_from_a[:3, :3].T) * out_b[rows[near]]).sum(axis=1) > FACING
    far = np.flatnonzero(~np.isfinite(distances_m))
    through = int((b.depth_m(points_b[far]) > THROUGH_M).sum()) if len(far) else 0
    return int(facing.sum()), through


def _floor_m2(centers_m: np.ndarray, radii_m: np.ndarray, other: Shape) -> float:
    """Area of the discs under these places, where the other map is free, too."""
    if not len(centers_m):
        return 0.0
    cell_m = max(CELL_M, float(radii_m.max()) / MOST_CELLS)
    reach = int(np.ceil(radii_m.max() / cell_m))
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1) * cell_m] * 2), axis=-1).reshape(-1, 2)
    spots = np.zeros((0, 3))
    for rows in np.array_split(np.arange(len(centers_m)), -(-len(centers_m) * len(steps) // MOST_POINTS)):
        points = centers_m[rows, None, :2] + steps
        inside = (steps**2).sum(axis=1)[None] <= radii_m[rows, None] ** 2
        heights = np.broadcast_to(centers_m[rows, None, 2], inside.shape)[inside]
        spots = np.concatenate((spots, np.column_stack((points[inside], heights))))
        _, first = np.unique(np.floor(spots[:, :2] / cell_m).astype(np.int64), axis=0, return_index=True)
        spots = spots[first]
    return float((other.depth_m(spots) > 0).sum() * cell_m**2) if len(spots) else 0.0


def _labels(points_m: np.ndarray, rows: np.ndarray, a: Scene, b: Scene, shape_b: Shape) -> float:
    """Mean over the places of a in the overlap: log of how likely both beliefs name one region, against chance."""
    if not (len(rows) and a.labels and b.labels):
        return 0.0
    names = sorted({*a.labels, *b.labels})
    held_a, held_b = _spread(a, names), _spread(b, names)
    _, nearest = shape_b.tree.query(points_m)
    share = np.maximum((held_a.mean(axis=0) + held_b.mean(axis=0)) / 2, LEAST_SHARE)
    same = ((held_a[rows] / share) * held_b[nearest]).sum(axis=1)
    return float(np.log(np.maximum(same, 0.05)).mean())


def _spread(scene: Scene, names: list[str]) -> np.ndarray:
    """Beliefs (place, name), the unknown mass as chance."""
    held = np.zeros((len(scene.place_ids), len(names)))
    columns = [names.index(label) for label in scene.labels]
    held[:, columns] = scene.posteriors
    unknown = np.clip(scene.unknown.astype(float), 0, 1)[:, None]
    return np.asarray(held * (1 - unknown) + unknown / len(names))


def _objects(
    b_from_a: np.ndarray, of_a: list[SceneObject], of_b: list[SceneObject], a_in_b: Shape, shape_b: Shape
) -> tuple[int, int, int, float]:
    """Objects that lie together with the same name, with others, and alone in free space; and what the names tell."""
    if not (of_a and of_b):
        return 0, 0, 0, 0.0
    spots_a = transform(b_from_a, np.array([item.position_m for item in of_a]))
    spots_b = np.array([item.position_m for item in of_b])
    names = sorted({item.label for item in (*of_a, *of_b)})
    share = {name: sum(item.label == name for item in (*of_a, *of_b)) / (len(of_a) + len(of_b)) for name in names}
    distances_m = np.linalg.norm(spots_a[:, None] - spots_b, axis=2)
    labels_a, labels_b = np.array([item.label for item in of_a]), np.array([item.label for item in of_b])
    alike = labels_a[:, None] == labels_b
    cost = np.where(distances_m < NEAR_OBJECT_M, distances_m + 0.5 * ~alike, np.inf)
    same = other = 0
    told = 0.0
    while np.isfinite(cost).any():
        row, column = np.unravel_index(np.argmin(cost), cost.shape)
        cost[row, :] = cost[:, column] = np.inf
        if alike[row, column]:
            same += 1
            told += np.log(0.7 / share[str(labels_a[row])])
        else:
            other += 1
            told += np.log(0.3)
    lonely_a = spots_a[(distances_m.min(axis=1) > NEAR_OBJECT_M)]
    lonely_b = spots_b[(distances_m.min(axis=0) > NEAR_OBJECT_M)]
    gone = sum(
        int((shape.depth_m(spots) > CLEAR_M).sum())
        for shape, spots in ((shape_b, lonely_a), (a_in_b, lonely_b))
        if len(spots)
    )
    return same, other, gone, told
