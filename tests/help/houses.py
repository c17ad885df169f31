"""Small houses as maps: rectangles with doors, places whose radius is the distance to the walls, and objects."""

import msgspec
import numpy as np

from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import Region, RegionDelta
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import quaternion_of, transform

# label, x0, y0, x1, y1
ROOMS = [
    ("kitchen", 0.0, 0.0, 3.0, 4.0),
    ("living room", 3.0, 0.0, 8.0, 4.0),
    ("hallway", 0.0, 4.0, 8.0, 5.5),
    ("bedroom", 0.0, 5.5, 4.5, 9.0),
    ("bathroom", 4.5, 5.5, 8.0, 9.0),
]
DOORS = [(1.0, 4.0), (6.0, 4.0), (2.0, 5.5), (6.5, 5.5)]  # in walls along x
THINGS = [
    ("stove", 0.4, 0.5),
    ("refrigerator", 0.4, 2.5),
    ("table", 1.8, 1.2),
    ("sofa", 7.3, 1.0),
    ("television", 3.5, 1.4),
    ("plant", 7.5, 3.6),
    ("shelf", 3.4, 4.5),
    ("bed", 1.2, 8.0),
    ("wardrobe", 4.0, 7.0),
    ("toilet", 7.6, 8.5),
    ("sink", 5.2, 8.6),
    ("shower", 7.4, 6.2),
]
STEP_M = 0.5
DOOR_M = 0.4  # half its width
LABELS = sorted({room[0] for room in ROOMS})
STOREY_M = 3.0


def places(rooms=ROOMS, step_m=STEP_M, offset_m=0.0):
    """Positions (n, 3), radii, room numbers, and edges of a grid in each room, with a place in each doorway."""
    spots, radii, owners = [], [], []
    for number, (_, x0, y0, x1, y1) in enumerate(rooms):
        for x in np.arange(x0 + 0.4 + offset_m, x1 - 0.3, step_m):
            for y in np.arange(y0 + 0.4 + offset_m, y1 - 0.3, step_m):
                spots.append((x, y, 1.0))
                radii.append(min(x - x0, x1 - x, y - y0, y1 - y))
                owners.append(number)
    here = [index for index, room in enumerate(rooms)]
    for x, y in DOORS:
        sides = [n for n in here if rooms[n][1] <= x <= rooms[n][3] and rooms[n][2] <= y <= rooms[n][4]]
        if len(sides) == 2:
            spots.append((x, y, 1.0))
            radii.append(DOOR_M)
            owners.append(sides[0])
    spots, radii, owners = np.array(spots), np.array(radii), np.array(owners)
    first, second = np.triu_indices(len(spots), 1)
    near = np.linalg.norm(spots[first] - spots[second], axis=1) < 1.1 * step_m * 2**0.5
    door = np.isin(spots[:, 1], [y for _, y in DOORS])
    same = (owners[first] == owners[second]) | door[first] | door[second]
    edges = np.stack((first, second), axis=1)[near & same]
    return spots, radii, owners, edges


def marker(number, world_from_marker, doubt=""):
    """A printed marker as a map has it."""
    x, y, z = world_from_marker[:3, 3].tolist()
    quaternion_xyzw = tuple(quaternion_of(world_from_marker).tolist())
    fields = {"position_m": (x, y, z), "quaternion_xyzw": quaternion_xyzw, "frames": 4, "doubt": doubt}
    return SceneMarker(dictionary="apriltag_36h11", id=number, size_m=0.2, **fields)


def scene(
    robot="r1",
    own_from_world=None,
    *,
    rooms=ROOMS,
    things=THINGS,
    offset_m=0.0,
    noise_m=0.0,
    seed=0,
    wrong=(),
    markers=(),
):
    """A map of some rooms, in a frame of its own; `wrong` numbers objects whose name is another's; `markers` are
    numbers and poses in the world."""
    pose = np.eye(4) if own_from_world is None else own_from_world
    rng = np.random.default_rng(seed)
    spots, radii, owners, edges = places(rooms, offset_m=offset_m)
    posteriors = np.full((len(spots), len(LABELS)), 0.02, np.float16)
    for row, owner in enumerate(owners.tolist()):
        posteriors[row, LABELS.index(rooms[owner][0])] = 0.9
    seen = [thing for thing in things if any(r[1] <= thing[1] <= r[3] and r[2] <= thing[2] <= r[4] for r in rooms)]
    objects = []
    for number, (label, x, y) in enumerate(seen):
        at = transform(pose, np.array([[x, y, 0.5]]))[0] + rng.normal(0, noise_m, 3)
        name = seen[(number + 1) % len(seen)][0] if number in wrong else label
        objects.append(
            SceneObject(
                id=number,
                label=name,
                probability=0.8,
                known=0.9,
                position_m=tuple(at.tolist()),
                min_m=tuple((at - 0.3).tolist()),
                max_m=tuple((at + 0.3).tolist()),
                frames=3,
            )
        )
    positions_m = transform(pose, spots) + rng.normal(0, noise_m, spots.shape)
    regions = [
        Region(
            id=number,
            label=room[0],
            place_count=int((owners == number).sum()),
            probability=0.9,
            position_m=tuple(positions_m[owners == number].mean(axis=0).tolist()),
            area_m2=1.0,
        )
        for number, room in enumerate(rooms)
    ]
    return Scene(
        robot=robot,
        stamp_ns=1,
        environment="home",
        task="tidy up",
        prior_digest="d",
        space="s",
        labels=LABELS,
        regions=regions,
        place_ids=np.arange(len(spots)),
        positions_m=positions_m.astype(np.float32),
        radii_m=radii.astype(np.float32),
        basis_points=np.full(len(spots), 2, np.int16),
        place_regions=owners.astype(np.int64),
        posteriors=posteriors,
        unknown=np.full(len(spots), 0.1, np.float16),
        edges=edges.astype(np.int64),
        clearances_m=np.minimum(*radii[edges].T).astype(np.float32) if len(edges) else np.zeros(0, np.float32),
        trajectory=positions_m[:1].astype(np.float32),
        objects=objects,
        markers=[marker(number, pose @ world_from_marker) for number, world_from_marker in markers],
    )


