"""What is known and believed of each place, in the order of the graph's rows (pure)."""

from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.segmenter.core.map.received import Step, realigned

UNLABELLED = -1

_FILLS: dict[str, tuple[float | bool, str]] = {  # what a new place gets, and the column's type
    "slots": (-1, "int64"),
    "labels": (UNLABELLED, "int64"),
    "cut_labels": (UNLABELLED, "int64"),
    "regions": (NO_REGION, "int64"),
    "solved": (-1, "int64"),
    "own_similarity": (0.0, "float64"),
    "similarity": (0.0, "float64"),
    "correction": (0.0, "float64"),
    "contents": (0.0, "float64"),
    "unary": (0.0, "float64"),
    "posteriors": (0.0, "float32"),
    "sight": (0.0, "float64"),
    "inclination_rad": (0.0, "float64"),
    "support": (0.0, "float64"),
    "anisotropy": (0.0, "float64"),
    "stale": (True, "bool"),
    "unshared": (True, "bool"),
    "reshaped": (True, "bool"),
    "doubtful": (True, "bool"),
    "unsettled": (True, "bool"),
    "unparted": (True, "bool"),
    "unbelieved": (True, "bool"),
}
_PER_LABEL = ("own_similarity", "similarity", "correction", "contents", "unary", "posteriors")
_AFTER_A_SWITCH = ("stale", "unshared", "doubtful", "unsettled", "unparted", "unbelieved")


@dataclass
class Places:
    """Columns (place,) or (place, label). The masks say what is to be done again; whoever does it clears them."""

    slots: np.ndarray  # of the evidence
    labels: np.ndarray  # UNLABELLED = not yet
    cut_labels: np.ndarray  # those of the graph cuts, before regions that do not pay for themselves are given away
    regions: np.ndarray
    solved: np.ndarray  # row in the field that the solver has seen last, -1 = new to it
    own_similarity: np.ndarray  # (place, label) standardised
    similarity: np.ndarray  # (place, label) its average over the neighbours
    correction: np.ndarray  # (place, label) to be added: what all crops together say, as of the last look over the map
    contents: np.ndarray  # (place, label) what the objects of its region say, as of the last look over the regions
    unary: np.ndarray  # (place, label)
    posteriors: np.ndarray  # (place, label)
    sight: np.ndarray  # confidence of the visual expert
    inclination_rad: np.ndarray  # of the local surface
    support: np.ndarray
    anisotropy: np.ndarray
    stale: np.ndarray  # evidence changed: compare with the labels again
    unshared: np.ndarray  # its own similarity or its edges changed: share again around it
    reshaped: np.ndarray  # graph changed nearby: find the local surface again
    doubtful: np.ndarray  # what an expert looks at changed: ask the experts again
    unsettled: np.ndarray  # costs changed: look for a better label
    unparted: np.ndarray  # its label, its edges or where it stands changed: find the regions around it again
    unbelieved: np.ndarray  # costs or a neighbour's label changed: find the posterior again

    def looks(self, rows: np.ndarray) -> np.ndarray:
        """How much (row, label) the places `rows` look like each label, all considered."""
        return self.similarity[rows] + self.correction[rows]

    @classmethod
    def none(cls) -> "Places":
        """No places, no labels."""
        return cls(**{name: np.zeros((0, 0) if name in _PER_LABEL else 0, kind) for name, (_, kind) in _FILLS.items()})

    def realigned(self, step: Step) -> "Places":
        """The same on the rows of the next graph."""
        if step.same_rows:
            return self
        columns = {name: realigned(getattr(self, name), step.previous, fill) for name, (fill, _) in _FILLS.items()}
        return Places(**columns)

    def relabelled(self, count: int) -> "Places":
        """The same places before anything is known of `count` new labels; regions stay, for their ids may live on."""
        rows, columns = len(self.labels), {name: getattr(self, name) for name in _FILLS}
        columns |= {name: np.zeros((rows, count), _FILLS[name][1]) for name in _PER_LABEL}
        columns |= {name: np.ones(rows, dtype=bool) for name in _AFTER_A_SWITCH}
        return Places(**(columns | {name: np.full(rows, UNLABELLED) for name in ("labels", "cut_labels")}))
