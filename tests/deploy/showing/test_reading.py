"""Files of scenes that somebody wrote by hand, or that were cut off: read as they are meant, or one sentence."""

import json

import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.showing.export import scene_json
from prior_sg.deploy.showing.reading import SourceUnreadable, read_material
from tests.help import houses


def saved(path, change=lambda told: None):
    told = scene_json(houses.scene())
    change(told)
    (path / "scene.json").write_text(json.dumps(told))
    return path


@pytest.mark.parametrize("content", [b"[1", b"[1]", b"\xff\xfe{", b"3", b"[" * 100_000])
def test_scores_that_are_none_are_told_with_the_file_that_holds_them(tmp_path, content, capsys):
    (saved(tmp_path) / "metrics.json").write_bytes(content)
    assert main(["export", str(tmp_path), "--format", "text", "--out", str(tmp_path / "x.txt")]) == 1
    assert "metrics.json" in (told := capsys.readouterr().err) and "move it away" in told.replace("\n", " ")


def put(*path_and_value):
    *path, last, value = path_and_value

    def change(told):
        for step in path:
            told = told[step]
        told[last] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        put("places", 1, "region", 2**70),
        put("places", 1, "posterior", 3),
        put("edges", 0, "b", 1e30),
        put("edges", 0, "b", 999),
        put("places", 1, "id", 0),
        put("places", 0, "id", 5),
        put("labels", 0, 7),
        put("labels", "kitchen"),
        put("regions", 0, "position_m", 2, "x"),
        put("regions", 3),
        put("task", None),
        put("origin_m", [1, 2]),
    ],
)
def test_a_scene_that_is_none_is_refused_in_a_sentence(tmp_path, change):
    with pytest.raises(SourceUnreadable, match=r"scene\.json is not in the layout of scene\.json: "):
        read_material(saved(tmp_path, change), "r1")
