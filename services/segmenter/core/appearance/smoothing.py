"""Evidence shared along the place graph (beyond the paper; pure).

What one place looks like is told by few crops, and a weak encoder errs on most of them; what a neighbourhood looks like
is told by many. So a place is compared with the regions by the average over its surroundings: `steps` times, each place
takes over the share `share` of the trust-weighted mean of its neighbours. Walls hold evidence back, for no edge of the
place graph crosses one.

Step j of a place needs step j - 1 of its neighbours, so a change reaches `steps` edges far, and what it makes of those
places depends on others up to twice as far away.
"""

import msgspec
import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.map.arcs import Arcs, ball


class SharingConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How far evidence is shared. Chosen on the development sequences with perturbed priors."""

    steps: int = 6  # 0 = every place for itself (paper)
    share: float = 0.8  # of the neighbours' mean in each step
    trust_limit: float = 5.0  # sum of trust above which a place counts no more: a few good looks
    gain: float = 1.4  # of the averages: errors that cancel take some of the spread with them

    def __post_init__(self) -> None:
        if not (self.steps >= 0 and 0 <= self.share <= 1 and self.trust_limit > 0 and self.gain > 0):
            raise ValueError("steps, share, trust_limit or gain is out of range")


def shared(own: np.ndarray, trust: np.ndarray, ties: Arcs, *, rows: np.ndarray, cfg: SharingConfig) -> np.ndarray:
    """Averages (row, column) of `own` (place, column) around the places `rows`, times the gain; `trust` (place,)
    weighs places, `ties` weigh edges. Where nothing around has trust, zeros; without steps, `own`."""
    if not cfg.steps:
        return own[rows]
    masses = np.minimum(trust, cfg.trust_limit)
    averages = _shared(own, masses, ties.starts, ties.neighbours, ties.weights, rows, cfg.steps, cfg.share)
    return cfg.gain * averages


def reached(near: Arcs, mask: np.ndarray, steps: int) -> np.ndarray:
    """Rows within `steps` edges of the places in `mask`, these included."""
    return ball(np.flatnonzero(mask), steps, near.starts, near.neighbours, np.zeros(len(mask), bool))


@compiled()
def _shared(own, masses, starts, neighbours, weights, rows, steps, share):  # noqa: ANN001, ANN202, PLR0917
    """Sums of mass times value and sums of mass travel alike; their ratio is the average.

    Places at the rim of the ball lack neighbours, but their error needs as many steps as it is far from `rows`.
    """
    around = ball(rows, steps, starts, neighbours, np.zeros(len(masses), np.bool_))
    index_of = np.full(len(masses), -1, np.int64)
    index_of[around] = np.arange(len(around))
    columns = own.shape[1]
    sums = np.empty((len(around), columns + 1))
    for index in range(len(around)):
        sums[index, :columns] = masses[around[index]] * own[around[index]]
        sums[index, columns] = masses[around[index]]
    for _ in range(steps):
        before = sums.copy()
        for index in range(len(around)):
            total = 0.0
            mean = np.zeros(columns + 1)
            for at in range(starts[around[index]], starts[around[index] + 1]):
                other = index_of[neighbours[at]]
                total += weights[at]
                if other >= 0:
                    for column in range(columns + 1):
                        mean[column] += weights[at] * before[other, column]
            if total > 0:
                for column in range(columns + 1):
                    sums[index, column] = (1 - share) * before[index, column] + share * mean[column] / total
    averages = np.zeros((len(rows), columns))
    for number in range(len(rows)):
        mass = sums[index_of[rows[number]], columns]
        if mass > 0:
            averages[number] = sums[index_of[rows[number]], :columns] / mass
    return averages
