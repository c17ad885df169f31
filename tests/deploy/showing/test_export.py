"""Exports: JSON and Spark-DSG say the same, Spark-DSG's own reader agrees, the picture shows what the scene holds."""

import json

import cv2
import msgspec
import numpy as np
import pytest
import spark_dsg
from scipy.spatial.transform import Rotation

from prior_sg.deploy.showing.canvas import FREE, WALL
from prior_sg.deploy.showing.colors import PALETTE, UNLABELLED, label_colors
from prior_sg.deploy.showing.dsg import save_spark_dsg, spark_dsg_graph
from prior_sg.deploy.showing.export import (
    map_png,
    places_png,
    save_json,
    scene_json,
    zones,
)
from prior_sg.deploy.showing.places import OPENING
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene
from tests.help.paths import SHARED_DATA

DATA = SHARED_DATA
LABELS = ["hall", "kitchen", "office"]


def region(index, label, **fields):
    defaults = {"place_count": 2, "probability": 0.875, "position_m": (1.0, 2.0, 1.5), "area_m2": 6.25}
    return Region(id=index, label=label, **(defaults | fields))


def make_scene(positions, radii, place_regions, regions, *, edges=(), trajectory=(), **fields):
    count = len(positions)
    posteriors = np.zeros((count, len(LABELS)), np.float16)
    names = {entry.id: LABELS.index(entry.label) for entry in regions}
    for row, index in enumerate(place_regions):
        if index in names:
            posteriors[row] = 0.125
            posteriors[row, names[index]] = 0.75
    defaults = {"robot": "spot", "stamp_ns": 12345, "environment": "a flat", "task": "tidy up", "space": "space/1"}
    return Scene(
        prior_digest="abc",
        labels=LABELS,
        regions=list(regions),
        place_ids=np.arange(count) * 3 + 10,
        positions_m=np.array(positions, np.float32).reshape(-1, 3),
        radii_m=np.array(radii, np.float32),
        basis_points=np.full(count, 3, np.int16),
        place_regions=np.array(place_regions, np.int64),
        posteriors=posteriors,
        unknown=np.full(count, 0.25, np.float16),
        edges=np.array([(a * 3 + 10, b * 3 + 10) for a, b, _ in edges], np.int64).reshape(-1, 2),
        clearances_m=np.array([c for _, _, c in edges], np.float32),
        trajectory=np.array(trajectory, np.float32).reshape(-1, 3),
        **(defaults | fields),
    )


def flat():
    """Five places in a row: kitchen, kitchen, hall, hall, and one without a region; a second kitchen without places."""
    return make_scene(
        [(0.5, 1, 1), (1.5, 1, 1), (3, 1, 1), (4, 1, 1), (5, 1, 1.2)],
        [0.5, 0.5, 0.75, 0.5, 0.25],
        [4, 4, 7, 7, -1],
        [region(4, "kitchen"), region(7, "hall"), region(9, "kitchen", place_count=0)],
        edges=[(0, 1, 0.5), (1, 2, 0.375), (0, 2, 0.25), (2, 3, 0.5), (3, 4, 0.125)],
        trajectory=[(0, 1, 1.2), (5, 1, 1.2)],
    )


def empty():
    return make_scene([], [], [], [])