def tall(robot="r1", own_from_world=None, *, below=ROOMS, above=ROOMS):
    """A map of two storeys of such rooms, their hallways joined: rooms above have the numbers after those below."""
    pose = np.eye(4) if own_from_world is None else own_from_world
    storeys, regions, places, hallways = [], 0, 0, []
    for number, rooms in enumerate((below, above)):
        if not rooms:
            continue
        one = scene(robot, rooms=rooms, things=[])
        radii_m = np.minimum(one.radii_m, 0.4 * STOREY_M)
        spots = one.positions_m.astype(float)
        spots[:, 2] = number * STOREY_M + radii_m  # each place's free space ends at the floor
        hallways += [int(p) + places for p in one.place_ids if rooms[one.place_regions[p]][0] == "hallway"][:1]
        storeys.append(
            msgspec.structs.replace(
                one,
                place_ids=one.place_ids + places,
                positions_m=transform(pose, spots).astype(np.float32),
                radii_m=radii_m,
                place_regions=one.place_regions + regions,
                edges=one.edges + places,
                regions=[msgspec.structs.replace(region, id=region.id + regions) for region in one.regions],
            )
        )
        regions, places = regions + len(rooms), places + len(spots)
    stairs = np.array([hallways] if len(hallways) == 2 else [], np.int64).reshape(-1, 2)
    columns = ("place_ids", "positions_m", "radii_m", "basis_points", "place_regions", "posteriors", "unknown")
    return msgspec.structs.replace(
        storeys[0],
        regions=[region for one in storeys for region in one.regions],
        edges=np.concatenate([*(one.edges for one in storeys), stairs]),
        clearances_m=np.concatenate([*(one.clearances_m for one in storeys), np.full(len(stairs), DOOR_M, np.float32)]),
        **{name: np.concatenate([getattr(one, name) for one in storeys]) for name in columns},
    )


def deltas(held, epoch=1):
    """A scene as its robot tells it: places, regions, objects."""
    none = np.zeros(0, np.int64)
    yield PlaceDelta(
        robot=held.robot,
        epoch=epoch,
        revision=0,
        stamp_ns=held.stamp_ns,
        frame_id=0,
        snapshot=True,
        place_ids=held.place_ids,
        positions_m=held.positions_m,
        radii_m=held.radii_m,
        basis_points=held.basis_points,
        removed_ids=none,
        merged_ids=none.reshape(0, 2),
        edges=held.edges,
        clearances_m=held.clearances_m,
        removed_edges=none.reshape(0, 2),
        camera_m=tuple(held.trajectory[0].tolist()),
        frontier_ids=held.frontier_ids,
        frontier_directions=held.frontier_directions,
        frontier_areas_m2=held.frontier_areas_m2,
    )
    yield RegionDelta(
        robot=held.robot,
        epoch=epoch,
        revision=0,
        stamp_ns=held.stamp_ns,
        prior_digest=held.prior_digest,
        environment=held.environment,
        task=held.task,
        space=held.space,
        snapshot=True,
        labels=held.labels,
        regions=held.regions,
        nodes=held.nodes,
        removed_ids=none,
        place_ids=held.place_ids,
        place_regions=held.place_regions,
        posteriors=held.posteriors,
        unknown=held.unknown,
        removed_place_ids=none,
        energy=0.0,
    )
    yield ObjectDelta(
        robot=held.robot,
        epoch=epoch,
        revision=0,
        stamp_ns=held.stamp_ns,
        prior_digest=held.prior_digest,
        snapshot=True,
        objects=held.objects,
        removed_ids=none,
        markers=held.markers,
    )
