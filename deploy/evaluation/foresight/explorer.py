"""A light explorer on a world's true floor plan: it sees by lines of sight, knows what it has not seen, and walks.

The plan is that of `worlds.ways`: surfaces of cells of 0.1 m on all levels. A ray goes from cell to cell at the height
of the surface, up and down stairs, and over furniture that is lower than the eye. What is seen is told by its true
region. A frontier is a seen cell beside one that can be walked on and was not seen: real robots also see openings where
there is nothing, this one does not.
"""

from dataclasses import dataclass, field

import numpy as np

from prior_sg.deploy.evaluation.foresight import loops
from prior_sg.deploy.evaluation.foresight.loops import FAR
from prior_sg.deploy.evaluation.worlds.plan import NOTHING
from prior_sg.deploy.evaluation.worlds.walk import NARROW_CELLS
from prior_sg.deploy.evaluation.worlds.ways import CELL_M, NONE, STEP_M, Ways, ways_of
from prior_sg.deploy.evaluation.worlds.world import World
from prior_sg.schemas.foresight import REACH_M
from prior_sg.schemas.regions import NO_REGION

EYE_M = 1.4
RAYS = 480
RANGE_M = {False: 5.0, True: 15.0}  # of sight, indoors and outdoors: as far as the place graph fuses depth
LOOK_EVERY_CELLS = 6  # on the way
LEAST_CELLS = 3  # of a frontier; smaller ones are cracks
BEYOND_CELLS = 20  # what an opening reveals first: walkable cells at most so far from it
REACH_CELLS = round(REACH_M / CELL_M)
MET_M2 = 0.5  # of a region within reach: it begins there
ABOVE_M = 0.05  # the floor, where a surface is asked which region it is in
BORDER_CELLS = 4  # as thick a border may be, in a doorway


@dataclass(frozen=True, eq=False)
class Plan:
    """What there is to be seen: surfaces, the region of each, and what stops a look."""

    heights: np.ndarray  # (x, y, level) as in `Ways`, of what can be walked to, packed into as few levels as there are
    clearance: np.ndarray  # (x, y, level)
    origin_m: np.ndarray  # (3,)
    voxel_m: float
    blocked: np.ndarray  # (x, y, z) bool: matter in the cell's block of voxels, by layer
    regions: np.ndarray  # (node,) index of the true region, NO_REGION = none
    labels: tuple[str, ...]  # of the true regions
    range_cells: int
    step: int  # voxels
    eye: int  # voxels

    def position_m(self, nodes: np.ndarray) -> np.ndarray:
        """Points (n, 3) on the ground."""
        i, j, level = np.unravel_index(nodes, self.heights.shape)
        x, y = self.origin_m[0] + (i + 0.5) * CELL_M, self.origin_m[1] + (j + 0.5) * CELL_M
        return np.stack((x, y, self.origin_m[2] + self.heights[i, j, level] * self.voxel_m), axis=1)


@dataclass(eq=False)
class Frontiers:
    """The frontiers of one moment."""

    nodes: list[np.ndarray]  # cells of each
    targets: np.ndarray  # (frontier,) the node to walk to
    steps: np.ndarray  # (frontier,) cells on the way there, in fifths
    centers_m: np.ndarray  # (frontier, 3)
    widths_m: np.ndarray  # (frontier,)
    regions: np.ndarray  # (frontier,) index of the true region it opens from


