"""Places with lasting ids and the edges between them, updated inside a region of the map (pure)."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.services.place_graph.core.skeleton.links import (
    clear_lines,
    concerned,
    joined,
    lenses,
    line_d2,
    near_pairs,
    nearest,
    thinned,
)
from prior_sg.services.place_graph.core.skeleton.places import SHIFT_UNITS, Extraction
from prior_sg.services.place_graph.core.volume.grid import UNKNOWN_D2, Box, VoxelGrid

Voxel = tuple[int, int, int]


class Place(NamedTuple):
    """One place: the voxel at its centre, squared distances (voxels) to the nearest obstacle, basis points."""

    voxel: Voxel
    d2: float  # to the nearest that observed space leads to ...
    free_d2: float  # ... or that is known behind what was not observed: no more than d2
    basis: int
    shift: Voxel = (0, 0, 0)  # from the voxel's centre to the place's, SHIFT_UNITS to a voxel

    @property
    def center(self) -> tuple[float, float, float]:
        """In voxels, from the corner of the first."""
        x, y, z = (v + 0.5 + s / SHIFT_UNITS for v, s in zip(self.voxel, self.shift, strict=True))
        return x, y, z


@dataclass(frozen=True)
class GraphRules:
    """What makes places one and what joins them, all lengths in voxels."""

    cell: int  # side of a compression cell
    merge: float  # touching places nearer than this are one
    edge: float  # smallest clearance between touching places
    reach: float  # longest edge across free space ...
    free: float  # ... its smallest clearance ...
    check: int = 0  # ... how many places in sight are looked at ...
    find: int = 0  # ... and how many of them joined; 0 = all
    overlap: float = 0.0  # smallest radius of the lens that two spheres share
    overlap_check: int = 0  # nearest places looked at for such edges; 0 = none


@dataclass
class Changes:
    """Ids that an update touched (also those that are gone), and into which place a gone one went."""

    touched: set[int] = field(default_factory=set)
    merged: dict[int, int] = field(default_factory=dict)
    opened: set[int] = field(default_factory=set)  # ids whose openings were looked at again

    def add(self, later: "Changes") -> None:
        """Changes that came after these."""
        self.touched |= later.touched
        self.merged |= later.merged
        self.opened |= later.opened


@dataclass(frozen=True)
class _Sight:
    """The distance field of a window, to look along lines."""

    d2: np.ndarray
    box: Box

    def over(self, box: Box, grid: VoxelGrid) -> "_Sight":
        """One that holds `box`: this, if it does."""
        if (box.low >= self.box.low).all() and (box.high <= self.box.high).all():
            return self
        return _Sight(grid.gather("d2", box, UNKNOWN_D2), box)

    def observed(self, voxel: Voxel) -> bool:
        """Whether a voxel of the window was observed."""
        return bool(self.d2[tuple(np.array(voxel) - self.box.low)] != UNKNOWN_D2)

    def clear(self, start: np.ndarray, stop: np.ndarray) -> bool:
        """Whether the straight line between two voxels stays in free space."""
        return line_d2(self.d2, start - self.box.low, stop - self.box.low) > 0


class PlaceGraph:
    """All places of the map, also those too isolated to be published."""

    def __init__(self, rules: GraphRules) -> None:
        self.rules = rules
        self.places: dict[int, Place] = {}
        self.edges: dict[int, dict[int, int]] = {}  # id -> neighbour -> squared clearance (voxels)
        self._touching: dict[int, set[int]] = {}  # ids whose GVD voxels touch
        self.frozen: set[int] = set()  # places whose voxels were dropped: they stay as they were until seen again
        self._columns: dict[tuple[int, int], dict[int, set[int]]] = {}  # cell (x, y) -> its z -> ids
        self._next_id = 0

    def update(self, grid: VoxelGrid, extraction: Extraction, region: Box, changed: Box) -> Changes:
        """Replace the places inside `region` (whole cells) by the extracted ones, keep ids, renew edges nearby.

        Distances have changed inside `changed` only.
        """
        sight = _Sight(extraction.field_d2, extraction.box)
        changes = Changes()
        old_ids = self.within(region)
        before = {place_id: self.places[place_id].voxel for place_id in old_ids}
        id_of, gone = self._replace(old_ids, extraction, region, sight, changes)
        self._retire(gone, extraction, id_of, sight, changes)
        stirred = self._touch(region, extraction, id_of) | (changes.touched & self.places.keys())
        ends = [before[place_id] for place_id in sorted(changes.touched & before.keys())]  # gone, or moved from there
        left = np.array(ends, np.int64).reshape(-1, 3)
        voxels = np.concatenate((self.voxels(sorted(stirred)), [changed.low, changed.high - 1], left))
        self._relink(Box.around(voxels), grid, sight, changes)
        return changes

    @property
    def next_id(self) -> int:
        """The number of the next new place; none has had it or a higher one."""
        return self._next_id

    def renumber(self, number: Mapping[int, int], next_id: int) -> None:
        """Give every place another id."""
        self.places = {number[i]: place for i, place in self.places.items()}
        self.edges = {number[a]: {number[b]: c for b, c in links.items()} for a, links in self.edges.items()}
        self._touching = {number[a]: {number[b] for b in others} for a, others in self._touching.items()}
        self.frozen = {number[i] for i in self.frozen}
        for column in self._columns.values():
            for z, ids in column.items():
                column[z] = {number[i] for i in ids}
        self._next_id = next_id

    def freeze(self, box: Box) -> None:
        """The voxels of a box were dropped: its places stay as they are until they are seen again."""
        self.frozen.update(self.within(box))

    @property
    def _reach_voxels(self) -> int:
        """How long an edge can be: as far as free space may be crossed, or as far as places that touch lie apart."""
        return int(np.ceil(max(self.rules.reach, 3 * self.rules.cell)))

    def _replace(
        self, old_ids: list[int], extraction: Extraction, region: Box, sight: _Sight, changes: Changes
    ) -> tuple[dict[int, int], list[int]]:
        """Give the extracted places of `region` its old ids, or new ones.

        Returns the id of every extracted place that has one, and the old ids that nothing took over.
        """
        inside = region.contains(extraction.voxels)
        new = np.flatnonzero(inside)
        frozen = np.array([i in self.frozen for i in old_ids], np.bool_)
        matched = _match(self.voxels(old_ids), extraction.voxels[new], frozen, self.rules, sight)
        places = _places_of(extraction, new)
        id_of: dict[int, int] = {}
        for position, index in enumerate(new.tolist()):
            if position in matched:
                id_of[index] = old_ids[matched[position]]
            else:
                id_of[index], self._next_id = self._next_id, self._next_id + 1
            place = places[position]
            if self.places.get(id_of[index]) != place:
                changes.touched.add(id_of[index])
                self._put(id_of[index], place)
        others = np.flatnonzero(~inside)
        for index, (x, y, z) in zip(others.tolist(), extraction.voxels[others].tolist(), strict=True):
            outside = self._id_at((x, y, z))
            if outside is not None:
                id_of[index] = outside
        self.frozen.difference_update(id_of.values())
        unseen = {i for i in self.frozen.intersection(old_ids) if not sight.observed(self.places[i].voxel)}
        self.frozen.difference_update(set(old_ids) - unseen)
        return id_of, sorted(set(old_ids) - set(id_of.values()) - unseen)

    def _retire(
        self, gone: list[int], extraction: Extraction, id_of: dict[int, int], sight: _Sight, changes: Changes
    ) -> None:
        """Remove places; each goes into the place that now owns its centre, else into the nearest in clear sight."""
        known = sorted(id_of)
        for place_id in gone:
            voxel = np.array(self.places[place_id].voxel, np.int64)
            owner = id_of.get(extraction.place_at(voxel))
            if owner is None and known:
                squared = ((extraction.voxels[known] - voxel) ** 2).sum(axis=1)
                nearest = known[int(squared.argmin())]
                if squared.min() <= self.rules.merge**2 and sight.clear(voxel, extraction.voxels[nearest]):
                    owner = id_of[nearest]
            if owner is not None:
                changes.merged[place_id] = owner
                self._inherit(place_id, owner)
            changes.touched.add(place_id)
            changes.touched.update(self.edges.get(place_id, ()))
            self._drop(place_id)

    def _inherit(self, place_id: int, heir: int) -> None:
        """Edges to frozen places cannot be found again; they go to whoever takes over."""
        for other in self.frozen.intersection(self.edges.get(place_id, ())):
            clearance = self.edges[place_id][other]
            self.edges.setdefault(heir, {}).setdefault(other, clearance)
            self.edges[other].setdefault(heir, clearance)

    def _touch(self, region: Box, extraction: Extraction, id_of: dict[int, int]) -> set[int]:
        """Renew which places touch, for all pairs with an end inside `region`; returns whose company changed."""
        inside = set(self.within(region)) - self.frozen
        before = {place_id: self._touching.pop(place_id, set()) for place_id in inside}
        for place_id, others in before.items():
            for other in others - inside:
                self._touching[other].discard(place_id)
        here = region.contains(extraction.voxels)[extraction.touching].any(axis=1)
        for one, two in extraction.touching[here].tolist():
            a, b = id_of.get(one), id_of.get(two)
            if a is not None and b is not None and (a in inside or b in inside):
                self._touching.setdefault(a, set()).add(b)
                self._touching.setdefault(b, set()).add(a)
        return {place_id for place_id, others in before.items() if others != self._touching.get(place_id, set())}

    def _relink(self, region: Box, grid: VoxelGrid, sight: _Sight, changes: Changes) -> None:
        """Renew the edges that a change inside `region` may concern."""
        farther = self._margin or int(np.ceil(self.rules.reach))  # witnesses, or rivals where their number is limited
        window = region.grown(self._reach_voxels + farther).clipped(grid.bounds)
        ids = [i for i in self.within(window) if i not in self.frozen]
        if not ids:
            return
        index = {place_id: n for n, place_id in enumerate(ids)}
        voxels = self.voxels(ids)
        sight = sight.over(Box.around(voxels), grid)
        renewed = self._links_within(ids, index, voxels, region, sight)
        for pair in self._concerned(ids, index, voxels, region):
            renewed.setdefault(pair, 0)
        for (a, b), clearance in renewed.items():
            if self.edges.get(a, {}).get(b, 0) != clearance:
                changes.touched.update((a, b))
            for one, two in ((a, b), (b, a)):
                if clearance:
                    self.edges.setdefault(one, {})[two] = clearance
                else:
                    del self.edges[one][two]

    def _concerned(
        self, ids: list[int], index: Mapping[int, int], voxels: np.ndarray, region: Box
    ) -> list[tuple[int, int]]:
        """Known edges, smaller id first, that a change inside `region` may concern."""
        rows = dict(index)
        all_ids = list(ids)  # and places outside: from before an end moved
        ends: list[int] = []
        for one, a in enumerate(ids):
            for b in self.edges.get(a, ()):
                two = rows.get(b)
                if two is None:
                    if b in self.frozen:
                        continue
                    two = rows[b] = len(all_ids)
                    all_ids.append(b)
                if two > one:
                    ends += (one, two)
        pairs = np.array(ends, np.int64).reshape(-1, 2)
        voxels = np.concatenate((voxels, self.voxels(all_ids[len(ids) :])))
        found = pairs[concerned(voxels, pairs, *region, self.rules.reach**2, self._margin)]
        known = ((all_ids[one], all_ids[two]) for one, two in found.tolist())
        return sorted((min(pair), max(pair)) for pair in known)

    @property
    def _margin(self) -> int:
        """Where the number of edges is limited, those of a place depend on each other: how near both ends are then."""
        limited = self.rules.check or self.rules.find or self.rules.overlap_check
        return self._reach_voxels if limited else 0

    def _links_within(
        self, ids: list[int], index: Mapping[int, int], voxels: np.ndarray, region: Box, sight: _Sight
    ) -> dict[tuple[int, int], int]:
        """Squared clearance of the edges, smaller id first, that a change inside `region` may concern."""
        flags = bytearray(len(ids) ** 2)
        for row, place_id in enumerate(ids):
            for other in self._touching.get(place_id, ()):
                if other in index:
                    flags[row * len(ids) + index[other]] = 1
        touching = np.frombuffer(flags, np.bool_).reshape(len(ids), len(ids))
        voxels = voxels - sight.box.low
        rules, low, high = self.rules, region.low - sight.box.low, region.high - sight.box.low
        limits = rules.edge**2, rules.reach**2, rules.free**2
        if not self._margin:
            pairs, clearances = joined(sight.d2, voxels, touching, low, high, *limits)
        else:
            clear = clear_lines(sight.d2, voxels, touching, *limits)
            keep = thinned(clear, voxels, touching, rules.edge**2)
            keep &= touching | nearest(clear > 0, voxels, rules.check) & nearest(keep & ~touching, voxels, rules.find)
            if rules.overlap_check:
                radii = np.sqrt([self.places[i].d2 for i in ids])
                lens2 = lenses(sight.d2, voxels, radii, rules.overlap, self._reach_voxels)
                lens2[~nearest(np.ones_like(keep), voxels, rules.overlap_check)] = 0
                clear = np.where(keep, clear, lens2)
                keep |= np.triu(lens2 > 0, 1)
            pairs = np.argwhere(keep)
            pairs = pairs[concerned(voxels, pairs, low, high, rules.reach**2, self._margin)]
            clearances = clear[tuple(pairs.T)]
        ends = zip(pairs.tolist(), clearances.tolist(), strict=True)
        return {(ids[one], ids[two]): int(clearance) for (one, two), clearance in ends}

    def voxels(self, ids: list[int]) -> np.ndarray:
        """Voxels (n, 3) at the centres of places."""
        flat = itertools.chain.from_iterable([self.places[i].voxel for i in ids])
        return np.fromiter(flat, np.int64, 3 * len(ids)).reshape(-1, 3)

    def within(self, box: Box) -> list[int]:
        """Ids of the places whose centre lies in `box`, ascending."""
        low = np.floor_divide(box.low, self.rules.cell)
        high = np.floor_divide(box.high - 1, self.rules.cell) + 1
        found: list[int] = []
        (x_low, y_low, z_low), (x_high, y_high, z_high) = low.tolist(), high.tolist()
        if (x_high - x_low) * (y_high - y_low) < len(self._columns):
            around = itertools.product(range(x_low, x_high), range(y_low, y_high))
            columns = [column for at in around if (column := self._columns.get(at)) is not None]
        else:
            items = self._columns.items()
            columns = [column for (x, y), column in items if x_low <= x < x_high and y_low <= y < y_high]
        for column in columns:
            for z, ids in column.items():
                if z_low <= z < z_high:
                    found.extend(ids)
        if not (np.concatenate(box) % self.rules.cell).any():
            return sorted(found)
        return sorted(np.array(found, np.int64)[box.contains(self.voxels(found))].tolist())

    def _id_at(self, voxel: Voxel) -> int | None:
        """The place with exactly this centre."""
        x, y, z = self._cell(voxel)
        for place_id in self._columns.get((x, y), {}).get(z, ()):
            if self.places[place_id].voxel == voxel:
                return place_id
        return None

    def _cell(self, voxel: Voxel) -> Voxel:
        x, y, z = voxel
        return x // self.rules.cell, y // self.rules.cell, z // self.rules.cell

    def _put(self, place_id: int, place: Place) -> None:
        if place_id in self.places:
            self._leave_cell(place_id)
        self.places[place_id] = place
        x, y, z = self._cell(place.voxel)
        self._columns.setdefault((x, y), {}).setdefault(z, set()).add(place_id)

    def _drop(self, place_id: int) -> None:
        self._leave_cell(place_id)
        del self.places[place_id]
        self.frozen.discard(place_id)
        for other in self.edges.pop(place_id, {}):
            self.edges[other].pop(place_id, None)
        for other in self._touching.pop(place_id, set()):
            self._touching[other].discard(place_id)

    def _leave_cell(self, place_id: int) -> None:
        x, y, z = self._cell(self.places[place_id].voxel)
        column = self._columns[x, y]
        column[z].discard(place_id)
        if not column[z]:
            del column[z]
        if not column:
            del self._columns[x, y]


def _places_of(extraction: Extraction, rows: np.ndarray) -> list[Place]:
    """The extracted places of these rows (n,)."""
    columns = (extraction.voxels, extraction.d2, extraction.free_d2, extraction.basis, extraction.shifts)
    found = zip(*(column[rows].tolist() for column in columns), strict=True)
    return [Place((x, y, z), d2, free_d2, basis, (i, j, k)) for (x, y, z), d2, free_d2, basis, (i, j, k) in found]


def _match(
    old_voxels: np.ndarray, new_voxels: np.ndarray, frozen: np.ndarray, rules: GraphRules, sight: _Sight
) -> dict[int, int]:
    """Index of the old place that each new one continues: nearest first, within a cell or its side, in clear sight.

    What lies between a `frozen` place and a new one is not known: they are one if they would merge.
    """
    matched: dict[int, int] = {}
    taken: set[int] = set()
    for squared, row, column in sorted(near_pairs(old_voxels, new_voxels, rules.cell).tolist()):
        if row in taken or column in matched:
            continue
        near = squared <= rules.merge**2 if frozen[row] else squared == 0
        if not near and not sight.clear(old_voxels[row], new_voxels[column]):
            continue
        matched[column] = row
        taken.add(row)
    return matched
