"""What lists and pictures leave out is said."""

import re

import numpy as np
import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.cli.prior_actions import some_of
from prior_sg.deploy.showing import map as picture
from prior_sg.deploy.showing.legend import object_row


@pytest.mark.parametrize(("names", "said"), [((), ""), (("a", "b"), "a, b"), (("a", "b", "c", "d"), "a, b and 2 more")])
def test_a_list_says_how_much_it_leaves_out(names, said):
    assert some_of(names, 2) == said


def test_a_prior_says_how_much_of_it_is_not_shown(capsys):
    assert main(["priors", "show", "--environment", "residential home"]) == 0
    held = " ".join(capsys.readouterr().out.split()).split(" holds ")[1:]
    assert re.search(r" and \d+ more touches .+ looks like ", held[0])


def test_names_of_objects_without_room_are_counted(monkeypatch):
    drawn = []
    monkeypatch.setattr(picture, "_outlined_text", lambda view, text, box, size, rim: drawn.append(text))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    marks = [picture._Mark(square + at, name) for at, name in ((0.0, "chair"), (0.0, "table"), (5.0, "bed"), (0.0, ""))]
    view = picture.View(np.zeros(2), np.full(2, 8.0))
    assert picture._draw_object_names(view, marks, []) == 1
    assert sorted(drawn) == ["bed", "chair"]
    assert object_row(1) == "object (1 names left out)" and object_row(0) == "object"