@dataclass(eq=False)
class Explorer:
    """Where the explorer is and what it has seen."""

    plan: Plan
    node: int
    known: np.ndarray = field(init=False)  # (node,) bool
    walked_m: float = 0.0

    def __post_init__(self) -> None:
        self.known = np.zeros(self.plan.heights.size, bool)
        self.look()

    def look(self) -> None:
        """See what is in sight from here."""
        plan = self.plan
        loops.look(plan.heights, plan.blocked, self.known, self.node, plan.range_cells, RAYS, plan.step, plan.eye)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Cost (node,) in fifths of a cell, FAR = not to be reached through what is known, and the node before."""
        plan = self.plan
        return loops.reach(plan.heights, plan.clearance, self.known, self.node, NARROW_CELLS, plan.step)

    def seen_m2(self) -> np.ndarray:
        """Seen area (region,) of each true region."""
        seen = self.plan.regions[self.known]
        return np.bincount(seen[seen != NO_REGION], minlength=len(self.plan.labels)) * CELL_M**2

    def frontiers(self, cost: np.ndarray) -> Frontiers:
        """Frontiers that can be walked to."""
        plan = self.plan
        edge = loops.edges(plan.heights, plan.clearance, self.known, plan.step)
        group = loops.grouped(plan.heights, edge, plan.step)
        order = np.flatnonzero(group >= 0)
        order = order[np.argsort(group[order], kind="stable")]
        parts = np.split(order, np.flatnonzero(np.diff(group[order])) + 1) if len(order) else []
        kept, targets, widths, centers, regions = [], [], [], [], []
        for nodes in parts:
            reached = nodes[cost[nodes] < FAR]
            if len(nodes) < LEAST_CELLS or not len(reached):
                continue
            points_m = plan.position_m(nodes)
            center_m = points_m.mean(axis=0)
            at_m = plan.position_m(reached)
            held = plan.regions[nodes]
            held = held[held != NO_REGION]
            if not len(held):
                continue
            kept.append(nodes)
            targets.append(reached[np.linalg.norm(at_m - center_m, axis=1).argmin()])
            widths.append(np.linalg.norm(np.ptp(points_m[:, :2], axis=0)) + CELL_M)
            centers.append(center_m)
            regions.append(np.bincount(held).argmax())
        found = np.array(targets, np.int64)
        return Frontiers(
            kept, found, cost[found], np.array(centers).reshape(-1, 3), np.array(widths), np.array(regions, np.int64)
        )

    def revealed(self, nodes: np.ndarray) -> int:
        """Index of the true region that most of the unseen cells just beyond a frontier belong to; NO_REGION = none."""
        held = self.plan.regions[self._behind(nodes, BEYOND_CELLS)[0]]
        held = held[held != NO_REGION]
        return int(np.bincount(held).argmax()) if len(held) else NO_REGION

    def met(self, nodes: np.ndarray) -> np.ndarray:
        """Indices of the true regions of which something to stand on begins within REACH_M behind a frontier."""
        held = self.plan.regions[self._behind(nodes, REACH_CELLS)[0]]
        counts = np.bincount(held[held != NO_REGION], minlength=len(self.plan.labels))
        return np.flatnonzero(counts * CELL_M**2 >= MET_M2)

    def toward(self, frontiers: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The frontier (region,) that one comes to each true region through with the least unseen way, and that way in
        metres (region,); -1 and inf = through none."""
        plan = self.plan
        count = len(plan.labels)
        through, ways_m = np.full(count, -1), np.full(count, np.inf)
        nodes = np.concatenate(frontiers)
        numbers = np.repeat(np.arange(len(frontiers)), [len(one) for one in frontiers])
        found, depths, starts = self._behind(nodes, loops.FAR)
        order = np.lexsort((found, depths))
        order = order[plan.regions[found[order]] != NO_REGION]
        regions, first = np.unique(plan.regions[found[order]], return_index=True)
        through[regions], ways_m[regions] = numbers[starts[order[first]]], depths[order[first]] * CELL_M
        return through, ways_m

    def _behind(self, nodes: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `loops.flooded`."""
        plan = self.plan
        found: tuple[np.ndarray, np.ndarray, np.ndarray] = loops.flooded(
            plan.heights, plan.clearance, self.known, nodes, cells, plan.step
        )
        return found

    def walk(self, before: np.ndarray, target: int, until: np.ndarray) -> None:
        """Walk towards a node, looking around on the way, until there or until nothing is unseen beside `until`."""
        way = [target]
        while way[-1] != self.node:
            way.append(int(before[way[-1]]))
        way.reverse()
        points_m = self.plan.position_m(np.array(way))
        steps_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
        for number, node in enumerate(way[1:], 1):
            self.node = node
            self.walked_m += float(steps_m[number - 1])
            if number % LOOK_EVERY_CELLS and number < len(way) - 1:
                continue
            self.look()
            if not self.open(until):
                return

    def close(self, nodes: np.ndarray) -> None:
        """See all that is beside these nodes."""
        plan = self.plan
        loops.close(plan.heights, self.known, nodes, plan.step)

    def open(self, nodes: np.ndarray) -> bool:
        """Whether anything beside these nodes has not been seen."""
        plan = self.plan
        return bool(loops.any_edge(plan.heights, plan.clearance, self.known, nodes, plan.step))


def plan_of(world: World) -> Plan:
    """The plan of a world."""
    ways = ways_of(world.grid, world.origin_m, world.voxel_m)
    block = round(CELL_M / world.voxel_m)
    nx, ny, nz = world.grid.shape[0] // block, world.grid.shape[1] // block, world.grid.shape[2]
    matter = world.grid[: nx * block, : ny * block].reshape(nx, block, ny, block, nz) != NOTHING
    regions = _regions(ways, world)
    roomy = np.where(regions >= 0, ways.clearance.reshape(-1), 0)
    walked = ways.reached(int(roomy.argmax()), 1).reshape(ways.heights.shape)
    order = np.argsort(~walked, axis=2, kind="stable")[:, :, : int(walked.sum(axis=2).max())]
    kept = np.take_along_axis(walked, order, axis=2)
    heights, clearance, held = (
        np.take_along_axis(column.reshape(walked.shape), order, axis=2)
        for column in (ways.heights, ways.clearance, regions)
    )
    return Plan(
        heights=np.where(kept, heights, NONE).astype(np.int16),
        clearance=np.where(kept, clearance, 0).astype(np.uint8),
        origin_m=world.origin_m,
        voxel_m=world.voxel_m,
        blocked=matter.any(axis=(1, 3)),
        regions=np.where(kept, held, NO_REGION).reshape(-1),
        labels=tuple(region.label for region in world.truth.regions),
        range_cells=round(RANGE_M[world.outdoors] / CELL_M),
        step=round(STEP_M / world.voxel_m),
        eye=round(EYE_M / world.voxel_m),
    )


def _regions(ways: Ways, world: World) -> np.ndarray:
    """Index (node,) of the true region of each surface, NO_REGION = none."""
    nodes = np.flatnonzero(ways.heights.reshape(-1) != NONE)
    points_m = ways.position_m(nodes) + np.array((0.0, 0.0, ABOVE_M))
    regions = np.full(ways.heights.size, NO_REGION, np.int64)
    numbers = {region.id: number for number, region in enumerate(world.truth.regions)}
    regions[nodes] = [numbers.get(one, NO_REGION) for one in world.truth.region_of(points_m).tolist()]
    return regions


def crossings(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (n,) and (n,) on both sides of all borders that one can walk across."""
    return loops.crossings(plan.heights, plan.clearance, plan.regions, BORDER_CELLS, plan.step)


def starts_of(plan: Plan) -> np.ndarray:
    """Nodes in a region where one can stand, all in reach of each other."""
    roomy = np.where(plan.regions >= 0, plan.clearance.reshape(-1), 0)
    everything = np.ones(plan.heights.size, bool)
    first = int(roomy.argmax())
    cost, _ = loops.reach(plan.heights, plan.clearance, everything, first, NARROW_CELLS, plan.step)
    return np.flatnonzero((cost < FAR) & (plan.regions >= 0))
