"""Two rooms and a doorway, as scenes."""

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.evaluation.printed import on_wall
from prior_sg.schemas.foresight import Foresight, Opening
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.levels import LevelName, LevelNode
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import quaternion_of

LABELS = ["bedroom", "kitchen"]


def home(**changes: object) -> Scene:
    """A kitchen (x in 0..4) and a bedroom (x in 5..8) beside each other on one floor, a row of places in each."""
    kitchen = [(x, y, 1.0) for x in (1.0, 2.0, 3.0) for y in (1.0, 2.0)]
    bedroom = [(x, y, 1.0) for x in (5.5, 6.5) for y in (1.0, 2.0)]
    positions_m = np.array(kitchen + bedroom, np.float32)
    count, first = len(positions_m), len(kitchen)
    posteriors = np.zeros((count, 2), np.float16)
    posteriors[:first], posteriors[first:] = (0.1, 0.9), (0.7, 0.3)
    scene = Scene(
        robot="robot1",
        stamp_ns=10**9,
        environment="residential home",
        task="serve drinks",
        prior_digest="",
        space="",
        labels=LABELS,
        regions=[
            region(3, "kitchen", 0.9, (2.0, 1.5, 1.0), object_ids=[1]),
            region(7, "bedroom", 0.7, (6.0, 1.5, 1.0), object_ids=[2]),
        ],
        place_ids=np.arange(10, 10 + count),
        positions_m=positions_m,
        radii_m=np.full(count, 1.0, np.float32),
        basis_points=np.full(count, 3, np.int16),
        place_regions=np.array([3] * first + [7] * (count - first)),
        posteriors=posteriors,
        unknown=np.zeros(count, np.float16),
        edges=np.array([(10, 11), (11, 12), (15, 16)]),
        clearances_m=np.array([0.5, 0.5, 0.4], np.float32),
        trajectory=np.array([(0.5, 1, 1.2), (3, 1, 1.2), (6, 1, 1.2)], np.float32),
        objects=[thing(1, "stove", (1.0, 0.2)), thing(2, "bed", (6.5, 2.0)), thing(4, "", (3.0, 2.0))],
        frontier_ids=np.array([13]),
        frontier_directions=np.array([(0, 1, 0)], np.float32),
        frontier_areas_m2=np.array([1.0], np.float32),
    )
    return msgspec.structs.replace(scene, **changes)


def joined_home(**changes: object) -> Scene:
    """One can go along y = 1 from the kitchen through to the bedroom, but nowhere else."""
    edges, clearances_m = np.array([(10, 12), (12, 14), (14, 16), (16, 18)]), np.array([0.5, 0.5, 0.3, 0.5], np.float32)
    return home(edges=edges, clearances_m=clearances_m, **changes)


def printed(number: int, at_m: tuple, along_m: tuple, **changes: object) -> SceneMarker:
    """A marker that hangs upright on a wall and looks along a level direction."""
    x, y, z, w = quaternion_of(on_wall(np.array(at_m), np.array(along_m))).tolist()
    fields = {"dictionary": "apriltag_36h11", "size_m": 0.16, "frames": 5, "quaternion_xyzw": (x, y, z, w)}
    return SceneMarker(id=number, position_m=at_m, **(fields | changes))


def marked_home(**changes: object) -> Scene:
    """Marker 7 hangs in the kitchen on the wall to the bedroom, whose places are nearer but behind it; marker 9 has
    been seen in two places."""
    doubt = "it has been seen at 2 spots, up to 4.0 m from each other"
    markers = [
        printed(7, (4.45, 1.0, 1.5), (-1.0, 0.0, 0.0)),
        printed(9, (8.0, 1.0, 1.5), (-1.0, 0.0, 0.0), doubt=doubt),
    ]
    return joined_home(markers=markers, **changes)


