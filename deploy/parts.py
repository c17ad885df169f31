"""Parts of a scene (pure)."""

import itertools
from collections.abc import Sequence

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.levels import LevelNode, nodes_above
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.scene import Scene


def part_of(scene: Scene, kept: np.ndarray, objects: list[SceneObject]) -> Scene:
    """A scene with only some of its places (place,), by mask, what lies between these, and these objects."""
    ids = scene.place_ids[kept]
    edges = np.isin(scene.edges, ids).all(axis=1)
    frontiers, surfaces = np.isin(scene.frontier_ids, ids), np.isin(scene.surface_ids, ids)
    corners = np.repeat(surfaces, scene.hull_counts)
    return msgspec.structs.replace(
        scene,
        place_ids=ids,
        positions_m=scene.positions_m[kept],
        radii_m=scene.radii_m[kept],
        basis_points=scene.basis_points[kept],
        place_regions=scene.place_regions[kept],
        posteriors=scene.posteriors[kept],
        unknown=scene.unknown[kept],
        edges=scene.edges[edges],
        clearances_m=scene.clearances_m[edges],
        predicted_ids=scene.predicted_ids[np.isin(scene.predicted_ids, ids)],
        objects=objects,
        frontier_ids=scene.frontier_ids[frontiers],
        frontier_directions=scene.frontier_directions[frontiers],
        frontier_areas_m2=scene.frontier_areas_m2[frontiers],
        surface_ids=scene.surface_ids[surfaces],
        ellipses=scene.ellipses[surfaces],
        hull_counts=scene.hull_counts[surfaces],
        hulls_m=scene.hulls_m[corners],
    )


def floors_of(scene: Scene) -> list[LevelNode]:
    """The floors, from below."""
    return sorted(
        (node for node in scene.nodes if node.level == "floor"), key=lambda node: (node.position_m[2], node.id)
    )


def storey_of(scene: Scene, floor: int) -> Scene:
    """What is on one floor, by the id of its node: its regions with their places, and the objects, the markers, the
    openings and the keyframes nearest to these. All levels stay that hold any of the regions. A floor that is not there
    holds nothing.
    """
    above = nodes_above(scene.nodes)
    on_it = {number for number, nodes in above.items() if ("floor", floor) in {(one.level, one.id) for one in nodes}}
    holding = {(node.level, node.id) for number in on_it for node in above[number]}
    kept = np.isin(scene.place_regions, sorted(on_it))
    objects, markers = (_nearest(scene, kept, spots_of(items)).tolist() for items in (scene.objects, scene.markers))
    part = part_of(scene, kept, list(itertools.compress(scene.objects, objects)))
    openings = [one for one in scene.foresight.openings if one.place_id in part.place_ids]
    return msgspec.structs.replace(
        part,
        regions=[region for region in scene.regions if region.id in on_it],
        nodes=[node for node in scene.nodes if (node.level, node.id) in holding],
        trajectory=scene.trajectory[_nearest(scene, kept, scene.trajectory)],
        foresight=msgspec.structs.replace(scene.foresight, openings=openings),
        markers=list(itertools.compress(scene.markers, markers)),
    )


def spots_of(items: Sequence[SceneObject | SceneMarker]) -> np.ndarray:
    """Positions (item, 3) of objects or markers, in their own frame."""
    return np.array([item.position_m for item in items], float).reshape(-1, 3)


def _nearest(scene: Scene, kept: np.ndarray, spots_m: np.ndarray) -> np.ndarray:
    """Mask (spot,) of the spots (spot, 3) whose nearest place is kept."""
    if not len(scene.place_ids) or not len(spots_m):
        return np.zeros(len(spots_m), bool)
    _, nearest = cKDTree(scene.positions_m).query(spots_m)
    return np.asarray(kept[nearest])
