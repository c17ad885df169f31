"""A scene prepared for questions: columns by row, and trees and graphs that are built when first needed (pure)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from prior_sg.schemas.answers import What
from prior_sg.schemas.names import same
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene

_NONE = np.zeros(0, np.int64)
MOST_GRAPHS = 8  # by least clearance, kept at a time


@dataclass(frozen=True, eq=False)
class Ways:
    """Edges of enough clearance as a graph over the rows of places."""

    graph: "scipy.sparse.csr_array"  # (place, place) lengths in metres
    component: np.ndarray  # (place,)
    roomy: np.ndarray  # (place,) bool: has the clearance itself


class Index:
    """Everything questions need of one scene, which must not change; what is expensive is made once, when asked for."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._ways: dict[float, Ways] = {}

    def ids(self, what: What) -> np.ndarray:
        """Ids of a kind (n,), in ascending order."""
        return {"place": self.scene.place_ids, "region": self._region_ids, "object": self._object_ids}[what]

    def row(self, what: What, number: int) -> int | None:
        """The row of an id, None where there is none."""
        ids = self.ids(what)
        row = int(np.searchsorted(ids, number)) if -(2**63) <= number < 2**63 else len(ids)
        return row if row < len(ids) and ids[row] == number else None

    def labelled(self, what: What, label: str) -> np.ndarray:
        """Rows (n,) of a kind that carry a label, whatever its case."""
        if what == "object":
            return self._object_labels.get(same(label), _NONE)
        regions = self._region_labels.get(same(label), _NONE)
        return regions if what == "region" else np.flatnonzero(np.isin(self.region_rows, regions))

    def labels(self, what: What) -> list[str]:
        """Labels that something of a kind carries, in order; of places, those of regions."""
        return self._object_names if what == "object" else self._region_names

    def is_labelled(self, what: What, label: str) -> bool:
        """Whether something of a kind carries a label, whatever its case."""
        return same(label) in (self._object_labels if what == "object" else self._region_labels)

    @property
    def regions(self) -> list[Region]:
        """By row."""
        return self.scene.regions

    @property
    def objects(self) -> list[SceneObject]:
        """By row."""
        return self.scene.objects

    @cached_property
    def _region_names(self) -> list[str]:
        return sorted({region.label for region in self.regions if region.label})

    @cached_property
    def _object_names(self) -> list[str]:
        return sorted({item.label for item in self.objects if item.label})

    @cached_property
    def _region_labels(self) -> dict[str, np.ndarray]:
        return _rows_by_label([region.label for region in self.regions])

    @cached_property
    def _object_labels(self) -> dict[str, np.ndarray]:
        return _rows_by_label([item.label for item in self.objects])

    @cached_property
    def points_m(self) -> np.ndarray:
        """Centres of places (place, 3)."""
        return self.scene.positions_m.astype(np.float64)

    @cached_property
    def tree(self) -> "scipy.spatial.cKDTree":
        """Of the places."""
        return scipy.spatial.cKDTree(self.points_m, balanced_tree=False, compact_nodes=False)

    @cached_property
    def boxes_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners of objects, each (object, 3)."""
        low, high = ([getattr(item, side) for item in self.objects] for side in ("min_m", "max_m"))
        return np.array(low, np.float64).reshape(-1, 3), np.array(high, np.float64).reshape(-1, 3)

    @cached_property
    def _region_ids(self) -> np.ndarray:
        return np.array([region.id for region in self.regions], np.int64)

    @cached_property
    def _object_ids(self) -> np.ndarray:
        return np.array([item.id for item in self.objects], np.int64)

    @cached_property
    def region_rows(self) -> np.ndarray:
        """Row (place,) of each place's region; -1 = none."""
        ids, found = self._region_ids, self.scene.place_regions
        if not len(ids):
            return np.full(len(found), -1)
        rows = np.minimum(np.searchsorted(ids, found), len(ids) - 1)
        return np.where(ids[rows] == found, rows, -1)

    @cached_property
    def _members(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of places in order of their regions, and where each region's begin (region + 1,)."""
        order = np.argsort(self.region_rows, kind="stable")
        return order, np.searchsorted(self.region_rows[order], np.arange(len(self.regions) + 1))

    def members(self, region_row: int) -> np.ndarray:
        """Rows of a region's places."""
        order, starts = self._members
        return order[starts[region_row] : starts[region_row + 1]]

    def nearest_of_regions(self, distances_m: np.ndarray) -> np.ndarray:
        """Of distances to all places (place,), the least in each region (region,); infinite where it has none."""
        order, starts = self._members
        found = np.full(len(self.regions), np.inf)
        filled = np.flatnonzero(starts[1:] > starts[:-1])
        if len(filled):  # places of no region stand before all others
            found[filled] = np.minimum.reduceat(distances_m[order], starts[filled])
        return found

    def means_of_regions(self, values: np.ndarray) -> np.ndarray:
        """Of values of all places (place,), the mean in each region (region,); 0 where it has no places."""
        inside = self.region_rows >= 0
        rows, count = self.region_rows[inside], len(self.regions)
        totals = np.bincount(rows, values[inside], minlength=count)
        return totals / np.maximum(np.bincount(rows, minlength=count), 1)

    @cached_property
    def beliefs(self) -> np.ndarray:
        """P(label | place) (place, label); a row sums to what is not unknown of the place."""
        known = 1.0 - self.scene.unknown.astype(np.float32)
        return self.scene.posteriors.astype(np.float32) * known[:, None]

    @cached_property
    def object_beliefs(self) -> np.ndarray:
        """Probability (object,) that an object's label is right."""
        return np.array([item.probability * item.known for item in self.objects], np.float64)

    @cached_property
    def object_regions(self) -> np.ndarray:
        """Row (object,) of the region that holds each object; -1 = none."""
        rows = {number: row for row, region in enumerate(self.regions) for number in region.object_ids}
        return np.array([rows.get(item.id, -1) for item in self.objects], np.int64)

    @cached_property
    def predicted(self) -> np.ndarray:
        """Whether a place's label is a prediction (place,)."""
        return np.isin(self.scene.place_ids, self.scene.predicted_ids)

    @cached_property
    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of both places (edge, 2) and lengths (edge,) in metres."""
        rows = np.searchsorted(self.scene.place_ids, self.scene.edges).reshape(-1, 2)
        steps_m = self.points_m[rows[:, 0]] - self.points_m[rows[:, 1]]
        return rows, np.linalg.norm(steps_m, axis=1)

    @cached_property
    def _edges_of_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of edges in order of their places, and where each place's begin (place + 1,)."""
        ends = self.edges[0].T.reshape(-1)
        order = np.argsort(ends, kind="stable")
        starts = np.searchsorted(ends[order], np.arange(len(self.scene.place_ids) + 1))
        return order % max(len(self.scene.edges), 1), starts

    def edges_of(self, place_row: int) -> np.ndarray:
        """Numbers of the edges of a place."""
        order, starts = self._edges_of_places
        return order[starts[place_row] : starts[place_row + 1]]

    def ways(self, clearance_m: float) -> Ways:
        """The edges whose clearance is at least this."""
        if clearance_m not in self._ways:
            while len(self._ways) >= MOST_GRAPHS:
                del self._ways[next(iter(self._ways))]
            self._ways[clearance_m] = self._made_ways(clearance_m)
        return self._ways[clearance_m]

    def _made_ways(self, clearance_m: float) -> Ways:
        rows, lengths_m = self.edges
        wide = self.scene.clearances_m >= clearance_m
        count = len(self.scene.place_ids)
        a, b = rows[wide].T
        both = (np.concatenate((a, b)), np.concatenate((b, a)))
        graph = scipy.sparse.csr_array((np.tile(np.maximum(lengths_m[wide], 1e-9), 2), both), shape=(count, count))
        pieces = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
        return Ways(graph, pieces, self.scene.radii_m >= clearance_m)


def _rows_by_label(labels: list[str]) -> dict[str, np.ndarray]:
    """Rows by label without its case; those without a label are left out."""
    rows: dict[str, list[int]] = {}
    for row, label in enumerate(labels):
        rows.setdefault(label, []).append(row)
    folded: dict[str, list[int]] = {}
    for label, found in rows.items():
        if label:
            folded.setdefault(same(label), []).extend(found)
    return {label: np.array(sorted(found), np.int64) for label, found in folded.items()}
