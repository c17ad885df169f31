"""Going on where another process was: the same ids for the places that it knew (pure).

The map follows from the keyframes, in whatever order they come; ids do not, so they are handed on. A place has the id
of the former place at its centre, else of the nearest that would merge with it.
"""

import numpy as np
import scipy

from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.scene import Scene
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.state import Legacy, State

CANDIDATES = 4  # former places looked at for each


def legacy_of(told: PlaceDelta | Scene, next_id: int = 0) -> Legacy:
    """What a snapshot or the stored scene says; `next_id` where more is known. No keyframe has a negative number: one
    that a snapshot names cannot be asked for."""
    past = told.past_frame_ids.tolist() if isinstance(told, PlaceDelta) else []
    frames = frozenset(frame_id for frame_id in past if frame_id >= 0)
    ids = np.array(told.place_ids)
    return Legacy(ids, np.array(told.positions_m, np.float64), max(next_id, int(ids.max(initial=-1)) + 1), frames)


def inherit(state: State, cfg: Config) -> None:
    """Give the places of the map their former ids. Nothing may have been told yet."""
    legacy, graph = state.legacy, state.graph
    if legacy is None:
        return
    own_ids = sorted(graph.places)
    centers = np.array([graph.places[i].center for i in own_ids], np.float64).reshape(-1, 3)
    found = matched(legacy, centers * cfg.graph_voxel_m, graph.rules.merge * cfg.graph_voxel_m)
    next_id = max(legacy.next_id, graph.next_id)
    number = {}
    for row, own_id in enumerate(own_ids):
        if row in found:
            number[own_id] = found[row]
        else:
            number[own_id], next_id = next_id, next_id + 1
    graph.renumber(number, next_id)
    state.openings.renumber(number)
    state.ledger.renumber(number)
    state.legacy = None


def matched(legacy: Legacy, positions_m: np.ndarray, reach_m: float) -> dict[int, int]:
    """The former id of each row of `positions_m` (place, 3) that has one: nearest first, each id once."""
    if not (len(legacy.ids) and len(positions_m)):
        return {}
    count = min(CANDIDATES, len(legacy.ids))
    tree = scipy.spatial.cKDTree(legacy.positions_m)
    distances_m, at = tree.query(positions_m, k=count, distance_upper_bound=reach_m)
    distances_m, at = distances_m.reshape(-1, count), at.reshape(-1, count)
    rows, columns = np.nonzero(np.isfinite(distances_m))
    order = np.lexsort((legacy.ids[at[rows, columns]], distances_m[rows, columns]))
    found: dict[int, int] = {}
    taken: set[int] = set()
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        former = int(legacy.ids[at[row, column]])
        if row not in found and former not in taken:
            found[row] = former
            taken.add(former)
    return found