def flat_map(voxel_m=0.25):
    """A hall of 6 x 2 m with walls around, floor at 0, ceiling at 2.5 m."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in (24, 8, 10)), indexing="ij"), axis=-1).reshape(-1, 3)
    rim = ((index == 0) | (index == [23, 7, 9])).any(axis=1)
    return VoxelMap(
        robot="spot", voxel_m=voxel_m, free=index[~rim].astype(np.int16), occupied=index[rim].astype(np.int16)
    )


def test_the_offset_of_the_world_is_exported_and_positions_stay_local():
    scene = changed(flat(), origin_m=(512_345.0, 5_403_210.0, 312.0))
    assert scene_json(scene) == scene_json(flat()) | {"origin_m": [512_345.0, 5_403_210.0, 312.0]}
    metadata = spark_dsg_graph(scene).metadata.get()
    assert metadata["origin_m"] == [512_345.0, 5_403_210.0, 312.0]


def node(graph, prefix, index):
    return graph.get_node(spark_dsg.NodeSymbol(prefix, index))


def test_json_by_hand():
    data = json.loads(json.dumps(scene_json(flat())))
    assert data["places"][1] == {
        "id": 13,
        "position_m": [1.5, 1.0, 1.0],
        "radius_m": 0.5,
        "region": 4,
        "label": "kitchen",
        "posterior": {"hall": 0.125, "kitchen": 0.75, "office": 0.125},
        "unknown": 0.25,
        "predicted": False,
        "frontier": None,
        "ellipse": None,
        "hull_m": [],
    }
    assert data["places"][4]["region"] is data["places"][4]["label"] is data["places"][4]["posterior"] is None
    kitchen, hall, other = data["regions"]
    assert kitchen == {
        "id": 4,
        "label": "kitchen",
        "parent": "",
        "probability": 0.875,
        "unknown": 0.0,
        "predicted": False,
        "area_m2": 6.25,
        "position_m": [1.0, 2.0, 1.5],
        "hull_m": [],
        "places": [10, 13],
        "objects": [],
        "transitions": [],
        "adjacent": [7],
        "members": [],
    }
    assert hall["adjacent"] == [4] and other["places"] == other["adjacent"] == []
    assert data["edges"][1] == {"a": 13, "b": 16, "clearance_m": 0.375} and len(data["edges"]) == 5
    assert data["trajectory_m"] == [[0.0, 1.0, 1.2], [5.0, 1.0, 1.2]]
    assert (data["robot"], data["task"], data["environment"]) == ("spot", "tidy up", "a flat")


def test_zones_are_adjacent_regions_with_one_parent():
    """Six regions of one place each in a row: day, day, night, day, day, none; the second pair is apart."""
    parents = ["day", "day", "night", "day", "day", ""]
    regions = [region(index, "hall", parent=parent) for index, parent in enumerate(parents)]
    positions = [(index, 0, 1) for index in range(6)]
    links = [(index, index + 1, 0.5) for index in range(5)]
    scene = make_scene(positions, [0.5] * 6, range(6), regions, edges=links)
    assert zones(scene) == [("day", [0, 1]), ("night", [2]), ("day", [3, 4])]
    assert scene_json(scene)["zones"][0] == {"label": "day", "regions": [0, 1]}
    ring = make_scene(positions, [0.5] * 6, range(6), regions, edges=[*links, (0, 4, 0.5)])
    assert zones(ring) == [("day", [0, 1, 3, 4]), ("night", [2])]
    assert zones(empty()) == []


@pytest.mark.parametrize("name", ["dsg.json", "dsg.sparkdsg"])
@pytest.mark.parametrize("make", [flat, empty])
def test_spark_dsg_reads_the_same_counts(tmp_path, name, make):
    scene = make()
    save_spark_dsg(scene, tmp_path / name)
    save_json(scene, tmp_path / "scene.json")
    data = json.loads((tmp_path / "scene.json").read_text())
    graph = spark_dsg.DynamicSceneGraph.load(str(tmp_path / name))
    places, rooms = graph.get_layer("PLACES"), graph.get_layer("ROOMS")
    assert (places.num_nodes(), places.num_edges()) == (len(data["places"]), len(data["edges"]))
    assert (rooms.num_nodes(), rooms.num_edges()) == (
        len(data["regions"]),
        sum(len(r["adjacent"]) for r in data["regions"]) / 2,
    )
    assert graph.get_layer("BUILDINGS").num_nodes() == (1 if data["regions"] else 0)


def with_details():
    square = np.array([(0, 0), (2, 0), (2, 1), (0, 1)], np.float32)
    return msgspec.structs.replace(
        flat(),
        frontier_ids=np.array([13]),
        frontier_directions=np.array([(0, 1, 0)], np.float32),
        frontier_areas_m2=np.array([2.25], np.float32),
        surface_ids=np.array([10, 13, 16, 19, 22]),
        ellipses=np.tile(np.array((2.0, 0.5, np.pi / 2), np.float32), (5, 1)),
        hull_counts=np.full(5, 4),
        hulls_m=np.tile(square, (5, 1)),
    )


def test_openings_are_exported_as_frontiers():
    scene = msgspec.structs.replace(with_details(), **{k: getattr(flat(), k) for k in GROUND})
    place = json.loads(json.dumps(scene_json(scene)))["places"][1]
    assert place["frontier"] == {"direction": [0.0, 1.0, 0.0], "area_m2": 2.25} and place["ellipse"] is None
    attributes = node(spark_dsg_graph(scene), "p", 13).attributes
    assert attributes.active_frontier and attributes.frontier_scale.tolist() == [0.0, 1.5, 1.5]
    turn = attributes.orientation
    x_axis = Rotation.from_quat((turn.x, turn.y, turn.z, turn.w)).apply((1, 0, 0))
    assert x_axis == pytest.approx((0, 1, 0), abs=1e-9)
    assert not node(spark_dsg_graph(scene), "p", 16).attributes.active_frontier


GROUND = ("surface_ids", "ellipses", "hull_counts", "hulls_m")


def test_objects_hang_below_their_nearest_place(tmp_path):
    fields = {"label": "bed", "probability": 0.6, "known": 0.9, "frames": 3}
    low_m, high_m = (0.5, 0.0, 0.0), (1.5, 1.0, 0.5)
    scene = flat()
    nearest = int(np.linalg.norm(scene.positions_m - (1.0, 0.5, 0.25), axis=1).argmin())
    item = SceneObject(id=4, position_m=(1.0, 0.5, 0.25), min_m=low_m, max_m=high_m, **fields)
    scene = changed(scene, objects=[item])
    (told,) = scene_json(scene)["objects"]
    assert told == {**fields, "id": 4, "position_m": [1.0, 0.5, 0.25], "min_m": [*low_m], "max_m": [*high_m]} | {
        "place": int(scene.place_ids[nearest]),
        "members": [],
    }
    save_spark_dsg(scene, tmp_path / "dsg.json")
    graph = spark_dsg.DynamicSceneGraph.load(str(tmp_path / "dsg.json"))
    found = node(graph, "O", 4)
    assert found.attributes.name == "bed"
    np.testing.assert_allclose(found.attributes.bounding_box.dimensions, [1.0, 1.0, 0.5])
    np.testing.assert_allclose(found.attributes.bounding_box.world_P_center, [1.0, 0.5, 0.25])
    assert found.get_parent() == spark_dsg.NodeSymbol("p", int(scene.place_ids[nearest])).value


def test_places_on_the_ground_are_exported_with_hull_and_ellipse(tmp_path):
    place = json.loads(json.dumps(scene_json(with_details())))["places"][1]
    assert place["ellipse"] == {"half_axes_m": [2.0, 0.5], "angle_rad": 1.5708} and len(place["hull_m"]) == 4
    spark_dsg_graph(with_details()).save(str(tmp_path / "dsg.json"), include_mesh=False)
    graph = spark_dsg.DynamicSceneGraph.load(str(tmp_path / "dsg.json"))
    attributes = node(graph, "P", 13).attributes
    assert isinstance(attributes, spark_dsg.Place2dNodeAttributes)
    assert attributes.ellipse_matrix_expand == pytest.approx(np.array(((0, -0.5), (2.0, 0))), abs=1e-6)
    assert attributes.ellipse_matrix_compress @ attributes.ellipse_matrix_expand == pytest.approx(np.eye(2), abs=1e-6)
    assert [corner.tolist() for corner in attributes.boundary] == [[0, 0, 1], [2, 0, 1], [2, 1, 1], [0, 1, 1]]
    assert node(graph, "P", 13).get_parent() == spark_dsg.NodeSymbol("R", 4).value
    assert graph.get_edge(spark_dsg.NodeSymbol("P", 13), spark_dsg.NodeSymbol("P", 16)).info.weight == 0.375


def test_spark_dsg_hierarchy_and_attributes():
    graph = spark_dsg_graph(flat())
    parents = {i: node(graph, "p", i).get_parent() for i in (10, 13, 16, 19)}
    assert parents == {i: spark_dsg.NodeSymbol("R", r).value for i, r in ((10, 4), (13, 4), (16, 7), (19, 7))}
    assert not node(graph, "p", 22).has_parent()
    assert all(node(graph, "R", i).get_parent() == spark_dsg.NodeSymbol("B", 0).value for i in (4, 7, 9))
    place, room = node(graph, "p", 16).attributes, node(graph, "R", 7).attributes
    assert (place.distance, place.num_basis_points, place.semantic_label) == (0.75, 3, LABELS.index("hall"))
    assert place.position.tolist() == [3, 1, 1] and place.last_update_time_ns == 12345
    assert room.name == "hall" and room.semantic_class_probabilities == {
        "hall": 0.75,
        "kitchen": 0.125,
        "office": 0.125,
    }
    assert room.bounding_box.min == pytest.approx([2.25, 0.25, 0.25]) and room.bounding_box.max == pytest.approx(
        [4.5, 1.75, 1.75]
    )
    assert graph.get_edge(spark_dsg.NodeSymbol("p", 13), spark_dsg.NodeSymbol("p", 16)).info.weight == 0.375
    assert graph.has_edge(spark_dsg.NodeSymbol("R", 4), spark_dsg.NodeSymbol("R", 7))
    assert graph.metadata.get()["task"] == "tidy up"
    assert graph.get_labelspace(4, 0).labels_to_names == dict(enumerate(LABELS))


def with_labels(labels):
    return changed(empty(), labels=labels, posteriors=np.zeros((0, len(labels)), np.float16))


def changed(scene, **fields):
    return Scene(**({name: getattr(scene, name) for name in Scene.__struct_fields__} | fields))


@pytest.mark.parametrize("count", [2, len(PALETTE), 3 * len(PALETTE)])
def test_labels_of_one_scene_have_colours_of_their_own(count):
    labels = [f"label {i}" for i in range(count)]
    assert len(set(label_colors(with_labels(labels)).values())) == count


def test_a_label_keeps_its_colour_from_scene_to_scene():
    alone = label_colors(with_labels(["kitchen"]))["kitchen"]
    assert label_colors(with_labels(["kitchen", "hall"]))["kitchen"] == alone
    assert label_colors(with_labels(["office", "kitchen"]))["kitchen"] == alone


def shares(path):
    """The picture, and the share of its pixels that are near a colour."""
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB).astype(int)
    return image, lambda color: float((np.abs(image - color).max(axis=-1) <= 3).mean())


def tinted(color, under=FREE, opacity=0.62):
    return tuple(round(opacity * c + (1 - opacity) * u) for c, u in zip(color, under, strict=True))


def test_picture_shows_regions_walls_and_truth(tmp_path):
    scene, path = flat(), tmp_path / "map.png"
    map_png(scene, flat_map(), path)
    image, share = shares(path)
    assert image.shape[1] == 1600 and 500 <= image.shape[0] <= 1400
    colors = label_colors(scene)
    assert share(tinted(colors["kitchen"])) > 0.01 and share(tinted(colors["hall"])) > 0.02
    assert share(tinted(UNLABELLED)) > 0.001 and share(WALL) > 0.02
    assert share(tinted(colors["office"])) < 0.001
    assert share((255, 255, 255)) > 0.2
    truth = GroundTruth.from_json(
        {
            "floors": [{"id": 0, "z_min_m": 0, "z_max_m": 3}],
            "regions": [
                {"id": 0, "label": "hall", "floor": 0, "polygon_m": [[0.5, 0.5], [5, 0.5], [5, 1.5], [0.5, 1.5]]}
            ],
        }
    )
    map_png(scene, flat_map(), tmp_path / "truth.png", truth)
    other = cv2.imread(str(tmp_path / "truth.png")).astype(int)
    assert other.shape == image.shape
    assert (np.abs(other[..., ::-1] - image).max(axis=-1) > 60).mean() > 0.001
    map_png(scene, flat_map(), tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == path.read_bytes()


def seen_at(low, high, label=""):
    """An object whose box spans these corners."""
    middle = tuple((np.add(low, high) / 2).tolist())
    shape = {"position_m": middle, "min_m": low, "max_m": high}
    return SceneObject(id=1, label=label, probability=0.5, known=0.5, frames=3, **shape)


def test_objects_are_outlined_and_named_without_hiding_the_map(tmp_path):
    def drawn(*items):
        map_png(changed(flat(), objects=list(items)), flat_map(), tmp_path / "map.png")
        return cv2.imread(str(tmp_path / "map.png")).astype(int)[:, :1200]  # without the legend

    without = drawn()

    def changed_by(item):
        return np.abs(drawn(item) - without).max(axis=-1) > 8

    low, high = (2.0, 0.5, 0.0), (2.4, 0.9, 0.5)
    outline = changed_by(seen_at(low, high))
    assert 0 < outline.mean() < 0.01
    rows, columns = np.nonzero(outline)
    assert abs(np.ptp(rows) - np.ptp(columns)) <= 2  # a square
    assert not outline[rows.min() + 6 : rows.max() - 5, columns.min() + 6 : columns.max() - 5].any()
    named = changed_by(seen_at(low, high, "oven"))
    assert named[rows.min() + 6 : rows.max() - 5, columns.min() + 6 : columns.max() - 5].any()
    assert not changed_by(seen_at((1.0, 0.5, 0.0), (4.5, 0.9, 0.5))).any()  # wider than furniture
    assert not changed_by(seen_at((90.0, 0.5, 0.0), (91.0, 0.9, 0.5), "oven")).any()  # off the map


def test_tall_maps_lie_down(tmp_path):
    scene = flat()
    swap = [1, 0, 2]
    turned = changed(scene, positions_m=scene.positions_m[:, swap], trajectory=scene.trajectory[:, swap])
    upright = flat_map()
    tall = VoxelMap(
        robot="spot", voxel_m=0.25, free=upright.free[:, [1, 0, 2]], occupied=upright.occupied[:, [1, 0, 2]]
    )
    map_png(scene, upright, tmp_path / "wide.png")
    map_png(turned, tall, tmp_path / "tall.png")
    assert cv2.imread(str(tmp_path / "wide.png")).shape == cv2.imread(str(tmp_path / "tall.png")).shape


@pytest.mark.parametrize("make", [flat, empty])
def test_picture_without_a_map_and_without_anything(tmp_path, make):
    map_png(make(), None, tmp_path / "map.png")
    assert cv2.imread(str(tmp_path / "map.png")).shape[1] == 1600
    nothing = VoxelMap(robot="r", voxel_m=0.1, free=np.zeros((0, 3), np.int16), occupied=np.zeros((0, 3), np.int16))
    map_png(make(), nothing, tmp_path / "map.png")
    assert cv2.imread(str(tmp_path / "map.png")).shape[1] == 1600


def test_many_regions_and_long_names_fit(tmp_path):
    regions = [region(i, LABELS[i % 3], area_m2=float(i)) for i in range(60)]
    scene = make_scene([(i % 8, i // 8, 1) for i in range(60)], [0.5] * 60, range(60), regions, task="tidy " * 60)
    map_png(scene, None, tmp_path / "map.png")
    image = cv2.imread(str(tmp_path / "map.png"))
    assert (image[-20:] == 255).all() and (image[:, -20:] == 255).all()


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the shared sequences")
def test_picture_of_real_ground_truth(tmp_path):
    truth = GroundTruth.from_json(json.loads((DATA / "infinigen_home_a" / "regions.json").read_text()))
    centers = np.array([(x, y, 1.0) for x in np.arange(0, 12, 0.6) for y in np.arange(0, 16, 0.6)])
    ids = truth.region_of(centers)
    inside = ids >= 0
    regions = [region(r.id, LABELS[r.id % 3]) for r in truth.regions]
    scene = make_scene(centers[inside], [0.45] * int(inside.sum()), ids[inside], regions)
    map_png(scene, None, tmp_path / "map.png", truth)
    _, share = shares(tmp_path / "map.png")
    assert all(share(tinted(color)) > 0.02 for color in label_colors(scene).values())


def test_picture_of_places_in_three_dimensions(tmp_path):
    for name, scene in (("balls", flat()), ("ground", with_details())):
        places_png(scene, flat_map(), tmp_path / f"{name}.png")
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert picture.shape == (1100, 1600, 3)
        shown = {tuple(color) for color in picture.reshape(-1, 3)[:, ::-1].tolist()}
        expected = label_colors(scene)["kitchen"]
        assert (expected in shown) == (name == "balls")  # ellipses let the floor shine through
        assert picture.mean() < 254
    places_png(flat(), flat_map(), tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == (tmp_path / "balls.png").read_bytes()
    arrows = msgspec.structs.replace(with_details(), **{k: getattr(flat(), k) for k in GROUND})
    places_png(arrows, None, tmp_path / "arrows.png")
    picture = cv2.imread(str(tmp_path / "arrows.png"))[..., ::-1].astype(int)
    assert (np.abs(picture - OPENING).sum(axis=2) < 30).sum() > 50
