"""Labels of a coarser grid, for distances and the diagram, from those of the map (pure).

A coarse voxel is an obstacle if any of its voxels is one, so that a wall stays a wall wherever the grid lies; it is
free if at least half of them are; else it was not observed. A block is renewed as a whole, so labels depend on the map
only.
"""

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.place_graph.core.volume.grid import BLOCK, FREE, OCCUPIED, UNOBSERVED, VoxelGrid


def renew_labels(fine: VoxelGrid, coarse: VoxelGrid, changed: np.ndarray, scale: int) -> np.ndarray:
    """Bring the coarse labels up to date after those of the fine voxels (n, 3) changed; `scale` divides BLOCK.

    Returns the coarse voxels (n, 3) whose label changed.
    """
    found: list[np.ndarray] = []
    listed = np.empty(((BLOCK // scale) ** 3, 3), np.int64)
    for x, y, z in sorted(set(map(tuple, _blocks_of(changed).tolist()))):
        changed_block = fine.block((x, y, z))
        assert changed_block is not None
        key = (x // scale, y // scale, z // scale)
        block = coarse.block(key)
        if block is None:
            block = coarse.blank()
            coarse.insert(key, block)
        corner = np.array((x % scale, y % scale, z % scale), np.int64) * (BLOCK // scale)
        count = _renew_block(changed_block.label, block.label, corner, scale, listed)
        if count:
            found.append(listed[:count] + np.array(key, np.int64) * BLOCK)
    return np.concatenate(found) if found else np.empty((0, 3), np.int64)


@compiled()
def _blocks_of(voxels):  # noqa: ANN001, ANN202
    """Blocks (m, 3) that hold the voxels (n, 3), once for each run of voxels of one block."""
    found, count = np.empty((64, 3), np.int64), 0
    for n in range(len(voxels)):
        x, y, z = voxels[n, 0] // BLOCK, voxels[n, 1] // BLOCK, voxels[n, 2] // BLOCK
        if count and x == found[count - 1, 0] and y == found[count - 1, 1] and z == found[count - 1, 2]:
            continue
        if count == len(found):
            found = np.concatenate((found, np.empty_like(found)))
        found[count, 0], found[count, 1], found[count, 2] = x, y, z
        count += 1
    return found[:count]


@compiled()
def _renew_block(fine, coarse, corner, scale, listed):  # noqa: ANN001, ANN202
    """Label the coarse voxels from `corner` on that a block of fine ones fills; list those that changed."""
    count = 0
    side = fine.shape[0] // scale
    for i in range(side):
        for j in range(side):
            for k in range(side):
                free, occupied = 0, False
                for a in range(i * scale, (i + 1) * scale):
                    for b in range(j * scale, (j + 1) * scale):
                        for c in range(k * scale, (k + 1) * scale):
                            occupied = occupied or fine[a, b, c] == OCCUPIED
                            free += fine[a, b, c] == FREE
                now = OCCUPIED if occupied else (FREE if 2 * free >= scale**3 else UNOBSERVED)
                x, y, z = corner[0] + i, corner[1] + j, corner[2] + k
                if now != coarse[x, y, z]:
                    coarse[x, y, z] = now
                    listed[count, 0], listed[count, 1], listed[count, 2] = x, y, z
                    count += 1
    return count
