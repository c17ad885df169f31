"""A scene graph as plain JSON and as a picture.

`scene_json` (lists sorted by id, metres, world with z up, null where nothing is known yet):

    origin_m      [x, y, z]                       of this world in the source's: add it to any position
    merged_of     [robot]                         of a merged map: whose maps; empty = it is a robot's own
    robot, stamp_ns, environment, task, prior_digest, embedding_space
    labels        [label]                         columns of every posterior
    regions       [{id, label, parent, probability, unknown, predicted, area_m2, position_m [x, y, z], hull_m [[x, y]],
                    places [id], objects [id], adjacent [region id],
                    transitions [{region, edge [place id inside, outside], position_m, clearance_m, door}],
                    members [{robot, session, id}]}]      of a merged map: the robots' regions it is made of
    zones         [{label, regions [id]}]         the level above
    levels        [{level, id, label, probability, members, member_ids, area_m2, position_m, parent_id, regions [id]}]
                                                  zone, floor, building, district, from below; members says what
                                                  member_ids are of, parent_id -1 = none
    places        [{id, position_m [x, y, z], radius_m, region, label, posterior {label: p}, unknown, predicted,
                    frontier {direction [x, y, z], area_m2}, ellipse {half_axes_m, angle_rad}, hull_m [[x, y]]}]
    objects       [{id, label, probability, known, position_m, min_m, max_m, frames, place,    place = the nearest
                    members [{robot, session, id}]}]
    markers       [{dictionary, id, size_m, position_m, quaternion_xyzw, frames, doubt}]   as schemas/markers.py has it
    edges         [{a, b, clearance_m}]           between places
    trajectory_m  [[x, y, z]]                     camera centres in order of time
    foresight     {is_predicted true, openings [{is_predicted true, place_id, position_m, beyond_m, width_m, region,
                    same, labels [{label, next, within, adjacency, existence, found, met}]}],
                    missing [{label, probability, found}], steps, look_m, elsewhere_m}   as schemas/foresight.py has it

Two regions are adjacent when an edge joins a place of one with a place of the other.
"""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.showing.map import draw_map
from prior_sg.deploy.showing.places import draw_places
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelName, regions_in
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene

DECIMALS = 4  # a tenth of a millimetre, a hundredth of a percent


def scene_json(scene: Scene) -> dict[str, Any]:
    """The scene as dictionaries, lists, numbers and text only; layout above."""
    names = {region.id: region.label for region in scene.regions}
    adjacent = adjacent_regions(scene)
    members = members_of(scene)
    predicted = set(scene.predicted_ids.tolist())
    frontiers, surfaces = frontiers_of(scene), surfaces_of(scene)
    return {
        "robot": scene.robot,
        "stamp_ns": scene.stamp_ns,
        "merged_of": scene.merged_of,
        "environment": scene.environment,
        "task": scene.task,
        "prior_digest": scene.prior_digest,
        "embedding_space": scene.space,
        "origin_m": list(scene.origin_m),
        "labels": list(scene.labels),
        "regions": [
            {
                "id": region.id,
                "label": region.label,
                "parent": region.parent,
                "probability": _short(region.probability),
                "unknown": _short(region.unknown),
                "predicted": region.predicted,
                "area_m2": _short(region.area_m2),
                "position_m": _short(region.position_m),
                "hull_m": _short(region.hull_m),
                "places": scene.place_ids[members[region.id]].tolist(),
                "objects": region.object_ids,
                "transitions": [_plain(way) for way in region.transitions],
                "adjacent": sorted(b if a == region.id else a for a, b in adjacent if region.id in (a, b)),
                "members": [_plain(member) for member in region.members],
            }
            for region in scene.regions
        ],
        "zones": [{"label": label, "regions": ids} for label, ids in zones(scene)],
        "levels": [_plain(node) | {"regions": regions_of(scene, node.level)[node.id]} for node in scene.nodes],
        "places": [
            _place_json(scene, row, names, predicted)
            | _opening_json(frontiers.get(place_id))
            | _ground_json(surfaces.get(place_id))
            for row, place_id in enumerate(scene.place_ids.tolist())
        ],
        "objects": [_object_json(item, place) for item, place in objects_with_places(scene)],
        "markers": [_plain(marker) for marker in scene.markers],
        "edges": [
            {"a": a, "b": b, "clearance_m": _short(clearance_m)}
            for (a, b), clearance_m in zip(scene.edges.tolist(), scene.clearances_m, strict=True)
        ],
        "trajectory_m": _short(scene.trajectory),
        "foresight": _foresight_json(scene.foresight),
    }


def _foresight_json(foresight: Foresight) -> dict[str, Any]:
    told: dict[str, Any] = _plain(foresight)
    return told | {"is_predicted": True, "openings": [one | {"is_predicted": True} for one in told["openings"]]}


def _object_json(item: SceneObject, place: int | None) -> dict[str, Any]:
    return {
        "id": item.id,
        "label": item.label or None,
        "probability": _short(item.probability),
        "known": _short(item.known),
        "position_m": _short(item.position_m),
        "min_m": _short(item.min_m),
        "max_m": _short(item.max_m),
        "frames": item.frames,
        "place": place,
        "members": [_plain(member) for member in item.members],
    }


def objects_with_places(scene: Scene) -> list[tuple[SceneObject, int | None]]:
    """Each object with the id of its nearest place."""
    placed: list[tuple[SceneObject, int | None]] = []
    for item in scene.objects:
        distances_m = np.linalg.norm(scene.positions_m - np.array(item.position_m, np.float32), axis=1)
        placed.append((item, int(scene.place_ids[distances_m.argmin()]) if len(distances_m) else None))
    return placed


