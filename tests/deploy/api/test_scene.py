"""A scene as columns, plain Python, graph and tables."""

import json

import numpy as np
import pytest

import prior_sg
from prior_sg.deploy.api import scene as api
from prior_sg.deploy.api.scene import Scene
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene as SceneMessage

LABELS = ["kitchen", "hall"]


def region(number, label, area_m2, **fields):
    return Region(
        id=number, label=label, place_count=1, probability=0.75, position_m=(1.0, 2.0, 3.0), area_m2=area_m2, **fields
    )


def message(**changes):
    fields = {
        "robot": "ada",
        "stamp_ns": 5,
        "environment": "home",
        "task": "tidy up",
        "prior_digest": "d",
        "space": "s",
        "labels": LABELS,
        "regions": [region(4, "kitchen", 2.0, neighbour_ids=[7], object_ids=[9]), region(7, "hall", 1.0)],
        "place_ids": np.array([1, 2, 3]),
        "positions_m": np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1]], np.float32),
        "radii_m": np.array([0.5, 0.6, 0.7], np.float32),
        "basis_points": np.full(3, 3, np.int16),
        "place_regions": np.array([4, 7, -1]),
        "posteriors": np.array([[0.75, 0.25], [0.25, 0.75], [0, 0]], np.float16),
        "unknown": np.array([0, 0, 1], np.float16),
        "edges": np.array([[1, 2], [2, 3]]),
        "clearances_m": np.array([0.25, 0.5], np.float32),
        "trajectory": np.zeros((2, 3), np.float32),
        "predicted_ids": np.array([2]),
        "objects": [
            SceneObject(
                id=9,
                label="oven",
                probability=0.5,
                known=0.9,
                position_m=(0.0, 0.0, 0.5),
                min_m=(-0.25, 0.0, 0.0),
                max_m=(0.25, 0.5, 1.0),
                frames=3,
            )
        ],
    }
    return SceneMessage(**(fields | changes))


EMPTY = message(
    task="",
    labels=[],
    regions=[],
    objects=[],
    posteriors=np.zeros((3, 0), np.float16),
    place_regions=np.full(3, -1),
    predicted_ids=np.zeros(0, np.int64),
)


def test_columns():
    scene = Scene(message())
    assert scene.places.labels.tolist() == ["kitchen", "hall", ""]
    assert scene.places.predicted.tolist() == [False, True, False]
    assert (scene.regions.ids.tolist(), scene.regions.labels.tolist()) == ([4, 7], ["kitchen", "hall"])
    assert scene.objects.max_m.tolist() == [[0.25, 0.5, 1.0]] and scene.objects.frames.tolist() == [3]
    assert [len(scene.places), len(scene.regions), len(scene.objects)] == [3, 2, 1]


def test_it_says_what_is_inside():
    assert repr(Scene(message())) == (
        "<Scene of ada, 'tidy up' in 'home': 3 places, 2 edges, 2 regions (hall, kitchen), 1 objects>"
    )
    assert "no task" in repr(Scene(EMPTY)) and "0 regions (none)" in repr(Scene(EMPTY))


def test_a_region_is_found_by_id_or_label_the_largest_first():
    scene = Scene(message(regions=[region(4, "kitchen", 1.0), region(7, "kitchen", 2.0)]))
    assert scene.region("kitchen").id == 7 and scene.region(4).id == 4
    with pytest.raises(prior_sg.NotInSceneError, match=r"no region 'garage'; it has: 4 kitchen, 7 kitchen"):
        scene.region("garage")


def test_json_is_that_of_an_export(tmp_path):
    scene = Scene(message())
    text = scene.to_json(tmp_path / "scene.json")
    assert json.loads(text) == json.loads((tmp_path / "scene.json").read_text()) == scene.to_dict()
    assert [place["label"] for place in scene.to_dict()["places"]] == ["kitchen", "hall", None]
    with pytest.raises(prior_sg.SaveError, match="choose another file"):
        scene.to_json(tmp_path / "nowhere" / "scene.json")


def test_graph():
    pytest.importorskip("networkx")
    graph = Scene(message()).to_networkx()
    kinds = {frozenset(pair): kind for *pair, kind in graph.edges(data="kind")}
    assert kinds == {
        frozenset({("place", 1), ("place", 2)}): "way",
        frozenset({("place", 2), ("place", 3)}): "way",
        frozenset({("place", 1), ("region", 4)}): "in",
        frozenset({("place", 2), ("region", 7)}): "in",
        frozenset({("region", 4), ("region", 7)}): "way",
        frozenset({("region", 4), ("object", 9)}): "in",
    }
    assert graph.nodes["place", 2]["label"] == "hall" and graph.nodes["object", 9]["position_m"] == [0.0, 0.0, 0.5]
    assert graph.edges[("place", 1), ("place", 2)]["clearance_m"] == 0.25


@pytest.mark.parametrize("found", [message(), EMPTY])
def test_tables(found):
    pytest.importorskip("pandas")
    tables = Scene(found).to_pandas()
    assert {name: len(table) for name, table in tables.items()} == {
        "places": 3,
        "regions": len(found.regions),
        "objects": len(found.objects),
        "edges": 2,
    }
    places = tables["places"]
    assert places.loc[2, "x_m"] == 1.0 and {"min_x_m", "max_z_m"} <= set(tables["objects"].columns)
    known = places["probability"].notna()
    assert known.tolist() == [bool(label) for label in places["label"]]
    assert places["probability"][known].tolist() == [0.75] * known.sum()


def test_an_absent_package_is_one_sentence():
    with pytest.raises(prior_sg.PackageMissingError, match="it needs no_such_package: run `pip install"):
        api._package("no_such_package", "it")
