"""Distance to the nearest obstacle, measured through observed space only, and the Voronoi diagram it induces (pure).

After Lau, Sprunk and Burgard (2013), as used by Hydra. Every obstacle sends a wave; a wave enters observed free voxels
only, and never turns back toward its obstacle, so it does not bend around what was not observed. A voxel takes the
nearest of the obstacles that its neighbours hand on, ties broken by the obstacle's coordinates. Distances along a wave
grow strictly, so these equations have one solution: it does not depend on the order of work.

A change of labels is repaired by waves over the voxels it concerns: a raise wave withdraws what rested on voxels that
changed, a lower wave settles what is open again in order of distance, and whatever rested on a value that a lower wave
replaced is looked at again.
"""

from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.place_graph.core.volume.grid import FAR_D2, FREE, OCCUPIED, UNKNOWN_D2, Box, VoxelGrid

RIM = 2  # voxels around the recomputed box: one for the GVD of its neighbours, one more for theirs
MAX_BASIS_POINTS = 8
STEPS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)], np.int64
)


class FieldRules(NamedTuple):
    """How far distances reach and what is on the GVD; lengths in voxels."""

    max_distance: float  # distances end here
    voronoi_min_distance: float  # the GVD ends this close to obstacles
    parent_l1: float  # obstacles farther apart than this (L1) are distinct basis points ...
    parent_cos: float  # ... and so are those seen under an angle with a smaller cosine


def refresh(grid: VoxelGrid, changed: np.ndarray, rules: FieldRules) -> Box | None:
    """Bring distances and GVD up to date after the labels of the voxels (n, 3) changed.

    Returns the box of all voxels whose distance or membership of the GVD may have changed, None if there are none.
    """
    if not len(changed):
        return None
    reach, max_d2 = int(np.ceil(rules.max_distance)), int(np.floor(rules.max_distance**2))
    core = Box.around(changed).grown(reach).clipped(grid.bounds)
    while True:
        window = core.grown(RIM)
        label, d2, offset = grid.gather_all({"label": 0, "d2": UNKNOWN_D2, "offset": 0}, window)
        touched, inside = repair(label, d2, offset, changed - window.low, RIM, max_d2)
        if inside:
            break
        core = core.grown(reach).clipped(grid.bounds)  # a chain of replaced values has left the window
    if not len(touched):
        return None
    inner = Box.around(touched).grown(1)
    box = Box(inner.low + window.low, inner.high + window.low)
    basis = grid.gather("basis", box)
    limits = (rules.voronoi_min_distance**2, rules.parent_l1, rules.parent_cos)
    renew_voronoi(label, d2, offset, basis, inner.low, touched, *limits)
    part = tuple(slice(*ends) for ends in zip(*inner, strict=True))
    grid.scatter({"d2": d2[part], "offset": offset[part], "basis": basis}, box)
    return box


def repair(  # noqa: PLR0917
    label: np.ndarray, d2: np.ndarray, offset: np.ndarray, changed: np.ndarray, rim: int, max_d2: int
) -> tuple[np.ndarray, bool]:
    """Bring `d2` and `offset` (voxel minus obstacle) of a window up to date in place after labels of `changed` changed.

    Returns the voxels (n, 3) that were given another value at some time, and whether all of that stayed off the `rim`,
    whose values are taken as they are; if not, the window is too small and its content means nothing.
    """
    size, shape = label.size, np.array(label.shape, np.int64)
    wave = Wave(
        label=label.reshape(-1),
        d2=d2.reshape(-1),
        offset=offset.reshape(-1, 3),
        listed=np.zeros(size, np.uint8),
        touched=np.empty(size, np.int64),
        before=np.empty(size, np.int32),
        after=np.empty(size, np.int32),
        head=np.full(max_d2 + 1, -1, np.int32),
        counts=np.zeros(3, np.int64),
        shape=shape,
    )
    _raise(wave, np.ravel_multi_index(tuple(changed.T), label.shape), rim)
    _settle(wave, max_d2)
    _lower(wave, rim, max_d2)
    voxels = np.stack(np.unravel_index(wave.touched[: wave.counts[TOUCHED]], label.shape), axis=1)
    return voxels, not wave.counts[LEFT]


class Wave(NamedTuple):
    """A window, flattened, and the waves under way in it. Open voxels queue in one linked list per distance."""

    label: np.ndarray
    d2: np.ndarray
    offset: np.ndarray  # (n, 3)
    listed: np.ndarray  # per voxel: NEW, KNOWN (it is among `touched`), QUEUED (and waits to hand its obstacle on)
    touched: np.ndarray
    before: np.ndarray  # in its list
    after: np.ndarray
    head: np.ndarray  # first voxel of each list
    counts: np.ndarray  # TOUCHED: how many; LEFT: waves that ran into the rim; LEVEL: distance being worked on
    shape: np.ndarray


