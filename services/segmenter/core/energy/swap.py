"""Minimisation of the field's energy by alpha-beta-swap (paper, Topological Regularization and Graph Cuts; pure).

`minimise` is for a field met for the first time; a field that changes is followed by `incremental.Solver`.
"""

import msgspec
import numpy as np

from prior_sg.services.segmenter.core.energy.mrf import Field, conditional_costs, energy
from prior_sg.services.segmenter.core.energy.solver import Settings, Solver

__all__ = ["Field", "conditional_costs", "energy", "minimise"]


def minimise(field: Field, labels: np.ndarray, settings: Settings | None = None) -> np.ndarray:
    """Labels (place,) from which no alpha-beta-swap lowers the energy; it is at most that of `labels`.

    Message passing proposes a labelling for the whole field, which replaces `labels` wherever that lowers the energy;
    then swaps run until none is left that gains. (An idle `Solver` goes on from there.)
    """
    solver = Solver(msgspec.structs.replace(settings or Settings(), worn_share=np.inf))
    solver.take(field, labels)
    return solver.drain()
