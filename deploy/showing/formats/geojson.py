"""The scene as GeoJSON: regions as polygons, objects as outlines, markers, places and ways out as points, edges as
lines.

Coordinates are those of the world with its offset `origin_m` added. RFC 7946 means degrees; ours are metres, and the
file says of what: of the reference system it was given, else of the local world. A system is written as the member
`crs` of GeoJSON 2008, which GDAL and QGIS read.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.showing.export import DECIMALS, scene_json
from prior_sg.deploy.showing.material import Material

UTM_EASTING_M, UTM_NORTHING_M = (100_000.0, 900_000.0), (1_000.0, 10_000_000.0)


def write_geojson(material: Material, path: Path) -> None:
    """A FeatureCollection; every feature's `layer` says what it is."""
    told = scene_json(material.scene)
    origin_m = np.array(told["origin_m"])
    about = {name: told[name] for name in ("robot", "stamp_ns", "environment", "task", "origin_m")}
    collection = {
        "type": "FeatureCollection",
        **_system(material.crs, told["origin_m"]),
        "scene": about,
        "features": list(_features(told, origin_m)),
    }
    path.write_text(json_text(collection, indent=None))


def _system(crs: str, origin_m: list[float]) -> dict[str, Any]:
    """What the coordinates are of."""
    if crs:
        authority, _, code = crs.partition(":")
        name = f"urn:ogc:def:crs:{authority.upper()}::{code}"
        return {"crs": {"type": "name", "properties": {"name": name}}, "coordinates": f"metres of {crs}"}
    (east_m, north_m, _), (low, high), (south, north) = origin_m, UTM_EASTING_M, UTM_NORTHING_M
    if low <= east_m <= high and south <= north_m <= north:
        return {"coordinates": "metres; the origin looks like UTM of a zone unknown to the map: name it with --crs"}
    return {"coordinates": "metres of the local world, not degrees"}


def _features(told: dict[str, Any], origin_m: np.ndarray) -> Iterator[dict[str, Any]]:
    positions = {place["id"]: place["position_m"] for place in told["places"]}

    def at(points: Any) -> Any:
        shift = origin_m[: np.shape(points)[-1]]
        return np.round(np.asarray(points, float) + shift, DECIMALS).tolist()

    for region in told["regions"]:
        if len(hull := region["hull_m"]) > 2:
            facts = _facts(region, "id", "label", "parent", "probability", "unknown", "predicted", "area_m2")
            yield _feature("region", "Polygon", [at([*hull, hull[0]])], facts)
        for way in region["transitions"]:
            facts = {"from": region["id"], "to": way["region"], "clearance_m": way["clearance_m"], "door": way["door"]}
            yield _feature("way", "Point", at(way["position_m"]), facts)
    for item in told["objects"]:
        (x0, y0, z0), (x1, y1, z1) = item["min_m"], item["max_m"]
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
        facts = _facts(item, "id", "label", "probability", "known", "frames") | {"bottom_m": z0, "top_m": z1}
        yield _feature("object", "Polygon", [at(ring)], facts)
    for marker in told["markers"]:
        facts = _facts(marker, "id", "dictionary", "size_m", "frames", "doubt") | {"height_m": marker["position_m"][2]}
        yield _feature("marker", "Point", at(marker["position_m"]), facts)
    for place in told["places"]:
        facts = _facts(place, "id", "radius_m", "region", "label", "unknown", "predicted")
        yield _feature("place", "Point", at(place["position_m"]), facts | {"frontier": bool(place["frontier"])})
    for edge in told["edges"]:
        yield _feature("edge", "LineString", at([positions[edge["a"]], positions[edge["b"]]]), edge)
    if len(told["trajectory_m"]) > 1:
        yield _feature("trajectory", "LineString", at(told["trajectory_m"]), {})


def _facts(entry: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: entry[name] for name in names}


def _feature(layer: str, kind: str, coordinates: Any, facts: dict[str, Any]) -> dict[str, Any]:
    properties = {"layer": layer, **facts}
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}