NEW, KNOWN, QUEUED = 0, 1, 2
TOUCHED, LEFT, LEVEL = 0, 1, 2

# Loops get arrays one by one: read from a tuple within a loop, an array is counted as held each time.


@compiled()
def _touch(listed, touched, counts, voxel):  # noqa: ANN001, ANN202
    if listed[voxel] == NEW:
        listed[voxel] = KNOWN
        touched[counts[TOUCHED]] = voxel
        counts[TOUCHED] += 1


@compiled()
def _unqueue(d2, listed, before, after, head, voxel):  # noqa: ANN001, ANN202, PLR0917
    """Take a voxel out of the list of its distance; call it before the distance changes."""
    if listed[voxel] == QUEUED:
        listed[voxel] = KNOWN
        last, following = before[voxel], after[voxel]
        if last >= 0:
            after[last] = following
        else:
            head[d2[voxel]] = following
        if following >= 0:
            before[following] = last


@compiled()
def _queue(d2, listed, before, after, head, counts, voxel):  # noqa: ANN001, ANN202, PLR0917
    """Put a touched voxel into the list of its distance."""
    level = d2[voxel]
    listed[voxel] = QUEUED
    before[voxel], after[voxel] = -1, head[level]
    if head[level] >= 0:
        before[head[level]] = voxel
    head[level] = voxel
    counts[LEVEL] = min(counts[LEVEL], level)


@compiled()
def _in_rim(shape, voxel, rim):  # noqa: ANN001, ANN202
    nx, ny, nz = shape[0], shape[1], shape[2]
    i, j, k = voxel // (ny * nz), (voxel // nz) % ny, voxel % nz
    return i < rim or j < rim or k < rim or i >= nx - rim or j >= ny - rim or k >= nz - rim


@compiled()
def _handed_on(d2, offset, shape, voxel, max_d2):  # noqa: ANN001, ANN202
    """The nearest obstacle that the neighbours of a free voxel hand on to it: squared distance and offset."""
    stride_x, stride_y = shape[1] * shape[2], shape[2]
    best = np.int64(max_d2 + 1)
    bx = by = bz = np.int64(0)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            for dz in (-1, 0, 1):
                other = voxel - dx * stride_x - dy * stride_y - dz
                known = d2[other]
                if known < 0 or known == FAR_D2 or other == voxel:
                    continue
                ox, oy, oz = np.int64(offset[other, 0]), np.int64(offset[other, 1]), np.int64(offset[other, 2])
                if ox * dx < 0 or oy * dy < 0 or oz * dz < 0:
                    continue
                px, py, pz = ox + dx, oy + dy, oz + dz
                reach = px * px + py * py + pz * pz
                if reach < best or (reach == best and (px, py, pz) > (bx, by, bz)):
                    best, bx, by, bz = reach, px, py, pz
    if best > max_d2:
        return np.int64(FAR_D2), np.int64(0), np.int64(0), np.int64(0)
    return best, bx, by, bz


@compiled()
def _resting(d2, offset, shape, voxel, known, ox, oy, oz, stack, depth):  # noqa: ANN001, ANN202, PLR0917
    """Push the neighbours that have the obstacle which `voxel`, of former distance and offset, may have handed on."""
    if known < 0 or known == FAR_D2:
        return stack, depth
    stride_x, stride_y = shape[1] * shape[2], shape[2]
    if depth + 26 > len(stack):
        stack = np.concatenate((stack, np.empty_like(stack)))
    for dx in range(-1 if ox <= 0 else 0, 2 if ox >= 0 else 1):
        for dy in range(-1 if oy <= 0 else 0, 2 if oy >= 0 else 1):
            for dz in range(-1 if oz <= 0 else 0, 2 if oz >= 0 else 1):
                other = voxel + dx * stride_x + dy * stride_y + dz
                if d2[other] <= 0 or d2[other] == FAR_D2:
                    continue
                if offset[other, 0] == ox + dx and offset[other, 1] == oy + dy and offset[other, 2] == oz + dz:
                    stack[depth] = other
                    depth += 1
    return stack, depth


