"""`prior-sg bench queries`: how long each kind of question takes, over a synthetic scene.

The scene is a floor of square rooms with a door to each neighbour, places on a jittered grid within them, and objects
that stand anywhere. Times are of the answer alone, without a bus, once what the index keeps for a revision is there;
what making that takes is measured apart.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from prior_sg.schemas.codec import encode
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.queries import (
    AnswersTo,
    BeliefsOf,
    ById,
    ByLabel,
    InBox,
    InRadius,
    MarkersOf,
    Nearest,
    NeighboursOf,
    NodesOf,
    ObjectsInRegions,
    Question,
    RouteBetween,
    SceneQuery,
    Spot,
    WhatIsMissing,
    WhereToLook,
    WordsInUse,
)
from prior_sg.schemas.regions import Region, Transition
from prior_sg.schemas.scene import Scene
from prior_sg.services.scene_store.core.queries.answering import answer, reply
from prior_sg.services.scene_store.core.queries.changes import difference
from prior_sg.services.scene_store.core.queries.index import Index

SIZES = (10_000, 100_000)
OBJECTS = 10_000
REPEATS = 100
PER_ROOM = 15  # places along each side of a room
SPACING_M = 0.5
JITTER_M = 0.1
MARKERS = 8
LABELS = [f"room kind {number}" for number in range(20)]
KINDS = [f"object kind {number}" for number in range(100)]


def query_bench(sizes: tuple[int, ...] = SIZES, objects: int = OBJECTS, repeats: int = REPEATS) -> tuple[dict, dict]:
    """All figures and the settings."""
    metrics: dict[str, Any] = {}
    for size in sizes:
        scene = synthetic_scene(size, objects)
        rng = np.random.default_rng(size)
        for name, figures in (_building(scene) | _asking(scene, rng, repeats)).items():
            metrics[f"{name}_{size}"] = figures
    return metrics, {"places": list(sizes), "objects": objects, "questions_of_each_kind": repeats}


def _building(scene: Scene) -> dict[str, float]:
    """What an index makes once for a revision."""
    index = Index(scene)
    parts: dict[str, Callable[[], Any]] = {
        "tree": lambda: index.tree,
        "edges": lambda: index.edges_of(0),
        "ways": lambda: index.ways(0.0),
    }
    return {f"build_{name}_ms": _timed(make)[0] for name, make in parts.items()}


def _asking(scene: Scene, rng: np.random.Generator, repeats: int) -> dict[str, float]:
    """p50 and p99 of each kind of question, and of a whole message's bytes for one of them."""
    index, older = Index(scene), Index(changed(scene, rng))
    found: dict[str, float] = {}
    for name, questions in kinds_of_questions(scene, rng, repeats).items():
        first = next(questions)
        answer(index, first)
        spent = [_timed(partial(answer, index, one))[0] for one in questions]
        found |= _percentiles(name, spent)
    found |= _percentiles("changed_since", [_timed(lambda: difference(older, index))[0] for _ in range(10)])
    query = SceneQuery(robot="bench", questions=[Nearest(point_m=(1.0, 1.0, 1.0), limit=10)])
    found |= _percentiles("message", [_timed(lambda: encode(reply(index, query)))[0] for _ in range(repeats)])
    return found


