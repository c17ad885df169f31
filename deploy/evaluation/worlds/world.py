"""Worlds without number: from a kind and a seed to a floor plan with its ground truth, a walk, and depth images.

A plan is drawn, turned, filled into voxels, and walked through. Draws in which a region cannot be reached are thrown
away for the next one of the same seed, so that (kind, seed, walk) always gives the same world.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from prior_sg.deploy.evaluation.worlds.kinds import KINDS
from prior_sg.deploy.evaluation.worlds.plan import Box, Plan, Unbuildable
from prior_sg.deploy.evaluation.worlds.rays import cast, fill
from prior_sg.deploy.evaluation.worlds.turning import turned
from prior_sg.deploy.evaluation.worlds.walk import Manner, walked
from prior_sg.deploy.evaluation.worlds.ways import ways_of
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.frames import Intrinsics

CAMERA = Intrinsics(width_px=160, height_px=120, fx_px=80.0, fy_px=80.0, cx_px=79.5, cy_px=59.5)  # 90 by 74 degrees
DRAWS = 50  # until a plan can be walked
MARGIN_M = 0.5  # of nothing around the boxes
NOISE_M, NOISE_PER_M = 0.002, 0.0012  # standard deviation of depth z: NOISE_M + NOISE_PER_M z^2
DROPPED = 0.01  # share of pixels that measure nothing
GRAZING, STEEP = 0.06, 0.18  # cosines between ray and face: below the first nothing returns, above the second all does
PATCH_PX = 6  # pixels across that glass treats alike


@dataclass(frozen=True, eq=False)
class World:
    """One world and one walk through it."""

    name: str  # world:KIND:SEED
    kind: str
    seed: int
    environment: str  # in plain words, for the prior
    truth: GroundTruth
    objects: tuple[TrueObject, ...]
    intrinsics: Intrinsics
    grid: np.ndarray  # (x, y, z) uint8: what each voxel is made of, plan.NOTHING, STRUCTURE, GLASS or FURNITURE
    origin_m: np.ndarray  # (3,): the lower corner of voxel (0, 0, 0)
    voxel_m: float
    range_m: float  # of the depth camera
    outdoors: bool  # in large part: to be mapped with the place graph's outdoor preset
    stamps_ns: np.ndarray  # (view,)
    world_from_camera: np.ndarray  # (view, 4, 4)


@dataclass(frozen=True, eq=False)
class View:
    """One depth image. Camera: x right, y down, z forward; world: z up."""

    stamp_ns: int
    world_from_camera: np.ndarray  # (4, 4)
    depth_m: np.ndarray  # (h, w) float32, along the optical axis, 0 = no measurement


def world_of(kind: str, seed: int, walk: Manner = "scanner") -> World:
    """The world of a kind and a seed, with a walk. Raises ValueError for an unknown kind or walk."""
    if kind not in KINDS:
        raise ValueError(f"there is no kind of world {kind!r}; choose one of {', '.join(sorted(KINDS))}")
    if walk not in ("scanner", "passer-by"):
        raise ValueError(f"there is no walk {walk!r}; choose scanner or passer-by")
    for draw in range(DRAWS):
        try:
            return _drawn(kind, seed, walk, draw)
        except Unbuildable:
            continue
    raise ValueError(f"{DRAWS} draws of world:{kind}:{seed} gave no plan that can be walked; choose another seed")


def views_of(world: World) -> Iterator[View]:
    """What the depth camera measures along the walk, with noise and holes."""
    rays_camera = _rays(world.intrinsics)
    for index, (stamp_ns, pose) in enumerate(zip(world.stamps_ns.tolist(), world.world_from_camera, strict=True)):
        rng = _random(world.kind, world.seed, index, 1)
        chance = _patches(world.intrinsics, rng)
        depth_m, facing = depths(world, pose, rays_camera, chance)
        shape = (world.intrinsics.height_px, world.intrinsics.width_px)
        yield View(stamp_ns, pose, _measured(depth_m, facing, rng).reshape(shape).astype(np.float32))


def depths(
    world: World, world_from_camera: np.ndarray, rays_camera: np.ndarray, chance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """True depth (n,) along rays (n, 3) whose z is 1, 0 = nothing, and the cosine between each and the face it hits."""
    rays_world = rays_camera @ world_from_camera[:3, :3].T
    origin = (world_from_camera[:3, 3] - world.origin_m) / world.voxel_m
    depth_m, axis = np.zeros(len(rays_world)), np.zeros(len(rays_world), np.int64)
    cast(world.grid, origin, rays_world / world.voxel_m, world.range_m, chance, depth_m, axis)
    along = np.abs(np.take_along_axis(rays_world, axis[:, None], axis=1)[:, 0])
    return depth_m, along / np.linalg.norm(rays_world, axis=1)


def _drawn(kind: str, seed: int, walk: Manner, draw: int) -> World:
    rng = _random(kind, seed, draw, 0)
    plan = turned(KINDS[kind](rng), rng)
    grid, origin_m = filled(plan)
    stamps_ns, poses = walked(plan, ways_of(grid, origin_m, plan.voxel_m), walk)
    return World(
        name=f"world:{kind}:{seed}",
        kind=kind,
        seed=seed,
        environment=plan.environment,
        truth=GroundTruth(plan.regions(), plan.nodes()),
        objects=tuple(plan.objects),
        intrinsics=CAMERA,
        grid=grid,
        origin_m=origin_m,
        voxel_m=plan.voxel_m,
        range_m=plan.range_m,
        outdoors=plan.outdoors,
        stamps_ns=stamps_ns,
        world_from_camera=poses,
    )


def _random(kind: str, seed: int, index: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(kind.encode()), seed, index, purpose])


def filled(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """The grid of matter and its lower corner."""
    low_m, high_m = (np.array([getattr(box, end) for box in plan.boxes]) for end in Box._fields[:2])
    coarse_m = 2 * plan.voxel_m  # so that blocks of voxels are cells of ways
    origin_m = np.floor((low_m.min(axis=0) - MARGIN_M) / coarse_m) * coarse_m
    size = np.ceil((high_m.max(axis=0) + MARGIN_M - origin_m) / coarse_m).astype(int) * 2
    grid = np.zeros(size, np.uint8)
    near = 1e-6  # boxes thinner than a voxel fill one all the same
    low = np.floor((low_m - origin_m) / plan.voxel_m + near).astype(np.int64)
    high = np.ceil((high_m - origin_m) / plan.voxel_m - near).astype(np.int64)
    fill(grid, low, high, np.array([box.matter for box in plan.boxes], np.uint8))
    return grid, origin_m


def _rays(camera: Intrinsics) -> np.ndarray:
    v, u = np.indices((camera.height_px, camera.width_px)).reshape(2, -1)
    x, y = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
    return np.stack((x, y, np.ones(len(x))), axis=1)


def _patches(camera: Intrinsics, rng: np.random.Generator) -> np.ndarray:
    """Random numbers (pixel,), the same within each patch."""
    rows, columns = -(-camera.height_px // PATCH_PX), -(-camera.width_px // PATCH_PX)
    patches = rng.random((rows, columns)).repeat(PATCH_PX, axis=0).repeat(PATCH_PX, axis=1)
    return patches[: camera.height_px, : camera.width_px].reshape(-1)


def _measured(depth_m: np.ndarray, facing: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy_m = depth_m + rng.standard_normal(len(depth_m)) * (NOISE_M + NOISE_PER_M * depth_m**2)
    returned = np.clip((facing - GRAZING) / (STEEP - GRAZING), 0, 1) * (1 - DROPPED)
    kept = (depth_m > 0) & (noisy_m > 0) & (rng.random(len(depth_m)) < returned)
    return np.where(kept, noisy_m, 0.0)
