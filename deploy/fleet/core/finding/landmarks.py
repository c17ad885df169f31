"""What can be found again in another map: objects, hubs (the widest places around), and doors (pure).

A landmark has a belief over names, a size and a neighbourhood, and never one of these alone decides: 10 to 20 % of the
labels may be wrong.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.scene import Scene

OBJECT, HUB, DOOR = range(3)
HUB_AROUND_M = 1.2  # a hub has the largest radius of all places that near
LEAST_HUB_M = 0.6
DOOR_AROUND_M = 1.0  # the narrowest edge of all that near
WIDEST_DOOR_M = 0.6  # clearance: half the width
OPENS_M = 0.25  # by which the places at both ends of the way through a door are wider
NEIGHBOURS_M = (1.0, 2.0, 3.5, 5.5)  # rings around a landmark in which names are counted
LEAST_BELIEF = 0.02  # of any name that an object is not taken for


class Landmarks(NamedTuple):
    """Columns of equal length, in the map's own frame."""

    positions_m: np.ndarray  # (landmark, 3)
    kinds: np.ndarray  # (landmark,) OBJECT, HUB or DOOR
    beliefs: np.ndarray  # (landmark, name); zeros but for objects
    sizes_m: np.ndarray  # (landmark, 2): height and root of the footprint; hubs the radius, doors the clearance, twice
    surroundings: np.ndarray  # (landmark, name * ring), unit length or zero


def names_in(*scenes: Scene) -> list[str]:
    """The names of all objects."""
    return sorted({item.label for scene in scenes for item in scene.objects if item.label})


def landmarks_of(scene: Scene, names: Sequence[str]) -> Landmarks:
    """The landmarks of one map; objects without a name are left out."""
    objects = [item for item in scene.objects if item.label in names]
    count = len(names)
    beliefs = np.zeros((len(objects), count))
    for row, item in enumerate(objects):
        sure = item.probability * item.known
        beliefs[row] = max((1 - sure) / max(count - 1, 1), LEAST_BELIEF)
        beliefs[row, names.index(item.label)] = max(sure, LEAST_BELIEF)
    beliefs /= np.maximum(beliefs.sum(axis=1, keepdims=True), 1e-9)
    extents_m = np.array([np.subtract(item.max_m, item.min_m) for item in objects]).reshape(-1, 3)
    shapes = np.column_stack((extents_m[:, 2], np.sqrt(extents_m[:, 0] * extents_m[:, 1])))
    spots = np.array([item.position_m for item in objects]).reshape(-1, 3)
    hubs, radii_m = _hubs(scene)
    doors, clearances_m = _doors(scene)
    positions_m = np.concatenate((spots, hubs, doors))
    every = np.concatenate((beliefs, np.zeros((len(hubs) + len(doors), count))))
    return Landmarks(
        positions_m,
        np.repeat((OBJECT, HUB, DOOR), (len(spots), len(hubs), len(doors))),
        every,
        np.concatenate((shapes, np.column_stack([np.append(radii_m, clearances_m)] * 2))),
        _surroundings(positions_m, spots, beliefs),
    )


def _hubs(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) and radii (n,) of places that are wider than all around."""
    positions_m, radii_m = scene.positions_m.astype(float), scene.radii_m.astype(float)
    if not len(positions_m):
        return np.zeros((0, 3)), np.zeros(0)
    near = cKDTree(positions_m).query_ball_point(positions_m, HUB_AROUND_M)
    widest = np.array([radii_m[around].max() for around in near])
    rows = np.flatnonzero((radii_m >= widest) & (radii_m >= LEAST_HUB_M))
    return positions_m[rows], radii_m[rows]


def _doors(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Middles (n, 3) and clearances (n,) of ways that are narrower than all around and open on both sides."""
    rows = np.searchsorted(scene.place_ids, scene.edges)
    clear = scene.clearances_m.astype(float)
    opens = (scene.radii_m[rows].min(axis=1) if len(rows) else np.zeros(0)) >= clear + OPENS_M
    narrow = np.flatnonzero((clear <= WIDEST_DOOR_M) & opens)
    if not len(narrow):
        return np.zeros((0, 3)), np.zeros(0)
    middles_m = scene.positions_m[rows[narrow]].mean(axis=1).astype(float)
    kept: list[int] = []
    for at in np.argsort(clear[narrow], kind="stable").tolist():
        if all(np.linalg.norm(middles_m[at] - middles_m[other]) > DOOR_AROUND_M for other in kept):
            kept.append(at)
    return middles_m[kept], clear[narrow][kept]


def _surroundings(positions_m: np.ndarray, spots_m: np.ndarray, beliefs: np.ndarray) -> np.ndarray:
    """How much of each name lies in each ring around each landmark, without the landmark itself."""
    if not (len(spots_m) and len(positions_m)):
        return np.zeros((len(positions_m), len(NEIGHBOURS_M) * beliefs.shape[1]))
    distances_m = np.linalg.norm(positions_m[:, None] - spots_m[None], axis=2)
    inner = 0.05
    rings = []
    for outer in NEIGHBOURS_M:
        rings.append(((distances_m > inner) & (distances_m <= outer)) @ beliefs)
        inner = outer
    found = np.concatenate(rings, axis=1)
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9))
