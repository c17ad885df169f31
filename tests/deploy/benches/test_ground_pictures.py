"""Pictures of 2D places: each colour stands where its ground lies, each floor has a panel."""

import numpy as np

from prior_sg.deploy.benches import ground_pictures
from prior_sg.deploy.benches.ground_pictures import MISSED, RIGHT, UNSEEN, WHITE, WRONG, Seen, drawn


def square(x_m: float, y_m: float, z_m: float, side_m: float) -> np.ndarray:
    steps = np.arange(0.05, side_m, 0.1)
    x, y = np.meshgrid(x_m + steps, y_m + steps)
    return np.column_stack((x.ravel(), y.ravel(), np.full(x.size, z_m)))


def share(panel: np.ndarray, color: tuple[int, int, int]) -> float:
    return float((panel == color).all(axis=-1).mean())


def test_each_floor_shows_what_is_true_missed_and_wrong():
    truth = np.concatenate((square(0, 0, 0.0, 4.0), square(0, 0, 3.0, 4.0)))
    seen = truth[(truth[:, 0] < 2) & (truth[:, 2] < 1)]  # half of the lower floor, nothing of the upper
    right, wrong = square(0, 0, 0.0, 1.0), square(2, 2, 3.2, 2.0)
    tops, true = [right, wrong], [np.ones(len(right), bool), np.zeros(len(wrong), bool)]
    picture = drawn(Seen(truth, seen, tops, true), np.array((0.0, 3.0)), cell_m=0.1, voxel_m=0.1)
    below = picture[ground_pictures.LEGEND_PX :]
    side = below.shape[0]
    lower, upper = below[:, :side], below[:, side : 2 * side]
    assert share(lower, UNSEEN) > 2 * share(lower, RIGHT) > 0
    assert share(lower, MISSED) > 2 * share(lower, RIGHT)
    assert share(lower, WRONG) == 0
    assert share(upper, WRONG) > 0.1 and share(upper, RIGHT) == share(upper, MISSED) == 0
    inner = slice(side // 8, side // 4)
    assert share(lower[-side // 4 : -side // 8, inner], RIGHT) > 0.9  # the origin is below on the left
    assert share(below[:, 2 * side :], WHITE) == 1.0  # the legend is wider