def kinds_of_questions(scene: Scene, rng: np.random.Generator, count: int) -> dict[str, Iterator[Question]]:
    """`count` + 1 random questions of each kind."""
    low, high = scene.positions_m.min(axis=0), scene.positions_m.max(axis=0)

    def point() -> tuple[float, float, float]:
        x, y, z = rng.uniform(low, high).tolist()
        return x, y, z

    def corner(point_m: tuple[float, float, float], by_m: float) -> tuple[float, float, float]:
        x, y, z = point_m
        return x + by_m, y + by_m, z + by_m

    def some(ids: list[int]) -> int:
        return ids[int(rng.integers(len(ids)))]

    places, regions = scene.place_ids.tolist(), [region.id for region in scene.regions]
    one_of_each: dict[str, Callable[[], Question]] = {
        "by_id": lambda: ById(what="place", id=some(places)),
        "by_label": lambda: ByLabel(label=LABELS[int(rng.integers(len(LABELS)))]),
        "in_box": lambda: InBox(min_m=(middle := point()), max_m=corner(middle, 5.0), what="place"),
        "in_radius": lambda: InRadius(point_m=point(), radius_m=3.0, what="place"),
        "nearest_place": lambda: Nearest(point_m=point(), what="place", limit=10),
        "nearest_region": lambda: Nearest(point_m=point(), what="region", limit=3),
        "nearest_object": lambda: Nearest(point_m=point(), label=KINDS[int(rng.integers(len(KINDS)))], limit=3),
        "neighbours_of": lambda: NeighboursOf(what="region", id=some(regions)),
        "objects_in_regions": lambda: ObjectsInRegions(object_label=KINDS[3], region_label=LABELS[2]),
        "route_near": lambda: RouteBetween(start=Spot(point_m=(at := point())), goal=Spot(point_m=corner(at, 5.0))),
        "route_far": lambda: RouteBetween(start=Spot(point_m=point()), goal=Spot(point_m=point())),
        "beliefs_of": lambda: BeliefsOf(region=some(regions)),
        "words_in_use": WordsInUse,
        "answers_to": lambda: AnswersTo(text="t", regions={LABELS[1]: 0.5}, objects={KINDS[1]: 0.5}),
        "markers_of": MarkersOf,
        "nodes_of": lambda: NodesOf(region=some(regions)),
        "where_to_look": lambda: WhereToLook(label=LABELS[1], start=Spot(point_m=point())),
        "what_is_missing": WhatIsMissing,
    }
    return {name: iter([make() for _ in range(count + 1)]) for name, make in one_of_each.items()}


