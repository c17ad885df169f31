"""What the labels rest on beside the evidence, and what is still to be done for them (pure)."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from prior_sg.services.segmenter.core.appearance.adaptation import Adaptation
from prior_sg.services.segmenter.core.energy.solver import Solver

STILL_TICKS = 2  # without news, after which the labels are found from all that is known alone ...
PLACES_A_TICK = 10_000  # ... and one more for so many: that takes long then, and a resting camera reports every 2 s
LOOKS = 3  # into what regions hold, after a change: a region that takes a neighbour's label holds what both held


@dataclass
class Labelling:
    """The solver of the field, what this map taught about its labels, and how much of it has changed since.

    While news comes, labels go on from those before, and what the whole map teaches is left as it is while it would
    change little: both depend on what came when. Once nothing has come for a while, that is made up for: whatever the
    way there, the same evidence then has the same labels.
    """

    solver: Solver
    adaptation: Adaptation = field(default_factory=Adaptation)
    told: float = 0.0  # what the crops tell of the labels, prior_sg.services.segmenter.core.appearance.unmixing
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (label,) of the visual scores in this map
    unsurveyed: int = 0  # places that changed or left since the map was looked over; at least one if any edge did
    compared: int = 0  # places whose similarity was computed, or that left, since the bias was
    contents_count: bool = False  # what regions hold has a say
    looks_left: int = 0  # into what regions hold, before that rests until something changes
    passes: list[np.ndarray] = field(default_factory=list)  # (place,) each, of consolidating on the solver's rows
    dirty: bool = False  # something changed since the labels were found from all that is known alone
    still_ticks: int = 0  # since there was news
    under_way: Iterator[None] | None = None  # finding the labels from all that is known alone, beside those in force

    def still(self, places: int) -> bool:
        """Whether nothing new is known for a while of a map of so many places."""
        return self.still_ticks >= STILL_TICKS + places // PLACES_A_TICK

    @property
    def settled(self) -> bool:
        """Whether nothing is left to be done until there is news, or the map rests."""
        found = self.under_way is None and not self.solver.pending
        return found and not (self.compared or self.unsurveyed or self.looks_left)

    def news(self) -> None:
        """Something is known that labels may depend on."""
        self.dirty, self.still_ticks = True, 0
        self.give_up()

    def give_up(self) -> None:
        """What is under way rests on what is no longer so."""
        self.under_way = None

    def map_changed(self, left: int, touched: bool) -> None:
        """So many places left; `touched`: some came or moved, or an edge changed."""
        self.compared += left
        self.unsurveyed += left + touched  # at least one: the map is another
        self.look_into_regions()
        self.news()

    def start_afresh(self, labels: int, places: int, contents_count: bool) -> None:
        """A prior with so many labels has come into force on a map of so many places."""
        self.give_up()
        self.contents_count = contents_count
        self.bias, self.compared, self.adaptation, self.passes = np.zeros(labels), places, Adaptation(), []
        self.look_into_regions()

    def forget_appearance(self) -> None:
        """The evidence is of another embedding space."""
        self.adaptation = Adaptation()
        self.news()

    def forget_labels(self) -> None:
        """The field is solved from scratch."""
        self.solver, self.passes = Solver(self.solver.settings), []

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

    def labelled(self, anew: bool) -> None:
        """The labels are published; `anew`: found from all that is known alone."""
        self.dirty = not anew
