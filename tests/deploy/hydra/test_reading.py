"""Graphs of Hydra as columns: what Spark-DSG wrote is what comes out, features and damage stay outside."""

import os
import signal

import numpy as np
import pytest
import spark_dsg

from prior_sg.deploy.hydra import decoder
from prior_sg.deploy.hydra.decoder import Decoder, GraphRefused
from prior_sg.deploy.hydra.reading import NotAGraph, graph_columns, read_graph
from prior_sg.deploy.showing.dsg import spark_dsg_graph
from prior_sg.schemas.codec import encode
from tests.deploy.showing.test_export import flat, with_details
from tests.deploy.showing.test_formats import told
from tests.help.hydra import Symbol, add_agent, add_object, hydra_graph, weight
from tests.help.world import place_grid


def read(graph):
    return read_graph(graph.to_binary(), "r1")


@pytest.mark.parametrize("make", [flat, told])
def test_the_places_of_our_own_graphs_come_back(make):
    scene = make()
    graph = read(spark_dsg_graph(scene))
    assert graph.place_ids.tolist() == scene.place_ids.tolist()
    for name in ("positions_m", "radii_m", "basis_points"):
        assert (getattr(graph, name) == getattr(scene, name)).all(), name
    rooms = [-1 if room < 0 else room % 2**56 for room in graph.place_rooms.tolist()]
    assert rooms == scene.place_regions.tolist()
    ours = dict(zip(map(tuple, scene.edges.tolist()), scene.clearances_m.tolist(), strict=True))
    assert dict(zip(map(tuple, graph.edges.tolist()), graph.clearances_m.tolist(), strict=True)) == ours
    assert [(item.id, item.label, item.min_m, item.max_m) for item in graph.objects] == [
        (item.id, item.label, item.min_m, item.max_m) for item in scene.objects
    ]


def test_pieces_of_ground_have_their_shapes():
    scene = with_details()
    graph = read(spark_dsg_graph(scene))
    assert graph.surface_ids.tolist() == scene.surface_ids.tolist()
    assert graph.hull_counts.tolist() == scene.hull_counts.tolist()
    assert graph.hulls_m == pytest.approx(scene.hulls_m) and graph.ellipses == pytest.approx(scene.ellipses, abs=1e-5)


def test_features_of_a_thousand_numbers_stay_outside():
    positions_m, edges = place_grid(2)
    plain, rich = hydra_graph(positions_m, edges), hydra_graph(positions_m, edges, features=1024)
    assert len(rich.to_binary()) > 5 * len(plain.to_binary())
    assert encode(read(rich)) == encode(read(plain))


def test_numbers_of_nodes_do_not_depend_on_what_comes_beside_them():
    graph = hydra_graph([(0, 0, 1), (1, 0, 1)], [(0, 1)])
    before = read(graph).place_ids.tolist()
    place = spark_dsg.PlaceNodeAttributes()
    place.position, place.distance = np.zeros(3), 0.2
    graph.add_node("PLACES", Symbol("q", 1), place)
    assert read(graph).place_ids.tolist() == [*before, Symbol("q", 1).value]


def test_what_has_no_weight_no_numbers_or_no_sense_is_left_out_or_made_up_for():
    graph = hydra_graph([(0, 0, 1), (1, 0, 1), (np.nan, 0, 1), (0, 1e9, 1)], [(0, 2)], rooms=False)
    graph.insert_edge(Symbol("p", 0), Symbol("p", 1))
    add_object(graph, 1, "chair", (0, 0, 0), (1, 1, 1))
    add_object(graph, 2, "ghost", (0, 0, 0), (np.inf, 1, 1))
    columns = read(graph)
    assert columns.place_ids.tolist() == [0, 1] and columns.left_out == 3
    assert columns.edges.tolist() == [[0, 1]] and columns.clearances_m.tolist() == [0.5]  # the smaller radius
    assert [item.label for item in columns.objects] == ["chair"]


def test_agents_have_times_and_poses():
    graph = hydra_graph([(0, 0, 1)], [])
    add_agent(graph, 0, 1.5, (1, 2, 3), np.pi / 2)
    add_agent(graph, 1, 2.0, (1, 3, 3))
    columns = read(graph)
    assert columns.agent_stamps_ns.tolist() == [1_500_000_000, 2_000_000_000] and not columns.objects
    assert columns.world_from_agent[0] == pytest.approx(
        np.array([(0, -1, 0, 1), (1, 0, 0, 2), (0, 0, 1, 3), (0, 0, 0, 1)]), abs=1e-12
    )


def test_an_empty_graph_has_no_places():
    columns = graph_columns(spark_dsg.DynamicSceneGraph(), "r1")
    assert not len(columns.place_ids) and columns.stamp_ns == 0


@pytest.mark.parametrize("payload", [b"", b"\x00" * 100, b"hello, this is no graph", b"\xdd\xff\xff\xff\xff"])
def test_foreign_bytes_are_one_sentence(payload):
    with pytest.raises(NotAGraph, match=r"^\d+ bytes are no graph of Spark-DSG [\d.]+: [^\[].*"):
        read_graph(payload, "r1")


@pytest.fixture(scope="module")
def reader():
    made = Decoder("r1")
    yield made
    made.close()


def test_damaged_graphs_give_a_graph_or_one_sentence(reader, rng):
    """By hand with PSG_DAMAGED_GRAPHS=20000."""
    good = bytearray(spark_dsg_graph(told()).to_binary())
    refused = 0
    for number in range(int(os.environ.get("PSG_DAMAGED_GRAPHS", "60"))):
        damaged = good[: rng.integers(len(good))] if number % 2 else good.copy()
        for _ in range(rng.integers(1, 5)):
            if damaged:
                damaged[rng.integers(len(damaged))] = rng.integers(256)
        try:
            reader.read(bytes(damaged))
        except GraphRefused as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 0
    assert len(reader.read(bytes(good)).place_ids) == 5


def test_a_reader_that_dies_is_replaced(reader, monkeypatch):
    good = spark_dsg_graph(flat()).to_binary()
    reader.read(good)
    os.kill(next(iter(reader._pool._processes)), signal.SIGKILL)
    with pytest.raises(GraphRefused, match=f"a message of {len(good)} bytes ended its reader"):
        reader.read(good)
    assert len(reader.read(good).place_ids) == 5
    monkeypatch.setattr(decoder, "MOST_BYTES", 10)
    with pytest.raises(GraphRefused, match="send_mesh"):
        reader.read(good)


def test_a_graph_with_edges_of_other_layers_keeps_those_of_places():
    graph = hydra_graph([(0, 0, 1), (1, 0, 1)], [(0, 1)])
    graph.insert_edge(Symbol("R", 0), Symbol("p", 1), weight(9.0))
    assert read(graph).edges.tolist() == [[0, 1]]
