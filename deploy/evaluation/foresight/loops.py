"""Inner loops of the explorer, over surfaces of cells as `worlds.ways` has them, node (i ny + j) levels + level."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.ways import NONE
from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.compiled import compiled

FAR = np.iinfo(np.int32).max  # what cannot be reached


@compiled(inline="always")
def _step(heights, i, j, height, limit):  # noqa: ANN001, ANN202
    """The level of a cell that one steps to from a height, or NONE."""
    if i < 0 or j < 0 or i >= heights.shape[0] or j >= heights.shape[1]:
        return NONE
    for level in range(heights.shape[2]):
        if heights[i, j, level] != NONE and abs(heights[i, j, level] - height) <= limit:
            return level
    return NONE


@compiled()
def look(heights, blocked, known, node, reach, rays, limit, eye):  # noqa: ANN001, ANN201, PLR0917
    """Mark in `known` what is seen from a node, by rays that follow surfaces and pass what is lower than the eye."""
    ny, levels = heights.shape[1], heights.shape[2]
    cell, level = node // levels, node % levels
    i, j = cell // ny, cell % ny
    known[node] = True
    for ray in range(rays):
        angle = 2 * np.pi * ray / rays
        dx, dy = np.cos(angle) * 0.5, np.sin(angle) * 0.5
        x, y, height = i + 0.5, j + 0.5, int(heights[i, j, level])
        for _ in range(2 * reach):
            x += dx
            y += dy
            a, b = int(np.floor(x)), int(np.floor(y))
            if a < 0 or b < 0 or a >= heights.shape[0] or b >= ny:
                break
            other = _step(heights, a, b, height, limit)
            if other != NONE:
                known[(a * ny + b) * levels + other] = True
                height = int(heights[a, b, other])
            elif blocked[a, b, min(height + eye, blocked.shape[2] - 1)]:
                break


@compiled()
def reach(heights, clearance, known, node, least, limit):  # noqa: ANN001, ANN201, PLR0917
    """Cost (node,) of ways over what is known and node before (node,), by Dial's algorithm: a straight step costs 5, a
    diagonal one 7."""
    ny, levels = heights.shape[1], heights.shape[2]
    cost = np.full(heights.size, FAR, np.int32)
    before = np.full(heights.size, NONE, np.int64)
    cost[node] = 0
    buckets = [[0 for _ in range(0)] for _ in range(8)]
    buckets[0].append(node)
    now, waiting = 0, 1
    while waiting > 0:
        bucket = buckets[now % 8]
        while len(bucket) > 0:
            here = bucket.pop()
            waiting -= 1
            if cost[here] != now:
                continue
            cell, level = here // levels, here % levels
            i, j = cell // ny, cell % ny
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    other = _step(heights, a, b, heights[i, j, level], limit)
                    if other == NONE or clearance[a, b, other] < least:
                        continue
                    there = (a * ny + b) * levels + other
                    if not known[there]:
                        continue
                    total = now + (5 if a == i or b == j else 7)
                    if total < cost[there]:
                        cost[there] = total
                        before[there] = here
                        buckets[total % 8].append(there)
                        waiting += 1
        now += 1
    return cost, before


@compiled(inline="always")
def _unseen_beside(heights, clearance, known, here, limit):  # noqa: ANN001, ANN202
    ny, levels = heights.shape[1], heights.shape[2]
    cell, level = here // levels, here % levels
    i, j = cell // ny, cell % ny
    for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
        other = _step(heights, a, b, heights[i, j, level], limit)
        if other != NONE and clearance[a, b, other] >= 2 and not known[(a * ny + b) * levels + other]:
            return True
    return False


@compiled()
def any_edge(heights, clearance, known, nodes, limit):  # noqa: ANN001, ANN201
    """Whether anything beside these nodes was not seen."""
    for here in nodes:  # noqa: SIM110 - what is compiled knows no generators
        if _unseen_beside(heights, clearance, known, here, limit):
            return True
    return False


@compiled()
def close(heights, known, nodes, limit):  # noqa: ANN001, ANN201
    """Mark in `known` what is beside these nodes."""
    ny, levels = heights.shape[1], heights.shape[2]
    for here in nodes:
        cell, level = here // levels, here % levels
        i, j = cell // ny, cell % ny
        for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            other = _step(heights, a, b, heights[i, j, level], limit)
            if other != NONE:
                known[(a * ny + b) * levels + other] = True


@compiled()
def crossings(heights, clearance, regions, reach, limit):  # noqa: ANN001, ANN201
    """Nodes on both sides of borders, at most `reach` cells from each other along an axis, over walkable ones."""
    ny, levels = heights.shape[1], heights.shape[2]
    one, two = [0 for _ in range(0)], [0 for _ in range(0)]
    for here in range(heights.size):
        if regions[here] == NO_REGION:
            continue
        cell, level = here // levels, here % levels
        i, j = cell // ny, cell % ny
        for axis in range(2):
            height = heights[i, j, level]
            for far in range(1, reach + 1):
                a, b = (i + far, j) if axis == 0 else (i, j + far)
                other = _step(heights, a, b, height, limit)
                if other == NONE or clearance[a, b, other] < 2:
                    break
                there = (a * ny + b) * levels + other
                height = heights[a, b, other]
                if regions[there] == regions[here]:
                    break
                if regions[there] != NO_REGION:
                    one.append(here)
                    two.append(there)
                    break
    return np.array(one, dtype=np.int64), np.array(two, dtype=np.int64)


@compiled()
def edges(heights, clearance, known, limit):  # noqa: ANN001, ANN201
    """Nodes that were seen, beside one that was not."""
    found = np.zeros(heights.size, np.bool_)
    for here in range(heights.size):
        if known[here]:
            found[here] = _unseen_beside(heights, clearance, known, here, limit)
    return found


@compiled()
def grouped(heights, edge, limit):  # noqa: ANN001, ANN201
    """Number (node,) of the group of touching edge nodes, -1 = none."""
    ny, levels = heights.shape[1], heights.shape[2]
    group = np.full(heights.size, -1, np.int64)
    count = 0
    for first in range(heights.size):
        if not edge[first] or group[first] >= 0:
            continue
        group[first] = count
        front = [first]
        while len(front) > 0:
            here = front.pop()
            cell, level = here // levels, here % levels
            i, j = cell // ny, cell % ny
            for a in range(i - 2, i + 3):
                for b in range(j - 2, j + 3):
                    other = _step(heights, a, b, heights[i, j, level], limit)
                    there = (a * ny + b) * levels + other
                    if other != NONE and edge[there] and group[there] < 0:
                        group[there] = count
                        front.append(there)
        count += 1
    return group


@compiled()
def flooded(heights, clearance, known, nodes, most, limit):  # noqa: ANN001, ANN201, PLR0917
    """Unseen nodes (n,) that one comes to from these through unseen ones, the nearest first, at most so many cells
    away; how many cells away each is (n,), and the row in `nodes` of the nearest (n,)."""
    ny, levels = heights.shape[1], heights.shape[2]
    found, depths, starts = [0 for _ in range(0)], [0 for _ in range(0)], [0 for _ in range(0)]
    reached = np.zeros(heights.size, np.bool_)
    front, begun, far = list(nodes), list(range(len(nodes))), 0
    while len(front) > 0 and far < most:
        far += 1
        first = len(found)
        for here, start in zip(front, begun):  # noqa: B905 - what is compiled knows no strict
            cell, level = here // levels, here % levels
            i, j = cell // ny, cell % ny
            for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                other = _step(heights, a, b, heights[i, j, level], limit)
                if other == NONE or clearance[a, b, other] < 2:
                    continue
                there = (a * ny + b) * levels + other
                if not known[there] and not reached[there]:
                    reached[there] = True
                    found.append(there)
                    depths.append(far)
                    starts.append(start)
        front, begun = found[first:], starts[first:]
    return np.array(found, dtype=np.int64), np.array(depths, dtype=np.int64), np.array(starts, dtype=np.int64)
