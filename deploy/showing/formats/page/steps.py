"""How a scene came about, as steps that each hold what differs from the one before.

A step: `places` [[id, x, y, z, radius, region, unknown %, flags, % of each label]], `gone` [place id], `edges`
[[a, b, clearance]], `cut` [[a, b]], `regions`, `objects` and `labels` (whole, absent where nothing changed), `path`
(how many points of the trajectory), `revision` and `seconds` since the first. Flags: 1 predicted, 2 a frontier.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from prior_sg.deploy.showing.material import Moment
from prior_sg.schemas.levels import LevelNode, nodes_above
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene

PREDICTED, FRONTIER = 1, 2


def steps_of(moments: Sequence[Moment], every: int = 1) -> Iterator[dict[str, Any]]:
    """One step per moment; with `every` above 1 only of places whose id it divides, and edges between them."""
    places, edges, others = dict[int, list[Any]](), dict[tuple[int, int], float](), dict[str, Any]()
    first_ns = moments[0].scene.stamp_ns
    for moment in moments:
        scene = moment.scene
        places_now, edges_now = _places(scene, every), _edges(scene, every)
        above = nodes_above(scene.nodes)
        now = {
            "regions": [_region(region, above.get(region.id, [])) for region in scene.regions],
            "objects": [_object(item) for item in scene.objects],
            "labels": list(scene.labels),
        }
        yield {
            "revision": moment.revision,
            "seconds": round((scene.stamp_ns - first_ns) / 1e9, 2),
            "path": len(scene.trajectory),
            "places": [row for place, row in places_now.items() if places.get(place) != row],
            "gone": [place for place in places if place not in places_now],
            "edges": [[*edge, width] for edge, width in edges_now.items() if edges.get(edge) != width],
            "cut": [[*edge] for edge in edges if edge not in edges_now],
            **{name: value for name, value in now.items() if others.get(name) != value},
        }
        places, edges, others = places_now, edges_now, now


def _places(scene: Scene, every: int) -> dict[int, list[Any]]:
    """Centimetres and whole percents: what the eye cannot tell apart makes no change."""
    flags = PREDICTED * np.isin(scene.place_ids, scene.predicted_ids).astype(int)
    flags += FRONTIER * np.isin(scene.place_ids, scene.frontier_ids).astype(int)
    columns = (
        np.round(scene.positions_m.astype(float), 2).tolist(),
        np.round(scene.radii_m.astype(float), 2).tolist(),
        scene.place_regions.tolist(),
        _percents(scene.unknown).tolist(),
        flags.tolist(),
        _percents(scene.posteriors).tolist(),
    )
    rows = zip(scene.place_ids.tolist(), *columns, strict=True)
    return {
        place: [place, *position_m, radius_m, region, unknown, flag, *(belief if any(belief) else ())]
        for place, position_m, radius_m, region, unknown, flag, belief in rows
        if place % every == 0
    }


def _percents(shares: np.ndarray) -> np.ndarray:
    return np.round(100 * np.nan_to_num(shares.astype(float))).astype(int)


def _edges(scene: Scene, every: int) -> dict[tuple[int, int], float]:
    rows = zip(scene.edges.tolist(), np.round(scene.clearances_m.astype(float), 2).tolist(), strict=True)
    return {(a, b): width for (a, b), width in rows if a % every == 0 and b % every == 0}


def _region(region: Region, above: list[LevelNode]) -> dict[str, Any]:
    x, y, _ = region.position_m
    return {
        "id": region.id,
        "label": region.label,
        "within": [f"{node.label} ({node.level} {node.id})" for node in above],
        "probability": round(region.probability, 3),
        "unknown": round(region.unknown, 3),
        "predicted": region.predicted,
        "area": round(region.area_m2, 2),
        "x": round(x, 2),
        "y": round(y, 2),
        "objects": list(region.object_ids),
        "ways": [[way.region, round(way.clearance_m, 3), way.door] for way in region.transitions],
    }


def _object(item: SceneObject) -> dict[str, Any]:
    (x0, y0, z0), (x1, y1, z1) = item.min_m, item.max_m
    return {
        "id": item.id,
        "label": item.label,
        "probability": round(item.probability, 3),
        "box": [round(edge, 2) for edge in (x0, y0, x1, y1, z0, z1)],
        "frames": item.frames,
    }
