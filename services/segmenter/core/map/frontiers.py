"""Frontiers of places as followed: where free space ends at space that was not observed (pure)."""

from dataclasses import dataclass, field

import numpy as np

from prior_sg.schemas.places import PlaceDelta


@dataclass
class Frontiers:
    """By place id: direction towards unobserved space and the area of the opening (4,)."""

    held: dict[int, np.ndarray] = field(default_factory=dict)

    def follow(self, delta: PlaceDelta, gone_ids: np.ndarray, replaces: bool) -> None:
        """What a delta says of frontiers; an opening of no area is closed, that of a place that left is gone."""
        if replaces:
            self.held.clear()
        for place in gone_ids.tolist():
            self.held.pop(place, None)
        told = np.column_stack((delta.frontier_directions, delta.frontier_areas_m2)).astype(np.float64)
        for place, opening in zip(delta.frontier_ids.tolist(), told, strict=True):
            if opening[3] > 0:
                self.held[place] = opening
            else:
                self.held.pop(place, None)

    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Place ids (n,) ascending, directions (n, 3) and areas (n,) in square metres."""
        ids = sorted(self.held)
        held = np.array([self.held[place] for place in ids]).reshape(-1, 4)
        return np.array(ids, np.int64), held[:, :3], held[:, 3]
