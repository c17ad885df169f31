"""Our scene.json as a scene graph again: what `export.py::scene_json` wrote, to its decimals."""

from typing import Any

import msgspec
import numpy as np

from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene


def scene_of_json(told: dict[str, Any]) -> Scene:
    """The scene that the content of a scene.json tells. Raises KeyError, TypeError or ValueError for other content."""
    places, labels = told["places"], told["labels"]
    posteriors = [[(place["posterior"] or {}).get(label, 0.0) for label in labels] for place in places]
    return Scene(
        robot=told["robot"],
        stamp_ns=told["stamp_ns"],
        environment=told["environment"],
        task=told["task"],
        merged_of=msgspec.convert(told.get("merged_of", []), list[str]),
        prior_digest=told["prior_digest"],
        space=told["embedding_space"],
        labels=labels,
        regions=[_region(region) for region in told["regions"]],
        objects=[_object(item) for item in told["objects"]],
        place_ids=np.array([place["id"] for place in places], np.int64),
        positions_m=_rows([place["position_m"] for place in places], 3),
        radii_m=np.array([place["radius_m"] for place in places], np.float32),
        basis_points=np.zeros(len(places), np.int16),  # not in the file
        place_regions=np.array([NO_REGION if p["region"] is None else p["region"] for p in places], np.int64),
        posteriors=np.array(posteriors, np.float16).reshape(len(places), len(labels)),
        unknown=np.array([place["unknown"] for place in places], np.float16),
        edges=np.array([(edge["a"], edge["b"]) for edge in told["edges"]], np.int64).reshape(-1, 2),
        clearances_m=np.array([edge["clearance_m"] for edge in told["edges"]], np.float32),
        trajectory=_rows(told["trajectory_m"], 3),
        predicted_ids=np.array([place["id"] for place in places if place["predicted"]], np.int64),
        origin_m=tuple(told["origin_m"]),
        revision=-1,  # of no store
        nodes=[msgspec.convert(node, LevelNode) for node in told.get("levels", ())],  # files before had none
        foresight=msgspec.convert(told.get("foresight", {}), Foresight),
        markers=[msgspec.convert(marker, SceneMarker) for marker in told.get("markers", ())],
        **_openings([place for place in places if place["frontier"]]),
        **_grounds([place for place in places if place["ellipse"]]),
    )


def _region(told: dict[str, Any]) -> Region:
    others = {"place_count": len(told["places"]), "neighbour_ids": told["adjacent"], "object_ids": told["objects"]}
    return msgspec.convert(told | others, Region)


def _object(told: dict[str, Any]) -> SceneObject:
    return msgspec.convert(told | {"label": told["label"] or ""}, SceneObject)


def _openings(places: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "frontier_ids": np.array([place["id"] for place in places], np.int64),
        "frontier_directions": _rows([place["frontier"]["direction"] for place in places], 3),
        "frontier_areas_m2": np.array([place["frontier"]["area_m2"] for place in places], np.float32),
    }


def _grounds(places: list[dict[str, Any]]) -> dict[str, Any]:
    ellipses = [place["ellipse"] for place in places]
    return {
        "surface_ids": np.array([place["id"] for place in places], np.int64),
        "ellipses": _rows([(*ellipse["half_axes_m"], ellipse["angle_rad"]) for ellipse in ellipses], 3),
        "hull_counts": np.array([len(place["hull_m"]) for place in places], np.int64),
        "hulls_m": _rows([corner for place in places for corner in place["hull_m"]], 2),
    }


def _rows(rows: list[Any], width: int) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, width)
