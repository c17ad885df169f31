"""How right labels are before anybody has been near: accuracy by distance, and how early a label was right.

A place is ahead until its first close look, as one of NEARNESS has it. While it is ahead it is filed by its distance to
the nearest camera position so far, and counts once in each band, with the first label that it has there; places outside
of the true regions, and those without a label, do not count.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

BANDS_M = (0.0, 2.0, 4.0, 6.0, 9.0, 14.0)  # where bands begin; the last has no end
NEAR_M = 1.0
NEARNESS = {  # when a place has had a close look
    "seen": "until what ours saw of it makes its label more than a prediction",
    "visited": f"until a camera was within {NEAR_M:g} m, however well it was seen from afar",
}
NO_LABEL = -1  # a place that carries none, or lies in no true region


@dataclass(frozen=True)
class Stop:
    """The places at one moment of a walk, the same for every method."""

    stamp_s: float
    travelled_m: float  # length of the camera's path so far
    place_ids: np.ndarray  # (place,)
    true_labels: np.ndarray  # (place,) number of the true region's label, NO_LABEL = in none
    distances_m: np.ndarray  # (place,) to the nearest camera position so far
    close: np.ndarray  # (place,) bool: has had a close look


@dataclass(frozen=True)
class Ahead:
    """What one method said of places ahead of it, over one walk or several."""

    counts: np.ndarray  # (band,) places that had their first label in a band
    right: np.ndarray  # (band,) those whose label was right
    places: int  # labelled while ahead
    settled: int  # of these, whose first label was also their last
    leads_s: np.ndarray  # (place,) from the first right label to the first close look
    leads_m: np.ndarray  # (place,) the camera's path in between

    @property
    def accuracy(self) -> np.ndarray:
        """Share (band,) of right labels, NaN in empty bands."""
        return np.where(self.counts > 0, self.right / np.maximum(self.counts, 1), np.nan)

    def table(self) -> dict[str, Any]:
        """For JSON; None where there is nothing to average."""
        bands = zip(band_names(), self.counts.tolist(), self.right.tolist(), strict=True)
        return {
            "bands": {
                name: {"places": count, "accuracy": right / count if count else None} for name, count, right in bands
            },
            "places": self.places,
            "settled": self.settled / self.places if self.places else None,
            "right_before_near": len(self.leads_s),
            "lead_s": float(np.median(self.leads_s)) if len(self.leads_s) else None,
            "lead_m": float(np.median(self.leads_m)) if len(self.leads_m) else None,
        }


def band_names() -> list[str]:
    """What the bands are called, in metres."""
    ends = [f"{low:g}–{high:g}" for low, high in pairwise(BANDS_M)]
    return [*ends, f">{BANDS_M[-1]:g}"]


def score(stops: Sequence[Stop], labels: Sequence[np.ndarray]) -> Ahead:
    """Judge the labels (place,) that a method had at each stop. Raises ValueError when they do not fit the stops."""
    counts, right = np.zeros(len(BANDS_M), np.int64), np.zeros(len(BANDS_M), np.int64)
    counted: set[tuple[int, int]] = set()
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    first_right: dict[int, Stop] = {}
    first_close: dict[int, Stop] = {}
    for stop, given in zip(stops, labels, strict=True):
        if len(given) != len(stop.place_ids):
            raise ValueError(f"{len(given)} labels for {len(stop.place_ids)} places")
        bands = np.searchsorted(BANDS_M, stop.distances_m, side="right") - 1
        columns = (stop.place_ids, bands, stop.true_labels, given, stop.close)
        for place, band, true, label, close in zip(*(column.tolist() for column in columns), strict=True):
            if close:
                first_close.setdefault(place, stop)
            if NO_LABEL in (true, label):
                continue
            last[place] = label
            if place in first_close:
                continue
            first.setdefault(place, label)
            if label == true:
                first_right.setdefault(place, stop)
            if (place, band) not in counted:
                counted.add((place, band))
                counts[band] += 1
                right[band] += label == true
    led = [place for place in first_right if place in first_close]
    return Ahead(
        counts=counts,
        right=right,
        places=len(first),
        settled=sum(last[place] == label for place, label in first.items()),
        leads_s=np.array([first_close[place].stamp_s - first_right[place].stamp_s for place in led]),
        leads_m=np.array([first_close[place].travelled_m - first_right[place].travelled_m for place in led]),
    )


def joined(parts: Iterable[Ahead]) -> Ahead:
    """Several walks as one; there is at least one."""
    walks = list(parts)
    return Ahead(
        counts=np.sum([walk.counts for walk in walks], axis=0),
        right=np.sum([walk.right for walk in walks], axis=0),
        places=sum(walk.places for walk in walks),
        settled=sum(walk.settled for walk in walks),
        leads_s=np.concatenate([walk.leads_s for walk in walks]),
        leads_m=np.concatenate([walk.leads_m for walk in walks]),
    )
