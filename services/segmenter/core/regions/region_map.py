"""The regions of the map: their ids, their figures, and which are to be described again (pure)."""

from dataclasses import dataclass, field

import numpy as np

from prior_sg.schemas.regions import Region, RegionEvent
from prior_sg.services.segmenter.core.layers.storeys import StoreyConfig, Storeys, floors_differ, split, storeys_of
from prior_sg.services.segmenter.core.map.arcs import arcs_from, joined
from prior_sg.services.segmenter.core.map.place_map import MapChange, PlaceMap
from prior_sg.services.segmenter.core.regions import components
from prior_sg.services.segmenter.core.regions.ledger import Ledger


@dataclass
class RegionMap:
    """Regions by id, and what followers know of them."""

    next_id: int = 0
    known: dict[int, Region] = field(default_factory=dict)
    disturbed: set[int] = field(default_factory=set)  # regions whose beliefs, ways or objects may have changed
    reformed: set[int] = field(default_factory=set)  # regions whose places came, went or moved
    storeys: Storeys | None = None  # as of the last partition
    ledger: Ledger = field(default_factory=Ledger)

    def inherit(self, regions: list[Region], next_id: int) -> None:
        """These regions were known before this process; nothing has been told yet."""
        self.known = {region.id: region for region in regions}
        self.reformed.update(self.known)
        self.next_id = max(self.next_id, next_id)
        self.ledger = Ledger()

    def disturb(self, regions: np.ndarray) -> None:
        """Beliefs, ways or objects of these regions (place,) may have changed."""
        self.disturbed.update(regions.tolist())

    def follow(self, change: MapChange, place_map: PlaceMap) -> None:
        """Regions whose places left or were told anew are to be described again, and followers to forget the former."""
        self.disturbed.update(change.gone_regions.tolist())
        self.reformed.update(change.gone_regions.tolist())
        self.ledger.forget(change.gone_slots)
        self.reformed.update(place_map.places.regions[change.step.upserted].tolist())

    def partition(self, place_map: PlaceMap, names: list[str], cfg: StoreyConfig) -> list[RegionEvent]:
        """Regions of the labels as they are, with ids that last; returns what became of whom.

        A region is found again with all that its label joins it to, where any of that was marked, or is beside a mark.
        Whatever gains or loses a place is among these, and nobody else has places of theirs.
        """
        places, graph, before = place_map.places, place_map.graph, self.storeys
        self.storeys = storeys_of(graph, cfg)
        if before is not None and floors_differ(before.floors_m, self.storeys.floors_m):
            places.unparted[:] = True
        rows, edges = joined(places.labels, graph.arcs, np.flatnonzero(places.unparted))
        places.unparted[:] = False
        component = split(components.numbered(places.labels[rows], edges), edges, self.storeys.at(rows), cfg)
        former = places.regions[rows]
        now, self.next_id = components.track(component, former, self.next_id)
        places.regions[rows] = now
        moved = now != former
        places.unbelieved[rows[moved]] = True  # so that followers learn the region of places far from the change
        beside = graph.arcs.neighbours[arcs_from(graph.arcs, rows[moved])]  # they list a region that came, went or grew
        self.reformed.update(former[moved].tolist(), now[moved].tolist())
        self.disturbed.update(former[moved].tolist(), now[moved].tolist(), places.regions[beside].tolist())
        first = components.first_rows(component)
        label_rows = places.labels[rows[first]].tolist()
        labels = {region: names[label] for region, label in zip(now[first].tolist(), label_rows, strict=True)}
        others = {*former.tolist(), *labels, *self.reformed} & self.known.keys()
        return components.events(former, now, {region: self.known[region].label for region in others}, labels)

    def parts(self, place_map: PlaceMap, cfg: StoreyConfig) -> np.ndarray:
        """The regions that the labels as they are make, as numbers (place,) that do not last."""
        labels, edges = place_map.places.labels, place_map.graph.edges
        inside = edges[labels[edges[:, 0]] == labels[edges[:, 1]]]
        return split(components.numbered(labels, inside), inside, storeys_of(place_map.graph, cfg), cfg)

    def wanted(self, everything: bool) -> np.ndarray:
        """Mask (region id,) of those to be described again; the last entry is that of no region."""
        mask = np.zeros(self.next_id + 1, dtype=bool)
        mask[list(self.disturbed)] = True
        return mask | everything

    def describe(self, found: dict[int, Region]) -> None:
        """These are the regions of the map: each is described as it is."""
        self.known = found
        self.disturbed.clear()
        self.reformed.clear()