def zones(scene: Scene) -> list[tuple[str, list[int]]]:
    """The level above the regions: label and region ids of each zone, sorted by the smallest id.

    Of a scene that was stored before there were levels, each connected set of regions with one parent.
    """
    if scene.nodes:
        held = regions_of(scene, "zone")
        found = [(node.label, held[node.id]) for node in scene.nodes if node.level == "zone"]
        return sorted(found, key=lambda zone: zone[1])
    parents = {region.id: region.parent for region in scene.regions if region.parent}
    zone_of = {region: region for region in parents}
    for a, b in sorted(adjacent_regions(scene)):
        if a in parents and b in parents and parents[a] == parents[b]:
            kept, gone = sorted((zone_of[a], zone_of[b]))
            zone_of = {region: kept if zone == gone else zone for region, zone in zone_of.items()}
    members: dict[int, list[int]] = {}
    for region, zone in sorted(zone_of.items()):
        members.setdefault(zone, []).append(region)
    return [(parents[zone], ids) for zone, ids in sorted(members.items())]


def regions_of(scene: Scene, level: LevelName) -> dict[int, list[int]]:
    """Ids of the regions of each node of a level, by the node's id."""
    held: dict[int, list[int]] = {node.id: [] for node in scene.nodes if node.level == level}
    for region, node in sorted(regions_in(scene.nodes, level).items()):
        held[node].append(region)
    return held


def _place_json(scene: Scene, row: int, names: dict[int, str], predicted: set[int]) -> dict[str, Any]:
    region = int(scene.place_regions[row])
    posterior = scene.posteriors[row]
    return {
        "id": int(scene.place_ids[row]),
        "position_m": _short(scene.positions_m[row]),
        "radius_m": _short(scene.radii_m[row]),
        "region": None if region == NO_REGION else region,
        "label": names.get(region),
        "posterior": dict(zip(scene.labels, _short(posterior), strict=True)) if posterior.any() else None,
        "unknown": _short(scene.unknown[row]),
        "predicted": int(scene.place_ids[row]) in predicted,
    }


def _opening_json(opening: tuple[np.ndarray, float] | None) -> dict[str, Any]:
    if opening is None:
        return {"frontier": None}
    return {"frontier": {"direction": _short(opening[0]), "area_m2": _short(opening[1])}}


def _ground_json(surface: tuple[np.ndarray, np.ndarray] | None) -> dict[str, Any]:
    if surface is None:
        return {"ellipse": None, "hull_m": []}
    (long_m, short_m, angle_rad), hull_m = surface
    ellipse = {"half_axes_m": _short((long_m, short_m)), "angle_rad": _short(angle_rad)}
    return {"ellipse": ellipse, "hull_m": _short(hull_m)}


def frontiers_of(scene: Scene) -> dict[int, tuple[np.ndarray, float]]:
    """Direction and area of each opening, by place id."""
    columns = (scene.frontier_ids.tolist(), scene.frontier_directions, scene.frontier_areas_m2.tolist())
    return {place: (direction, area_m2) for place, direction, area_m2 in zip(*columns, strict=True)}


def surfaces_of(scene: Scene) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Ellipse (half axes, angle) and hull (n, 2) of each 2D place, by place id."""
    hulls = np.split(scene.hulls_m, np.cumsum(scene.hull_counts)[:-1])
    return dict(zip(scene.surface_ids.tolist(), zip(scene.ellipses, hulls, strict=False), strict=True))


def save_json(scene: Scene, path: str | Path) -> None:
    """Write `scene_json`, indented. Raises OSError."""
    Path(path).write_text(json_text(scene_json(scene)) + "\n")


def map_png(scene: Scene, voxel_map: VoxelMap | None, path: str | Path, truth: GroundTruth | None = None) -> None:
    """Write the scene from above as a PNG picture, with ground truth dashed where given. Raises OSError."""
    outlines = [region.polygon_m for region in truth.regions] if truth else []
    Path(path).write_bytes(draw_map(scene, voxel_map, outlines))


def places_png(scene: Scene, voxel_map: VoxelMap | None, path: str | Path) -> None:
    """Write places, edges and openings in three dimensions as a PNG picture. Raises OSError."""
    Path(path).write_bytes(draw_places(scene, voxel_map))


def members_of(scene: Scene) -> dict[int, np.ndarray]:
    """Rows of the places of each listed region."""
    return {region.id: np.flatnonzero(scene.place_regions == region.id) for region in scene.regions}


def adjacent_regions(scene: Scene) -> set[tuple[int, int]]:
    """Pairs of listed regions (smaller id first) that an edge between places joins."""
    region_of = dict(zip(scene.place_ids.tolist(), scene.place_regions.tolist(), strict=True))
    known = {region.id for region in scene.regions}
    pairs = {tuple(sorted((region_of[a], region_of[b]))) for a, b in scene.edges.tolist()}
    return {(a, b) for a, b in pairs if a != b and a in known and b in known}


def _short(value: Any) -> Any:
    """Numbers as plain floats of few digits, in (nested) lists for arrays."""
    rounded = np.round(np.asarray(value, float), DECIMALS)
    return rounded.tolist()


def _plain(part: msgspec.Struct) -> dict[str, Any]:
    """As JSON has it: lists, no tuples."""
    found: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(part))
    return found
