"""One scene of several maps, with numbers that never change (pure)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.deploy.fleet.core.believing import CFG, Believed, believed
from prior_sg.deploy.fleet.core.fusing import Fused, Placed, fused, openings
from prior_sg.deploy.fleet.core.ids import Ids, Name, Sessions
from prior_sg.deploy.fleet.core.levels import Ground, Levels, ground_of
from prior_sg.deploy.fleet.core.marks import markers_of
from prior_sg.deploy.fleet.core.things import joined, things_of
from prior_sg.schemas.members import MapMember
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import transform
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.layers.storeys import split
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.regions import components

DOOR_CLEARANCE_M = 0.6  # widest of a door's ways
FOOTPRINT_CELL_M = 0.1
LEAST_MEMBER = 3  # places of a robot's region in a merged one, from which it is a member even where it mostly is not


class Source(NamedTuple):
    """One map, and how it lies in the fleet's frame."""

    name: Name
    scene: Scene
    fleet_from_own: np.ndarray  # (4, 4)
    frame_ids: Sequence[int] | None = None  # of the scene's trajectory; None = they count from 0


@dataclass
class Memory:
    """What the merged scene keeps from one state to the next."""

    ids: Ids = field(default_factory=Ids)
    region_of: dict[int, int] = field(default_factory=dict)  # by place, also of places that are gone for now
    next_region: int = 0
    frames: dict[tuple[Name, int], np.ndarray] = field(default_factory=dict)  # fleet_from_own (4, 4) of each map, by
    # the epoch of who writes its places: how maps lay when the fleet was followed last
    sessions: Sessions = field(default_factory=Sessions)
    levels: Levels = field(default_factory=Levels)


@dataclass(frozen=True)
class Merged:
    """The scene, and what its schema has no room for."""

    scene: Scene
    frame_ids: np.ndarray  # (frame,) of the scene's trajectory
    ground: Ground


def merged(robot: str, sources: Sequence[Source], memory: Memory) -> Merged:
    """The scene of all maps under one name. `memory` is brought up to date. Raises ValueError without any map."""
    maps = [
        Placed(name, scene, pose, memory.ids.of("place", name, scene.place_ids.tolist()))
        for name, scene, pose, _ in sources
    ]
    found = fused(maps)
    beliefs = believed(maps, found)
    ground = ground_of(found, beliefs.labels, all(len(one.scene.surface_ids) for one in maps))
    regions = _regions_of(ground, beliefs, memory)
    objects, members = _objects(maps, memory), _members(maps, found, regions)
    described = _described(found, beliefs, regions, objects, _parents(maps))
    nodes, directions, areas = openings(maps, found)
    frame_ids, cameras_m = _cameras(sources, memory)
    newest = max((one.scene for one in maps), key=lambda scene: scene.stamp_ns)
    aimed = next((one.scene for one in maps if one.scene.prior_digest), newest)
    scene = Scene(
        robot=robot,
        stamp_ns=newest.stamp_ns,
        environment=_told_by(maps, lambda scene: scene.environment),
        task=_told_by(maps, lambda scene: scene.task),
        prior_digest=aimed.prior_digest,
        space=aimed.space,
        labels=beliefs.names,
        regions=[msgspec.structs.replace(region, members=members[region.id]) for region in described],
        place_ids=found.ids,
        positions_m=found.positions_m.astype(np.float32),
        radii_m=found.radii_m.astype(np.float32),
        basis_points=found.basis_points.astype(np.int16),
        place_regions=regions,
        posteriors=beliefs.posteriors.astype(np.float16),
        unknown=beliefs.unknown.astype(np.float16),
        edges=found.ids[found.edges].reshape(-1, 2),
        clearances_m=found.clearances_m.astype(np.float32),
        trajectory=cameras_m.astype(np.float32),
        predicted_ids=found.ids[beliefs.predicted],
        objects=objects,
        frontier_ids=found.ids[nodes],
        frontier_directions=directions.astype(np.float32),
        frontier_areas_m2=areas.astype(np.float32),
        origin_m=maps[0].scene.origin_m,
        markers=markers_of(maps),
    )
    return Merged(scene, frame_ids, ground)


def _told_by(maps: Sequence[Placed], said: Callable[[Scene], str]) -> str:
    """What the robots say of themselves, each by the first of its maps that says anything: once where they agree, else
    with the robots' names."""
    words: dict[str, str] = {}
    for one in maps:
        if told := said(one.scene):
            words.setdefault(one.name.robot, told)
    if len({*words.values()}) < 2:
        return next(iter(words.values()), "")
    saying = {told: [robot for robot in words if words[robot] == told] for told in words.values()}
    return "; ".join(f"{told} ({', '.join(robots)})" for told, robots in saying.items())


def levelled(found: Merged, memory: Memory, prior: Prior | None) -> Merged:
    """The same with levels above its regions, those that this prior names among them."""
    return replace(found, scene=memory.levels.renew(found.scene, found.ground, prior))


def _cameras(sources: Sequence[Source], memory: Memory) -> tuple[np.ndarray, np.ndarray]:
    """The fleet's numbers (frame,) of all keyframes, ascending, and where they were taken (frame, 3)."""
    numbers, cameras_m = [], []
    for name, scene, pose, frame_ids in sources:
        own = range(len(scene.trajectory)) if frame_ids is None else frame_ids
        numbers.append(memory.ids.of("frame", name, own))
        cameras_m.append(transform(pose, scene.trajectory.astype(float)))
    every, where_m = np.concatenate(numbers), np.concatenate(cameras_m)
    order = np.argsort(every)
    return every[order], where_m[order]


