"""What `prior-sg bench markers` counts, on small houses; and papers on rendered walls."""

from pathlib import Path

import numpy as np
import pytest

from prior_sg.deploy.benches import main, markers
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.partial_walks import PartialMap
from prior_sg.deploy.evaluation.printed import wall_spots
from prior_sg.deploy.fleet.core.finding.frames import level
from prior_sg.deploy.fleet.core.finding.matching import map_of
from tests.help import houses, room
from tests.help.markers import on_wall

MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))
HALL, BEDROOM = on_wall((5.0, 5.45, 1.4), -np.pi / 2), on_wall((0.05, 7.0, 1.4), 0.0)
WIDE = [(name, 1.3 * x, y, 1.3 * u, v) for name, x, y, u, v in houses.ROOMS]


def hung(seed, rooms=houses.ROOMS, pose=MOVED, told=MOVED):
    """One house, of which both parts are the whole; `told` = how the second is said to lie."""
    spots = {1: HALL, 2: BEDROOM}
    first, second = houses.scene(rooms=rooms, things=[]), houses.scene("r2", pose, rooms=rooms, things=[])
    held = tuple({n: houses.marker(n, own @ spot) for n, spot in spots.items()} for own in (np.eye(4), pose))
    parts = PartialMap(first, np.eye(4), None), PartialMap(second, told, None)
    return markers.Hung(seed, parts, (map_of(first), map_of(second)), held)


def test_right_answers_are_right_and_wrong_ones_wrong():
    found = markers.figures([hung(1)])
    assert (found["papers_of_both"], found["one_tried"], found["one_right"], found["all_right"]) == (2, 2, 2, 1)
    assert found["one_error_m_max"] < 0.1
    lying = markers.figures([hung(1, told=level(0.3, np.zeros(3)) @ MOVED)])
    assert (lying["one_right"], lying["one_wrong"], lying["all_wrong"]) == (0, 2, 1)


def test_papers_that_mislead_are_counted():
    """Both papers of a house under one number contradict its walls; those of a house under two names do not."""
    same = markers.misled([hung(1), hung(2)], 1000)
    assert (same["twin_pairs"], same["twin_accepted"], same["different_pairs"]) == (4, 0, 16)
    assert same["different_accepted"] == 8  # one paper of each, for the houses are one
    assert markers.misled([hung(1), hung(2, WIDE)], 5)["different_pairs"] == 5


def test_papers_hang_upright_on_walls_and_look_into_the_room():
    poses = [room.pose(0.5, 0.0, 1.2, heading_deg) for heading_deg in (0, 90, 180, 270)]
    spots = [spot for pose in poses for spot in wall_spots(room.depth_of(pose), room.CAMERA, pose)]
    assert len(spots) > 4
    for spot in spots:
        assert spot[:3, 1] == pytest.approx((0, 0, 1)) and spot[:3, :3] @ spot[:3, :3].T == pytest.approx(np.eye(3))
        assert spot[:3, 2] @ spot[:3, 3] < 0


def test_worlds_are_of_one_kind():
    with pytest.raises(EvaluationError, match="markers walks worlds of one kind"):
        main.markers(main.Asked(paths=[Path("world:home:80"), Path("world:office:1-2")]))