def synthetic_scene(places: int, objects: int, seed: int = 0) -> Scene:
    """A floor of rooms; the same for the same numbers."""
    rng = np.random.default_rng([places, objects, seed])
    side = max(2, int(np.ceil(np.sqrt(places))))
    column, row = np.arange(places) % side, np.arange(places) // side
    level_m = 1.0 + 0.2 * rng.random(places)
    positions = np.column_stack((SPACING_M * column, SPACING_M * row, level_m))
    positions[:, :2] += rng.uniform(-JITTER_M, JITTER_M, (places, 2))
    rooms = -(-side // PER_ROOM)
    room = (column // PER_ROOM) + rooms * (row // PER_ROOM)
    edges = _edges(places, side, column, row)
    posteriors = np.full((places, len(LABELS)), 0.01)
    posteriors[np.arange(places), room % len(LABELS)] = 1 - 0.01 * (len(LABELS) - 1)
    found = _objects(objects, positions, rng)
    held = _held(found, positions, room)
    return Scene(
        robot="bench",
        stamp_ns=1,
        environment="synthetic",
        task="bench",
        prior_digest="",
        space="",
        labels=LABELS,
        regions=[_region(number, positions, room, held, edges) for number in np.unique(room).tolist()],
        place_ids=np.arange(places) + 1,
        positions_m=positions.astype(np.float32),
        radii_m=rng.uniform(0.2, 0.6, places).astype(np.float32),
        basis_points=np.full(places, 3, np.int16),
        place_regions=room + 1,
        posteriors=posteriors.astype(np.float16),
        unknown=rng.uniform(0, 0.3, places).astype(np.float16),
        edges=edges + 1,
        clearances_m=rng.uniform(0.15, 0.6, len(edges)).astype(np.float32),
        trajectory=np.zeros((0, 3), np.float32),
        objects=found,
        markers=_markers(positions),
    )


def _markers(positions: np.ndarray) -> list[SceneMarker]:
    """Some, evenly over the places (place, 3), that look along x."""
    spots = positions[:: -(-len(positions) // MARKERS)].tolist()
    upright = (0.5, 0.5, 0.5, 0.5)
    return [
        SceneMarker(
            dictionary="apriltag_36h11",
            id=number,
            size_m=0.16,
            position_m=(x, y, z),
            quaternion_xyzw=upright,
            frames=3,
        )
        for number, (x, y, z) in enumerate(spots)
    ]


def _edges(places: int, side: int, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Rows (edge, 2) of neighbours on the grid; between two rooms only where a door is."""
    here = np.arange(places)
    east = np.column_stack((here, here + 1))[(column < side - 1) & (here + 1 < places)]
    north = np.column_stack((here, here + side))[here + side < places]
    doors = [
        ((across[east_side[:, 0]] + 1) % PER_ROOM != 0) | (along[east_side[:, 0]] % PER_ROOM == PER_ROOM // 2)
        for east_side, across, along in ((east, column, row), (north, row, column))
    ]
    return np.concatenate((east[doors[0]], north[doors[1]]))


def _objects(count: int, positions: np.ndarray, rng: np.random.Generator) -> list[SceneObject]:
    low, high = positions.min(axis=0), positions.max(axis=0)
    middles, sizes = rng.uniform(low, high, (count, 3)), rng.uniform(0.1, 1.0, (count, 3))
    return [
        SceneObject(
            id=number + 1,
            label=KINDS[number % len(KINDS)],
            probability=float(rng.uniform(0.4, 1.0)),
            known=float(rng.uniform(0.5, 1.0)),
            position_m=tuple(middle.tolist()),
            min_m=tuple((middle - size / 2).tolist()),
            max_m=tuple((middle + size / 2).tolist()),
            frames=3,
        )
        for number, (middle, size) in enumerate(zip(middles, sizes, strict=True))
    ]


def _held(found: list[SceneObject], positions: np.ndarray, room: np.ndarray) -> dict[int, list[int]]:
    """Ids of objects by the room of the nearest place."""
    from scipy.spatial import cKDTree

    nearest = cKDTree(positions).query(np.array([item.position_m for item in found]).reshape(-1, 3))[1]
    held: dict[int, list[int]] = {}
    for item, place in zip(found, nearest.tolist(), strict=True):
        held.setdefault(int(room[place]), []).append(item.id)
    return held


def _region(
    number: int, positions: np.ndarray, room: np.ndarray, held: dict[int, list[int]], edges: np.ndarray
) -> Region:
    members = np.flatnonzero(room == number)
    crossing = edges[(room[edges] == number).sum(axis=1) == 1]
    ways = []
    for a, b in crossing.tolist():
        inside, outside = (a, b) if room[a] == number else (b, a)
        ways.append(
            Transition(
                region=int(room[outside]) + 1,
                edge=(inside + 1, outside + 1),
                position_m=tuple(((positions[a] + positions[b]) / 2).tolist()),
                clearance_m=0.4,
                door=True,
            )
        )
    return Region(
        id=number + 1,
        label=LABELS[number % len(LABELS)],
        place_count=len(members),
        probability=0.8,
        position_m=tuple(positions[members].mean(axis=0).tolist()),
        area_m2=len(members) * SPACING_M**2,
        neighbour_ids=sorted({way.region for way in ways}),
        transitions=ways,
        object_ids=held.get(number, []),
    )


def changed(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene before its last tenth of places, with other labels of a tenth of its regions."""
    import msgspec

    kept = len(scene.place_ids) * 9 // 10
    per_place = ("place_ids", "positions_m", "radii_m", "basis_points", "place_regions", "posteriors", "unknown")
    edges = (scene.edges <= scene.place_ids[kept - 1]).all(axis=1)
    other = rng.permutation(len(scene.regions)) <= len(scene.regions) // 10
    regions = [
        msgspec.structs.replace(region, label=LABELS[0]) if new else region
        for region, new in zip(scene.regions, other.tolist(), strict=True)
    ]
    columns = {name: getattr(scene, name)[:kept] for name in per_place}
    return msgspec.structs.replace(
        scene, regions=regions, edges=scene.edges[edges], clearances_m=scene.clearances_m[edges], **columns
    )


def _timed(make: Callable[[], Any]) -> tuple[float, Any]:
    """Milliseconds, and what came of it."""
    started_s = time.perf_counter()
    made = make()
    return 1e3 * (time.perf_counter() - started_s), made


def _percentiles(name: str, spent: list[float]) -> dict[str, float]:
    return {f"{name}_ms_p50": float(np.percentile(spent, 50)), f"{name}_ms_p99": float(np.percentile(spent, 99))}