def _regions_of(ground: Ground, beliefs: Believed, memory: Memory) -> np.ndarray:
    """Region (node,) of each node: connected nodes of one label and storey, under the id that most of them had."""
    labelled, graph = ground.rows, ground.graph
    component = components.numbered(beliefs.labels[labelled], graph.edges)
    component = split(component, graph.edges, ground.storeys, CFG.layers.storeys)
    previous = np.array([memory.region_of.get(number, NO_REGION) for number in graph.ids.tolist()], np.int64)
    regions = np.full(len(beliefs.labels), NO_REGION, np.int64)
    if len(labelled):
        regions[labelled], memory.next_region = components.track(component, previous, memory.next_region)
    memory.region_of.update(zip(graph.ids.tolist(), regions[labelled].tolist(), strict=True))
    return regions


def _described(
    found: Fused, beliefs: Believed, regions: np.ndarray, objects: list[SceneObject], parents: dict[str, str]
) -> list[Region]:
    graph = ReceivedGraph(found.ids, found.positions_m, found.radii_m, found.edges, found.clearances_m)
    ids = [region for region in np.unique(regions).tolist() if region != NO_REGION]
    labelled = regions != NO_REGION
    whole = np.where(labelled, regions, max(ids, default=0) + 1)  # places without a region are one of their own
    border = components.border(graph, whole, set(ids), DOOR_CLEARANCE_M)
    spots_m = np.array([item.position_m for item in objects]).reshape(-1, 3)
    view = ObjectView(np.array([item.id for item in objects], np.int64), spots_m, np.zeros((len(objects), 0)))
    standing = components.members(view, found.positions_m, whole, np.flatnonzero(labelled))
    described = []
    for number in ids:
        rows = np.flatnonzero(regions == number)
        label = int(beliefs.labels[rows[0]])
        x, y, z = found.positions_m[rows].mean(axis=0).tolist()
        known = set(ids)
        described.append(
            Region(
                id=number,
                label=beliefs.names[label],
                place_count=len(rows),
                probability=round(float(beliefs.posteriors[rows, label].mean()), 2),
                position_m=(round(x, 2), round(y, 2), round(z, 2)),
                area_m2=round(
                    components.footprint_m2(found.positions_m[rows], found.radii_m[rows], FOOTPRINT_CELL_M), 2
                ),
                unknown=round(float(beliefs.unknown[rows].mean()), 2),
                predicted=bool(beliefs.predicted[rows].mean() > 0.5),
                hull_m=components.hull_m(found.positions_m[rows], found.radii_m[rows]),
                neighbour_ids=[other for other in border.neighbours.get(number, []) if other in known],
                transitions=[way for way in border.transitions.get(number, []) if way.region in known],
                object_ids=standing.get(number, []),
                parent=parents.get(beliefs.names[label], ""),
            )
        )
    return described


def _parents(maps: Sequence[Placed]) -> dict[str, str]:
    """The zone above each label, as the robots' priors name it."""
    return {region.label: region.parent for one in reversed(maps) for region in one.scene.regions if region.parent}


def _objects(maps: Sequence[Placed], memory: Memory) -> list[SceneObject]:
    ids = [memory.ids.of("object", one.name, [item.id for item in one.scene.objects]) for one in maps]
    items = []
    for things in things_of(maps, ids):
        members = _sorted([(*maps[thing.map].name, thing.number) for thing in things])
        items.append(msgspec.structs.replace(joined(things), members=members))
    return sorted(items, key=lambda item: item.id)


def _members(maps: Sequence[Placed], found: Fused, regions: np.ndarray) -> dict[int, list[MapMember]]:
    """The robots' regions in each merged one: each has one at least, and each robot's region is in one at least."""
    pairs, counts, owners = [], [], []
    for number, (one, nodes) in enumerate(zip(maps, found.node_of, strict=True)):
        own = np.column_stack((regions[nodes], one.scene.place_regions))
        rows, places = np.unique(own[(own != NO_REGION).all(axis=1)], axis=0, return_counts=True)
        pairs.append(rows)
        counts.append(places)
        owners.append(np.full(len(rows), number))
    (merged_ids, own_ids), places, owner = np.concatenate(pairs).T, np.concatenate(counts), np.concatenate(owners)
    listed: dict[int, list[tuple[str, int, int]]] = {}
    kept = (places >= LEAST_MEMBER) | _most(merged_ids[:, None], places)
    kept |= _most(np.column_stack((owner, own_ids)), places)
    for at in np.flatnonzero(kept).tolist():
        listed.setdefault(int(merged_ids[at]), []).append((*maps[owner[at]].name, int(own_ids[at])))
    return {region: _sorted(members) for region, members in listed.items()}


def _most(keys: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Mask (row,) of the first row that has the highest count among those of its key (row, k)."""
    order = np.lexsort((-counts, *keys.T))
    _, first = np.unique(keys[order], axis=0, return_index=True)
    found = np.zeros(len(counts), bool)
    found[order[first]] = True
    return found


def _sorted(members: list[tuple[str, int, int]]) -> list[MapMember]:
    """By robot, session and number, so that what has not changed is not told again."""
    return [MapMember(robot=robot, session=session, id=number) for robot, session, number in sorted(members)]