def region(number: int, label: str, probability: float, position_m: tuple, **more: object) -> Region:
    return Region(
        id=number, label=label, place_count=4, probability=probability, position_m=position_m, area_m2=9.0, **more
    )


def thing(number: int, label: str, at_m: tuple[float, float]) -> SceneObject:
    (x, y), half = at_m, 0.3
    return SceneObject(
        id=number,
        label=label,
        probability=0.8,
        known=0.9,
        position_m=(x, y, 0.3),
        min_m=(x - half, y - half, 0.0),
        max_m=(x + half, y + half, 0.6),
        frames=3,
    )


def keyframe() -> Keyframe:
    """A camera at (1, 1, 1.2) m that looks along x at a wall two metres away, red on the left, blue on the right."""
    color = np.zeros((48, 64, 3), np.uint8)
    color[:, :32], color[:, 32:] = (0, 0, 255), (255, 0, 0)  # as OpenCV orders it
    pose = np.eye(4)
    pose[:3, :3] = np.array([(0, 0, 1), (-1, 0, 0), (0, -1, 0)])
    pose[:3, 3] = (1.0, 1.0, 1.2)
    return Keyframe(
        robot="robot1",
        frame_id=0,
        stamp_ns=10**9,
        intrinsics=Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5),
        world_from_camera=pose,
        color=cv2.imencode(".png", color)[1].tobytes(),
        depth=cv2.imencode(".png", np.full((48, 64), 2000, np.uint16))[1].tobytes(),
        depth_scale_m=0.001,
    )


UP_M = 3.0


def _node(level: LevelName, number: int, members: list[int], of: str = "region", height_m: float = 0.0) -> LevelNode:
    return LevelNode(
        level=level,
        id=number,
        label=f"{level} {number}",
        probability=1.0,
        member_ids=members,
        members=of,
        area_m2=9.0,
        position_m=(0.0, 0.0, height_m),
    )


def two_floors() -> Scene:
    """The home once more above itself, with a bed upstairs, a table downstairs and an opening on either floor."""
    below = joined_home()
    ids, regions = [region.id for region in below.regions], below.regions
    most = max(*ids, int(below.place_ids.max())) + 1
    up = [msgspec.structs.replace(one, id=one.id + most) for one in regions]
    raised = below.positions_m + np.array((0, 0, UP_M), np.float32)
    openings = [
        Opening(
            place_id=place, position_m=(0.0, 0.0, 0.0), beyond_m=(1.0, 0.0, 0.0), width_m=1.0, region=ids[0], same=1.0
        )
        for place in (int(below.place_ids[0]), int(below.place_ids[0]) + most)
    ]
    table, bed = thing(1, "table", (1.0, 1.0)), thing(2, "bed", (6.0, 1.0))
    bed = msgspec.structs.replace(bed, position_m=(6.0, 1.0, 0.5 + UP_M))
    return msgspec.structs.replace(
        below,
        regions=[*regions, *up],
        place_ids=np.concatenate((below.place_ids, below.place_ids + most)),
        positions_m=np.concatenate((below.positions_m, raised)),
        radii_m=np.tile(below.radii_m, 2),
        basis_points=np.tile(below.basis_points, 2),
        place_regions=np.concatenate((below.place_regions, below.place_regions + most)),
        posteriors=np.tile(below.posteriors, (2, 1)),
        unknown=np.tile(below.unknown, 2),
        edges=np.concatenate((below.edges, below.edges + most)),
        clearances_m=np.tile(below.clearances_m, 2),
        objects=[table, bed],
        trajectory=np.array([(1, 1, 1), (1, 1, 1 + UP_M), (2, 1, 1 + UP_M)], np.float32),
        foresight=Foresight(openings=openings),
        nodes=[
            _node("zone", 5, [up[0].id]),
            _node("floor", 1, [one.id for one in up], height_m=UP_M),
            _node("floor", 4, ids),
            _node("building", 0, [1, 4], of="floor"),
        ],
    )
