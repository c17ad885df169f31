"""The regions of the map: their ids, their figures, and which are to be described again (pure)."""

from dataclasses import dataclass, field

import numpy as np

from prior_sg.schemas.regions import Region, RegionEvent
from prior_sg.services.segmenter.core.layers.storeys import StoreyConfig, Storeys, split, storeys_of
from prior_sg.services.segmenter.core.map.place_map import MapChange, PlaceMap
from prior_sg.services.segmenter.core.map.received import with_neighbours
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
        """Regions of the labels as they are, with ids that last; returns what became of whom."""
        places, graph, previous = place_map.places, place_map.graph, place_map.places.regions
        self.storeys = storeys_of(graph, cfg)
        component = split(components.numbered(places.labels, graph.edges), graph.edges, self.storeys, cfg)
        places.regions, self.next_id = components.track(component, previous, self.next_id)
        moved = places.regions != previous
        places.unbelieved |= moved  # so that followers learn the region of places far from the change
        beside = with_neighbours(graph, moved)  # lists of neighbours name a region that came, went or grew
        self.disturbed.update(previous[moved].tolist(), places.regions[beside].tolist())
        self.reformed.update(previous[moved].tolist(), places.regions[moved].tolist())
        first = components.first_rows(component)
        numbers, label_rows = places.regions[first].tolist(), places.labels[first].tolist()
        labels = {region: names[label] for region, label in zip(numbers, label_rows, strict=True)}
        before = {region.id: region.label for region in self.known.values()}
        if not moved.any() and labels == before:
            return []
        return components.events(previous, places.regions, before, labels)

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