@compiled()
def _raise(wave, changed, rim):  # noqa: ANN001, ANN202
    """Withdraw the values of changed voxels, and all that rested on them."""
    label, d2, offset, listed, touched, _, _, _, counts, shape = wave
    stack = np.empty(4096, np.int64)
    for n in range(len(changed)):
        stack[0] = changed[n]
        depth = 1
        while depth > 0:
            depth -= 1
            voxel = stack[depth]
            if listed[voxel] != NEW:
                continue
            if _in_rim(shape, voxel, rim):
                counts[LEFT] += 1
                continue
            _touch(listed, touched, counts, voxel)
            known = d2[voxel]
            ox, oy, oz = np.int64(offset[voxel, 0]), np.int64(offset[voxel, 1]), np.int64(offset[voxel, 2])
            d2[voxel] = FAR_D2 if label[voxel] == FREE else UNKNOWN_D2
            offset[voxel] = 0
            stack, depth = _resting(d2, offset, shape, voxel, known, ox, oy, oz, stack, depth)


@compiled()
def _settle(wave, max_d2):  # noqa: ANN001, ANN202
    """Obstacles are at distance zero; what was withdrawn takes what its neighbours hand on."""
    label, d2, offset, listed, touched, before, after, head, counts, shape = wave
    count = counts[TOUCHED]
    counts[LEVEL] = max_d2
    for n in range(count):
        voxel = touched[n]
        if label[voxel] == OCCUPIED:
            d2[voxel] = 0
            _queue(d2, listed, before, after, head, counts, voxel)
    for n in range(count):
        voxel = touched[n]
        if label[voxel] == FREE:
            best, bx, by, bz = _handed_on(d2, offset, shape, voxel, max_d2)
            d2[voxel] = best
            offset[voxel, 0], offset[voxel, 1], offset[voxel, 2] = bx, by, bz
            if best != FAR_D2:
                _queue(d2, listed, before, after, head, counts, voxel)


@compiled()
def _lower(wave, rim, max_d2):  # noqa: ANN001, ANN202
    """In order of distance, each voxel hands its obstacle on.

    A voxel that is nearer to that obstacle takes it unasked: whatever else its neighbours have for it is no nearer, or
    is handed on when its turn comes.
    """
    label, d2, offset, listed, touched, before, after, head, counts, shape = wave
    stride_x, stride_y = shape[1] * shape[2], shape[2]
    stack = np.empty(4096, np.int64)
    while counts[LEVEL] <= max_d2:
        voxel = np.int64(head[counts[LEVEL]])
        if voxel < 0:
            counts[LEVEL] += 1
            continue
        _unqueue(d2, listed, before, after, head, voxel)
        ox, oy, oz = np.int64(offset[voxel, 0]), np.int64(offset[voxel, 1]), np.int64(offset[voxel, 2])
        for dx in range(-1 if ox <= 0 else 0, 2 if ox >= 0 else 1):
            for dy in range(-1 if oy <= 0 else 0, 2 if oy >= 0 else 1):
                for dz in range(-1 if oz <= 0 else 0, 2 if oz >= 0 else 1):
                    other = voxel + dx * stride_x + dy * stride_y + dz
                    px, py, pz = ox + dx, oy + dy, oz + dz
                    reach = px * px + py * py + pz * pz
                    known = d2[other]
                    if reach > known or reach > max_d2 or label[other] != FREE:
                        continue
                    qx, qy, qz = np.int64(offset[other, 0]), np.int64(offset[other, 1]), np.int64(offset[other, 2])
                    if reach == known and (px, py, pz) <= (qx, qy, qz):
                        continue
                    if _in_rim(shape, other, rim):
                        counts[LEFT] += 1
                        continue
                    _touch(listed, touched, counts, other)
                    _unqueue(d2, listed, before, after, head, other)
                    d2[other] = reach
                    offset[other, 0], offset[other, 1], offset[other, 2] = px, py, pz
                    _queue(d2, listed, before, after, head, counts, other)
                    stack, depth = _resting(d2, offset, shape, other, known, qx, qy, qz, stack, 0)
                    if depth:
                        stack = _look_again(wave, rim, max_d2, stack, depth)


@compiled()
def _look_again(wave, rim, max_d2, stack, depth):  # noqa: ANN001, ANN202
    """Give the first `depth` voxels of a stack what their neighbours hand on; where that is news, look again at what
    rested on the former value.
    """
    _, d2, offset, listed, touched, before, after, head, counts, shape = wave
    while depth > 0:
        depth -= 1
        voxel = stack[depth]
        best, bx, by, bz = _handed_on(d2, offset, shape, voxel, max_d2)
        known = d2[voxel]
        ox, oy, oz = np.int64(offset[voxel, 0]), np.int64(offset[voxel, 1]), np.int64(offset[voxel, 2])
        if best == known and bx == ox and by == oy and bz == oz:
            continue
        if _in_rim(shape, voxel, rim):
            counts[LEFT] += 1
            continue
        _touch(listed, touched, counts, voxel)
        _unqueue(d2, listed, before, after, head, voxel)
        d2[voxel] = best
        offset[voxel, 0], offset[voxel, 1], offset[voxel, 2] = bx, by, bz
        if best != FAR_D2:
            _queue(d2, listed, before, after, head, counts, voxel)
        stack, depth = _resting(d2, offset, shape, voxel, known, ox, oy, oz, stack, depth)
    return stack


