"""Names for Hydra's rooms: that of the region which most of a room's places belong to (pure)."""

from collections import Counter
from collections.abc import Mapping

from prior_sg.deploy.hydra.core.graph import NO_ROOM


def room_names(room_of: Mapping[int, int], region_of: Mapping[int, int], labels: Mapping[int, str]) -> dict[int, str]:
    """A name per room that has places in a labelled region; of equally many, the region with the smaller id counts.

    `room_of` and `region_of` tell the room and the region of places, `labels` the label of regions.
    """
    shared: dict[int, Counter[int]] = {}
    for place, room in room_of.items():
        region = region_of.get(place)
        if room != NO_ROOM and region is not None and labels.get(region):
            shared.setdefault(room, Counter())[region] += 1
    return {
        room: labels[min(counts, key=lambda region: (-counts[region], region))]
        for room, counts in sorted(shared.items())
    }
