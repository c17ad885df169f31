"""Formats: each is opened by a reader that is not ours and says what the scene says; hostile labels stay text."""

import csv
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ET

import msgspec
import networkx
import numpy as np
import pytest
import trimesh

import prior_sg
from prior_sg.deploy.api.scene import Scene as PublicScene
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.showing.formats import FORMATS, ExportError, named, save
from prior_sg.deploy.showing.material import Cloud, Material, Moment
from prior_sg.deploy.showing.scene_reading import scene_of_json
from prior_sg.schemas.members import MapMember
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Transition
from tests.deploy.showing.test_export import changed, flat, flat_map, region, with_details
from tests.help.homes import printed
from tests.help.paths import ROOT

HOSTILE = '</script><img src=x onerror=alert(1)>"&\x01\ud7ff'
FORMULA = "=cmd|' /C calc'!A0"

FULL_DISK = """
import json, resource, sys
from pathlib import Path
from prior_sg.deploy.showing.formats import FORMATS, ExportError
from tests.deploy.showing.test_formats import written
said, (soft, hard) = {}, resource.getrlimit(resource.RLIMIT_FSIZE)
for name in FORMATS:
    whole, less = (Path(sys.argv[1], name, part) for part in ("whole", "less"))
    for folder in (whole, less):
        folder.mkdir(parents=True)
    written(name, whole)  # what it loads is loaded
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        written(name, less)
        said[name] = ""
    except ExportError as error:
        said[name] = str(error)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
print(json.dumps(said))
"""


def told():
    """The flat with outlines, a way, an object, an offset and names that try to be more than names."""
    kitchen = region(
        4,
        FORMULA,
        hull_m=[(0.0, 0.5), (2.0, 0.5), (2.0, 1.5), (0.0, 1.5)],
        neighbour_ids=[7],
        object_ids=[4],
        transitions=[Transition(region=7, edge=(13, 16), position_m=(2.25, 1.0, 1.0), clearance_m=0.375, door=True)],
        members=[MapMember(robot=HOSTILE, session=1, id=5), MapMember(robot="ada", id=2)],
    )
    box = {"position_m": (1.0, 0.5, 0.25), "min_m": (0.5, 0.0, 0.0), "max_m": (1.5, 1.0, 0.5)}
    item = SceneObject(id=4, label=HOSTILE, probability=0.6, known=0.9, frames=3, members=kitchen.members, **box)
    labels = {"labels": ["hall", FORMULA, "office"], "regions": [kitchen, *flat().regions[1:2]]}
    return changed(
        flat(),
        objects=[item],
        markers=[printed(7, (1.0, 0.5, 1.5), (0.0, 1.0, 0.0))],
        origin_m=(512_345.0, 5_403_210.0, 312.0),
        task=HOSTILE,
        **labels,
    )


def written(name, tmp_path, scene=None, **beside):
    path = tmp_path / FORMATS[name].file
    save(Material(told() if scene is None else scene, **beside), path, name)
    return path


def test_node_link_opens_in_networkx(tmp_path):
    graph = networkx.node_link_graph(json.loads(written("node-link", tmp_path).read_text()), edges="links")
    ours = PublicScene(told()).to_networkx()
    assert networkx.is_isomorphic(graph, ours) and len(graph) == 5 + 2 + 1
    assert graph.nodes["place:13"]["position_m"] == [1.5, 1.0, 1.0] and graph.nodes["object:4"]["label"] == HOSTILE
    assert graph.nodes["place:13"]["posterior"] == {"hall": 0.125, FORMULA: 0.75, "office": 0.125}
    assert graph.edges["place:13", "place:16"] == {"kind": "way", "clearance_m": 0.375}
    assert graph.edges["place:13", "region:4"] == {"kind": "in"}
    assert graph.graph["origin_m"] == [512_345.0, 5_403_210.0, 312.0]


def test_graphml_opens_in_networkx_and_is_xml_whatever_labels_hold(tmp_path):
    path = written("graphml", tmp_path)
    ET.parse(path)
    graph = networkx.read_graphml(path)
    assert graph.nodes["object:4"]["label"] == HOSTILE.replace("\x01", "")
    place = graph.nodes["place:13"]
    assert (place["x_m"], place["radius_m"], place[f"p({FORMULA})"], place["predicted"]) == (1.5, 0.5, 0.75, False)
    assert graph.number_of_edges() == PublicScene(told()).to_networkx().number_of_edges()


