"""What the labels rest on beside the evidence, and what is still to be done for them (pure)."""

from dataclasses import dataclass, field

import numpy as np

from prior_sg.services.segmenter.core.appearance.adaptation import Adaptation
from prior_sg.services.segmenter.core.energy.solver import Solver

LOOKS = 3  # into what regions hold, after a change: a region that takes a neighbour's label holds what both held


@dataclass
class Labelling:
    """The solver of the field, what this map taught about its labels, and how much of it has changed since."""

    solver: Solver
    adaptation: Adaptation = field(default_factory=Adaptation)
    told: float = 0.0  # what the crops tell of the labels, prior_sg.services.segmenter.core.appearance.unmixing
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (label,) of the visual scores in this map
    unsurveyed: int = 0  # places that changed or left since the map was looked over; at least one if any edge did
    compared: int = 0  # places whose similarity was computed, or that left, since the bias was
    contents_count: bool = False  # what regions hold has a say
    looks_left: int = 0  # into what regions hold, before that rests until something changes
    passes: list[np.ndarray] = field(default_factory=list)  # (place,) each, of consolidating on the solver's rows
    dirty: bool = False  # something changed since the last solution

    def map_changed(self, left: int, touched: bool) -> None:
        """So many places left; `touched`: some came or moved, or an edge changed."""
        self.compared += left
        self.unsurveyed += left + touched  # at least one: the map is another
        self.look_into_regions()
        self.dirty = True

    def start_afresh(self, labels: int, places: int, contents_count: bool) -> None:
        """A prior with so many labels has come into force on a map of so many places."""
        self.contents_count = contents_count
        self.bias, self.compared, self.adaptation, self.passes = np.zeros(labels), places, Adaptation(), []
        self.look_into_regions()

    def forget_appearance(self) -> None:
        """The evidence is of another embedding space."""
        self.adaptation, self.dirty = Adaptation(), True

    def look_into_regions(self) -> None:
        """Objects or places are others: what regions hold is to be weighed, and again after they have changed by it."""
        self.looks_left = LOOKS if self.contents_count else 0

    def looked_into_regions(self, moved: bool) -> None:
        """What regions hold was weighed; `moved`: it says something else than before."""
        self.looks_left = self.looks_left - 1 if moved else 0

    def survey_due(self, seen: int, rests: bool, patience: float) -> bool:
        """Whether enough of `seen` observed places changed to look at them again; if so, that counts as done."""
        due = bool(rests and self.unsurveyed) or self.unsurveyed > patience * seen
        if due:
            self.unsurveyed = 0
        return due

    def bias_due(self, seen: int, idle: bool, patience: float) -> bool:
        """Whether enough of `seen` observed places changed to find the bias again; if so, that counts as done."""
        due = bool(self.compared) and (idle or self.compared > patience * seen)
        if due:
            self.compared = 0
        return due

    def labelled(self) -> None:
        """The labels are published; what was not finished remains to be done."""
        self.dirty = self.solver.pending > 0 or self.compared > 0 or self.unsurveyed > 0 or self.looks_left > 0
