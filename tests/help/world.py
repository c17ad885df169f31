"""A small world for the segmenter's tests: a row of rooms, joined by doorways, seen by a turning camera.

A crop's embedding is the mean of the basis vectors of the rooms whose walls it sees, with a little noise.
"""

import numpy as np

from prior_sg.schemas.features import Pyramid, TextEmbeddings
from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import ObjectPrior, Prior, Provenance, RegionPrior, Task
from prior_sg.schemas.regions import RegionDelta

ROOM_M = 4.0  # rooms are squares; room i spans x in [4 i, 4 i + 4], y in [0, 4]
DOOR_M = (1.5, 2.5)  # doorways lie at these y
CAMERA = Intrinsics(width_px=64, height_px=48, fx_px=40.0, fy_px=40.0, cx_px=31.5, cy_px=23.5)
SPACE = "conse/efficientnet-lite2/minilm-l6-v2"
DIM = 6
ROBOT = "r1"


def place_grid(rooms: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of a grid of places, 1 m apart and one in each doorway, and the edges between neighbours."""
    points = [(room * ROOM_M + 0.5 + i, 0.5 + j, 1.0) for room in range(rooms) for i in range(4) for j in range(4)]
    points += [(room * ROOM_M, 2.0, 1.0) for room in range(1, rooms)]
    positions = np.array(points, dtype=np.float32)
    first, second = np.triu_indices(len(positions), 1)
    near = np.linalg.norm(positions[first] - positions[second], axis=1) < 1.1
    same_room = positions[first, 0] // ROOM_M == positions[second, 0] // ROOM_M
    door = (positions[first, 0] % ROOM_M == 0) | (positions[second, 0] % ROOM_M == 0)
    keep = near & (same_room | door)
    return positions, np.stack((first, second), axis=1)[keep]


def place_delta(positions: np.ndarray, edges: np.ndarray, **changes) -> PlaceDelta:
    none = np.zeros(0, dtype=np.int64)
    fields = {
        "robot": ROBOT,
        "epoch": 1,
        "revision": 0,
        "stamp_ns": 1,
        "frame_id": 0,
        "place_ids": np.arange(len(positions)),
        "positions_m": positions.astype(np.float32),
        "radii_m": np.full(len(positions), 0.5, dtype=np.float32),
        "basis_points": np.full(len(positions), 3, dtype=np.int16),
        "removed_ids": none,
        "merged_ids": none.reshape(0, 2),
        "edges": edges.astype(np.int64),
        "clearances_m": np.full(len(edges), 0.4, dtype=np.float32),
        "removed_edges": none.reshape(0, 2),
    }
    return PlaceDelta(**(fields | changes))


def no_places(**changes) -> PlaceDelta:
    return place_delta(np.zeros((0, 3)), np.zeros((0, 2)), **changes)


def look(x_m: float, y_m: float, heading_rad: float) -> np.ndarray:
    """Pose of a level camera at 1 m height."""
    forward = np.array((np.cos(heading_rad), np.sin(heading_rad), 0.0))
    down = np.array((0.0, 0.0, -1.0))
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = np.cross(down, forward), down, forward, (x_m, y_m, 1.0)
    return pose


def ray_end(origin: np.ndarray, direction: np.ndarray, rooms: int) -> np.ndarray:
    """Where a level ray meets a wall."""
    best = np.inf
    for x in np.arange(rooms + 1) * ROOM_M:
        if direction[0] and (t := (x - origin[0]) / direction[0]) > 1e-9:
            y = origin[1] + t * direction[1]
            open_door = 0 < x < rooms * ROOM_M and DOOR_M[0] < y < DOOR_M[1]
            best = best if open_door else min(best, t)
    for y in (0.0, ROOM_M):
        if direction[1] and (t := (y - origin[1]) / direction[1]) > 1e-9:
            best = min(best, t)
    return origin + best * direction


def pyramid(frame_id: int, pose: np.ndarray, rooms: int, **changes) -> Pyramid:
    rng = np.random.default_rng(frame_id)
    columns = []
    for u in (np.arange(16) + 0.5) * 4 - 0.5:  # one ray per column of the coarse surface; walls are vertical
        ray = pose[:3, :3] @ ((u - CAMERA.cx_px) / CAMERA.fx_px, 0.0, 1.0)
        columns.append(ray_end(pose[:3, 3], ray, rooms))
    depth_m = (np.array(columns) - pose[:3, 3]) @ pose[:3, 2]
    centers, layers = [], []
    for layer, side in enumerate((24, 48)):
        starts = np.arange(0, 64 - side + 1, 8)
        centers += [(start + side / 2 - 0.5, 23.5) for start in starts]
        layers += [layer] * len(starts)
    embeddings = 0.05 * rng.standard_normal((len(centers), DIM))
    seen = np.array([min(max(int(end[0] / ROOM_M - 1e-6), 0), rooms - 1) for end in columns])
    for row, ((u, _), layer) in enumerate(zip(centers, layers, strict=True)):
        covered = np.abs((np.arange(16) + 0.5) * 4 - 0.5 - u) < (12, 24)[layer]
        embeddings[row, :rooms] += np.bincount(seen[covered], minlength=rooms) / covered.sum()
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    fields = {
        "robot": ROBOT,
        "frame_id": frame_id,
        "stamp_ns": 10 + frame_id,
        "space": SPACE,
        "worker": "w",
        "intrinsics": CAMERA,
        "world_from_camera": pose,
        "centers_px": np.array(centers, dtype=np.float32),
        "sigmas_px": np.array([(12.0, 24.0)[layer] for layer in layers], dtype=np.float32),
        "layers": np.array(layers, dtype=np.uint8),
        "depths_m": np.ones(len(centers), dtype=np.float32),
        "embeddings": embeddings.astype(np.float16),
        "surface_m": np.tile(depth_m.astype(np.float32), (12, 1)),
        "crops_total": len(centers),
    }
    return Pyramid(**(fields | changes))


FRAMES_PER_ROOM = 12


def walk(rooms: int) -> list[Pyramid]:
    """Two turns in every room, in opposite corners."""
    poses = [
        look(room * ROOM_M + corner, corner, 2 * np.pi * k / 6 + 0.1)
        for room in range(rooms)
        for corner in (0.7, 3.3)
        for k in range(6)
    ]
    return [pyramid(frame, pose, rooms) for frame, pose in enumerate(poses)]


def task(name: str = "tidy up", **changes) -> Task:
    return Task(**({"robot": ROBOT, "stamp_ns": 5, "environment": "home", "task": name} | changes))


def prior(labels: list[str], name: str = "tidy up", **changes) -> Prior:
    count = len(labels)
    fields = {
        "environment": "home",
        "task": name,
        "regions": [RegionPrior(name=label, phrases=[f"a {label}"], existence=1 / count) for label in labels],
        "objects": [ObjectPrior(name="oven", phrases=["an oven"]), ObjectPrior(name="bed", phrases=["a bed"])],
        "containment": np.full((count, 2), 0.5, dtype=np.float32),
        "adjacency": np.full((count, count), 0.3, dtype=np.float32),
        "provenance": Provenance(source="test"),
    }
    return Prior(**(fields | changes))


def text(concepts: np.ndarray, **changes) -> TextEmbeddings:
    """Embeddings of concepts given as rows of weights over the rooms' basis vectors."""
    embeddings = np.zeros((len(concepts), DIM), dtype=np.float32)
    embeddings[:, : concepts.shape[1]] = concepts
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    fields = {
        "space": SPACE,
        "embeddings": embeddings,
        "background_mean": np.full(len(concepts), 0.3, dtype=np.float32),
        "background_std": np.full(len(concepts), 0.25, dtype=np.float32),
        "temperature": 2.0,
        "null_score": 0.0,
    }
    return TextEmbeddings(**(fields | changes))


class Reader:
    """Follows region deltas literally as their schema says."""

    def __init__(self) -> None:
        self.regions, self.beliefs, self.revision = {}, {}, -1

    def apply(self, delta: RegionDelta) -> None:
        assert delta.snapshot or delta.revision == self.revision + 1
        if delta.snapshot:
            self.regions, self.beliefs = {}, {}
        self.revision = delta.revision
        for place in delta.removed_place_ids.tolist():
            del self.beliefs[place]
        for region in delta.removed_ids.tolist():
            del self.regions[region]
        for region in delta.regions:
            self.regions[region.id] = region
        for row, place in enumerate(delta.place_ids.tolist()):
            belief = (delta.posteriors[row].tolist(), float(delta.unknown[row]))
            self.beliefs[place] = (int(delta.place_regions[row]), *belief)

    def label(self, place: int) -> str:
        return self.regions[self.beliefs[place][0]].label