def test_gltf_opens_in_trimesh(tmp_path):
    cloud = Cloud(np.array([(0, 0, 0), (1, 2, 3)], np.float32), np.array([(255, 0, 0), (0, 9, 255)], np.uint8))
    model = trimesh.load(written("gltf", tmp_path, cloud=cloud))
    turn = model.graph.get("places")[0]
    assert turn @ (0, 0, 1, 1) == pytest.approx((0, 1, 0, 1))  # our up is that of glTF
    shapes = {node: model.geometry[model.graph[node][1]] for node in model.graph.nodes_geometry}
    assert np.asarray(shapes["places"].vertices) == pytest.approx(told().positions_m)
    assert np.asarray(shapes["map"].colors)[:, :3].tolist() == cloud.colors.tolist()
    assert shapes[f"{FORMULA} 4"].area == pytest.approx(2.0)
    box = shapes[f"{HOSTILE} 4"]
    assert box.bounds.tolist() == [[0.5, 0, 0], [1.5, 1, 0.5]] and abs(box.volume) == pytest.approx(0.5)
    (line,) = shapes["edges"].entities  # trimesh strings the ends of all edges together
    ends_m = np.asarray(shapes["edges"].vertices)[line.points]
    rows = [(0, 1), (1, 2), (0, 2), (2, 3), (3, 4)]
    assert ends_m == pytest.approx(told().positions_m[rows].reshape(-1, 3))


def test_geojson_says_what_its_metres_are_of(tmp_path):
    from shapely.geometry import shape

    collection = json.loads(written("geojson", tmp_path).read_text())
    layers = {}
    for feature in collection["features"]:
        layers.setdefault(feature["properties"]["layer"], []).append(feature)
    assert {name: len(found) for name, found in layers.items()} == {
        "region": 1, "way": 1, "object": 1, "marker": 1, "place": 5, "edge": 5, "trajectory": 1,
    }  # fmt: skip
    assert all(shape(feature["geometry"]).is_valid for feature in collection["features"])
    outline = shape(layers["region"][0]["geometry"])
    assert outline.area == pytest.approx(2.0) and outline.bounds == (512345.0, 5403210.5, 512347.0, 5403211.5)
    assert layers["place"][0]["geometry"]["coordinates"] == [512345.5, 5403211.0, 313.0]
    assert layers["marker"][0]["properties"]["id"] == 7
    assert "crs" not in collection and "zone" in collection["coordinates"]
    named_system = json.loads(written("geojson", tmp_path, crs="epsg:32632").read_text())
    assert named_system["crs"]["properties"]["name"] == "urn:ogc:def:crs:EPSG::32632"
    local = json.loads(written("geojson", tmp_path, scene=flat()).read_text())
    assert local["coordinates"] == "metres of the local world, not degrees"


def test_csv_tables_hold_no_formula(tmp_path):
    folder = written("csv", tmp_path)
    tables = {path.stem: list(csv.DictReader(path.open(newline=""))) for path in folder.iterdir()}
    counts = {name: len(rows) for name, rows in tables.items()}
    assert counts == {
        "places": 5, "regions": 2, "objects": 1, "edges": 5, "beliefs": 12, "ways": 1, "frontiers": 0, "trajectory": 2,
        "markers": 1,
    }  # fmt: skip
    assert tables["places"][1]["x_m"] == "1.5" and tables["objects"][0]["label"] == HOSTILE
    assert tables["regions"][0]["label"] == f"'{FORMULA}"
    assert tables["beliefs"][1] == {"place": "10", "label": f"'{FORMULA}", "probability": "0.75"}
    wide = msgspec.structs.replace(told(), labels=["＝1+1", *told().labels[1:]])
    written("csv", tmp_path, scene=wide)
    assert "'＝1+1" in (folder / "beliefs.csv").read_text()


def test_files_nested_too_deeply_are_told(tmp_path):
    (tmp_path / "scene.json").write_text("[" * 100_000)
    with pytest.raises(prior_sg.Error, match="is not JSON"):
        PublicScene.read(tmp_path / "scene.json")


def test_rerun_reads_the_timelines(tmp_path):
    chunk = pytest.importorskip("rerun.chunk")
    earlier = changed(told(), stamp_ns=5, regions=[])
    path = written("rrd", tmp_path, moments=[Moment(3, earlier), Moment(8, told())])
    reader = chunk.RrdReader(path)
    assert [entry.application_id for entry in reader.recordings()] == ["prior-sg"]
    schema = str(reader.store().schema())
    assert "timeline:revision" in schema and "timeline:stamp" in schema
    for entity in (
        "places",
        "edges",
        "objects",
        "regions/names",
        "regions/outlines",
        "trajectory",
        "frontiers",
        "markers",
    ):
        assert f"/world/{entity}:" in schema, entity
    rows = {}
    for part in reader.store().stream().to_chunks():
        rows[str(part.entity_path)] = rows.get(str(part.entity_path), 0) + part.num_rows
    assert (rows["/world/edges"], rows["/world/regions/names"]) == (1, 2)  # what stays is not written again


