"""Spark-DSG both ways: our files come back equal, and a graph as Hydra makes it becomes a scene."""

import numpy as np
import pytest
import spark_dsg

from prior_sg.deploy.showing.dsg import save_spark_dsg
from prior_sg.deploy.showing.dsg_reading import load_spark_dsg, scene_of_graph
from prior_sg.schemas.codec import encode
from tests.deploy.showing.test_export import changed, flat, with_details
from tests.deploy.showing.test_formats import told
from tests.help.examples import MARKER
from tests.help.foreseen import foresight

Symbol = spark_dsg.NodeSymbol


def sorted_edges(scene):
    order = np.lexsort(scene.edges.T[::-1])
    return changed(scene, edges=scene.edges[order], clearances_m=scene.clearances_m[order])


def with_opening():
    return changed(
        flat(),
        frontier_ids=np.array([13]),
        frontier_directions=np.array([(0.6, 0, 0.8)], np.float32),
        frontier_areas_m2=np.array([2.3], np.float32),
        predicted_ids=np.array([16, 19]),
        foresight=foresight(flat(), 0, "hall"),
        markers=[MARKER],
        merged_of=["r1", "r2"],
    )


@pytest.mark.parametrize("name", ["dsg.json", "dsg.sparkdsg"])
@pytest.mark.parametrize("make", [flat, told, with_opening])
def test_our_own_files_come_back_byte_for_byte(make, name, tmp_path):
    scene = sorted_edges(make())
    save_spark_dsg(scene, tmp_path / name)
    assert encode(load_spark_dsg(tmp_path / name)) == encode(scene)
    graph = spark_dsg.DynamicSceneGraph.load(str(tmp_path / name))
    assert graph.get_layer("PLACES").num_nodes() == len(scene.place_ids)
    predicted = [node.id.category_id for node in graph.get_layer("PLACES").nodes if node.attributes.is_predicted]
    assert sorted(predicted) == scene.predicted_ids.tolist()


def test_pieces_of_ground_come_back(tmp_path):
    save_spark_dsg(with_details(), tmp_path / "dsg.json")
    back, ours = load_spark_dsg(tmp_path / "dsg.json"), with_details()
    for name in ("surface_ids", "hull_counts", "hulls_m", "ellipses", "positions_m", "radii_m", "basis_points"):
        assert getattr(back, name) == pytest.approx(getattr(ours, name), abs=1e-5), name


def hydra():
    """Two rooms of three places, one object, one building; rooms named by a labelspace, nothing of ours."""
    graph = spark_dsg.DynamicSceneGraph()
    for index in range(4):
        place = spark_dsg.PlaceNodeAttributes()
        place.position, place.distance, place.num_basis_points = [float(index), 0.0, 1.0], 0.5, 2
        place.active_frontier, place.frontier_scale = index == 3, np.array((0.0, 2.0, 0.5))
        graph.add_node("PLACES", Symbol("p", index), place)
    for a, b in ((0, 1), (1, 2), (2, 3)):
        graph.insert_edge(Symbol("p", a), Symbol("p", b))
    item = spark_dsg.ObjectNodeAttributes()
    item.position, item.name, item.last_update_time_ns = [3.0, 0.0, 0.5], "sofa", 77
    item.bounding_box = spark_dsg.BoundingBox(np.array((1.0, 0.5, 0.5)), np.array((3.0, 0.0, 0.5)))
    graph.add_node("OBJECTS", Symbol("O", 0), item)
    graph.insert_edge(Symbol("p", 3), Symbol("O", 0))
    for index, places in ((0, (0, 1)), (1, (2, 3))):
        room = spark_dsg.RoomNodeAttributes()
        room.position, room.semantic_label = [index * 2.0 + 0.5, 0.0, 1.0], index + 5
        if index:
            room.semantic_class_probabilities = {"lounge": 0.7, "hall": 0.3}
        graph.add_node("ROOMS", Symbol("R", index), room)
        for place in places:
            graph.insert_edge(Symbol("R", index), Symbol("p", place))
    graph.insert_edge(Symbol("R", 0), Symbol("R", 1))
    building = spark_dsg.SemanticNodeAttributes()
    building.name = "B 42"
    graph.add_node("BUILDINGS", Symbol("B", 0), building)
    graph.insert_edge(Symbol("B", 0), Symbol("R", 0))
    graph.set_labelspace(spark_dsg.Labelspace({5: "hall", 6: "lounge"}), 4, 0)
    return graph


@pytest.mark.parametrize("name", ["hydra.json", "hydra.sparkdsg"])
def test_a_graph_as_hydra_makes_it(name, tmp_path):
    hydra().save(str(tmp_path / name), include_mesh=False)
    scene = load_spark_dsg(tmp_path / name)
    assert scene.place_ids.tolist() == [0, 1, 2, 3] and scene.place_regions.tolist() == [0, 0, 1, 1]
    assert scene.positions_m[:, 0].tolist() == [0, 1, 2, 3] and scene.radii_m.tolist() == [0.5] * 4
    assert scene.edges.tolist() == [[0, 1], [1, 2], [2, 3]]
    hall, lounge = scene.regions
    assert (hall.label, hall.probability, hall.neighbour_ids, hall.object_ids) == ("hall", 1.0, [1], [])
    assert (lounge.label, lounge.neighbour_ids, lounge.object_ids) == ("lounge", [0], [0])
    assert lounge.probability == pytest.approx(0.7) and lounge.place_count == 2
    assert 1.5 < lounge.area_m2 < 1.65 and len(lounge.hull_m) > 4  # two discs of 0.5 m that touch: 1.57
    (sofa,) = scene.objects
    assert (sofa.label, sofa.min_m, sofa.max_m) == ("sofa", (2.5, -0.25, 0.25), (3.5, 0.25, 0.75))
    assert scene.frontier_ids.tolist() == [3] and scene.frontier_areas_m2.tolist() == [1.0]
    assert scene.frontier_directions == pytest.approx(np.array([(1, 0, 0)]))
    assert (scene.environment, scene.stamp_ns, scene.labels) == ("B 42", 77, ["hall", "lounge"])
    assert not scene.posteriors.any()


def test_nodes_of_two_prefixes_keep_apart():
    """Agents of several robots number their nodes alike; ids are then whole symbols."""
    graph = hydra()
    other = spark_dsg.PlaceNodeAttributes()
    other.position = [9.0, 0.0, 1.0]
    graph.add_node("PLACES", Symbol("q", 0), other)
    scene = scene_of_graph(graph)
    assert len(set(scene.place_ids.tolist())) == 5
    assert Symbol("q", 0).value in scene.place_ids.tolist() and len(scene.edges) == 3


def test_what_is_no_graph_is_told(tmp_path):
    (tmp_path / "x.sparkdsg").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="cannot be read as a Spark-DSG graph"):
        load_spark_dsg(tmp_path / "x.sparkdsg")