@compiled()
def distinct(px, py, pz, qx, qy, qz, l1, cosine):  # noqa: ANN001, ANN201, PLR0917
    """Whether two obstacles, given by their offsets from one voxel, count as different basis points (L1 or angle)."""
    if abs(px - qx) + abs(py - qy) + abs(pz - qz) > l1:
        return True
    dot = px * qx + py * qy + pz * qz
    return dot < cosine * np.sqrt(float((px * px + py * py + pz * pz) * (qx * qx + qy * qy + qz * qz)))


@compiled()
def _on_gvd(label, d2, offset, i, j, k, min_d2, l1, cosine):  # noqa: ANN001, ANN202, PLR0917
    """Whether a wave front stops here: a face neighbour has a distinct obstacle that is about as near to this voxel."""
    ox, oy, oz = np.int64(offset[i, j, k, 0]), np.int64(offset[i, j, k, 1]), np.int64(offset[i, j, k, 2])
    for axis in range(3):
        for side in (-1, 1):
            dx = side if axis == 0 else 0
            dy = side if axis == 1 else 0
            dz = side if axis == 2 else 0
            a, b, c = i + dx, j + dy, k + dz
            if label[a, b, c] != FREE or d2[a, b, c] == FAR_D2 or d2[a, b, c] <= min_d2:
                continue
            qx, qy, qz = np.int64(offset[a, b, c, 0]), np.int64(offset[a, b, c, 1]), np.int64(offset[a, b, c, 2])
            mine_x, mine_y, mine_z = qx - dx, qy - dy, qz - dz  # the neighbour's obstacle seen from here
            if not distinct(ox, oy, oz, mine_x, mine_y, mine_z, l1, cosine):
                continue
            here = mine_x * mine_x + mine_y * mine_y + mine_z * mine_z
            there = (ox + dx) ** 2 + (oy + dy) ** 2 + (oz + dz) ** 2
            if here <= there:
                return True
    return False


@compiled()
def _basis_points(label, d2, offset, i, j, k, l1, cosine):  # noqa: ANN001, ANN202, PLR0917
    """One plus the number of mutually distinct further obstacles of the 26 neighbours."""
    found = np.empty((MAX_BASIS_POINTS, 3), np.int64)
    found[0, 0], found[0, 1], found[0, 2] = offset[i, j, k, 0], offset[i, j, k, 1], offset[i, j, k, 2]
    count = 1
    for s in range(26):
        dx, dy, dz = STEPS[s, 0], STEPS[s, 1], STEPS[s, 2]
        a, b, c = i + dx, j + dy, k + dz
        if count == MAX_BASIS_POINTS:
            break
        if label[a, b, c] != FREE or d2[a, b, c] == FAR_D2:
            continue
        qx, qy, qz = offset[a, b, c, 0] - dx, offset[a, b, c, 1] - dy, offset[a, b, c, 2] - dz
        new = True
        for n in range(count):
            if not distinct(found[n, 0], found[n, 1], found[n, 2], qx, qy, qz, l1, cosine):
                new = False
                break
        if new:
            found[count, 0], found[count, 1], found[count, 2] = qx, qy, qz
            count += 1
    return count


@compiled()
def renew_voronoi(label, d2, offset, basis, low, touched, min_d2, l1, cosine):  # noqa: ANN001, ANN201, PLR0917
    """Recompute `basis` of the voxels (n, 3) and their neighbours in place: 0 off the GVD, else its basis points.

    `basis` begins at the voxel `low` of the window.
    """
    done = np.zeros(basis.shape, np.bool_)
    for n in range(len(touched)):
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    i, j, k = touched[n, 0] + dx, touched[n, 1] + dy, touched[n, 2] + dz
                    a, b, c = i - low[0], j - low[1], k - low[2]
                    if done[a, b, c]:
                        continue
                    done[a, b, c] = True
                    basis[a, b, c] = 0
                    if label[i, j, k] != FREE or d2[i, j, k] == FAR_D2 or d2[i, j, k] <= min_d2:
                        continue
                    if _on_gvd(label, d2, offset, i, j, k, min_d2, l1, cosine):
                        basis[a, b, c] = _basis_points(label, d2, offset, i, j, k, l1, cosine)