@pytest.fixture(scope="module")
def refusals(tmp_path_factory):
    """What each format says when no file may be larger than 100 bytes. That limit is one of a whole process."""
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path_factory.mktemp("full"))]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True, timeout=240)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_a_disk_that_takes_no_more_is_told_by_every_format(name, refusals):
    assert re.search(r"cannot write .*; choose another place with --out", refusals[name])


@pytest.mark.parametrize("make", [flat, with_details, told])
def test_json_is_read_back(make, tmp_path):
    scene = make()
    back = scene_of_json(json.loads(written("json", tmp_path, scene=scene).read_text()))
    for name in scene.__struct_fields__:
        if name == "basis_points":
            continue
        ours, theirs = getattr(scene, name), getattr(back, name)
        if isinstance(ours, np.ndarray):
            assert ours.dtype == theirs.dtype and ours == pytest.approx(theirs, abs=1e-3), name
        elif name == "regions":  # places, neighbours and probabilities follow from the graph there
            assert [(r.id, r.label, r.hull_m, r.transitions, r.members) for r in ours] == [
                (r.id, r.label, r.hull_m, r.transitions, r.members) for r in theirs
            ]
        else:
            assert ours == theirs, name


def test_one_registry_says_what_there_is(capsys):
    assert {entry.extra for entry in FORMATS.values()} <= {"", "dsg", "foxglove", "graph", "rerun", "map"}
    assert all(callable(entry.write) and entry.summary for entry in FORMATS.values())
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    help_text = capsys.readouterr().out
    assert all(entry.name in help_text and entry.summary in help_text for entry in FORMATS.values())
    document = (ROOT / "docs" / "exports.md").read_text()
    assert all(f"| `{entry.name}` | `{entry.file}` | {entry.summary}" in document for entry in FORMATS.values())


@pytest.mark.parametrize(
    ("name", "path", "says"),
    [
        ("nonsense", "x.json", "there is no format 'nonsense'; known: json, dsg"),
        ("", "x.doc", "x.doc names no format"),
        ("gltf", "x.json", "gltf is written to a file ending in .glb"),
        ("csv", "x.csv", "csv is written to a folder"),
    ],
)
def test_a_wrong_name_or_ending_is_one_sentence(name, path, says, tmp_path):
    with pytest.raises(ExportError) as error:
        save(Material(flat()), tmp_path / path, name)
    assert says in str(error.value)


def test_a_scene_of_python_is_saved_by_its_ending_and_read_again(tmp_path):
    for name in ("a.json", "a.sparkdsg", "a.glb", "a.geojson", "a.graphml"):
        PublicScene(told()).save(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 100
    assert PublicScene.read(tmp_path / "a.json").places.ids.tolist() == told().place_ids.tolist()
    assert PublicScene.read(tmp_path / "a.sparkdsg").objects.labels.tolist() == [HOSTILE]
    assert named("", tmp_path / "a.html").name == "html"


def test_the_command_finds_the_scene_and_the_usual_place(tmp_path, capsys):
    save(Material(told(), losses=[]), tmp_path / "scene.json")
    assert main(["export", str(tmp_path), "--format", "csv"]) == 0
    assert (tmp_path / "tables" / "places.csv").exists()
    assert main(["export", str(tmp_path / "scene.json"), "--out", str(tmp_path / "other" / "x.geojson")]) == 0
    assert (tmp_path / "other" / "x.geojson").exists()
    capsys.readouterr()
    faults = [
        ([str(tmp_path / "scene.json")], "name another file with --out"),
        ([str(tmp_path / "none")], "does not exist"),
        ([str(tmp_path / "tables")], "holds no scene"),
        ([str(tmp_path / "other" / "x.geojson"), "--out", "x.json"], "is none of what holds a scene"),
    ]
    for arguments, says in faults:
        assert main(["export", *arguments]) == 1
        assert says in capsys.readouterr().err.replace("\n", " ")
    (tmp_path / "broken.json").write_text('{"nodes": 3}')
    assert main(["export", str(tmp_path / "broken.json"), "--out", str(tmp_path / "y.json")]) == 1
    assert "Spark-DSG" in capsys.readouterr().err


def test_no_walls_no_regions_no_places_still_write(tmp_path):
    bare = msgspec.structs.replace(
        flat(), regions=[], place_regions=np.full(5, -1), posteriors=np.zeros((5, 3), np.float16)
    )
    for name, entry in FORMATS.items():
        save(Material(bare, flat_map()), tmp_path / name / entry.file, name)
        assert (tmp_path / name / entry.file).exists()
