"""Questions as methods: of a scene in memory, of a saved one, of a running system, and on the command line."""

import json
import math
import re
import shlex

import msgspec
import numpy as np
import pytest

import prior_sg
from prior_sg.deploy.api.client import Client
from prior_sg.deploy.api.scene import Scene
from prior_sg.deploy.api.vectors import RecentVectors
from prior_sg.deploy.benches.queries import synthetic_scene
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.cli.query import _require_some
from prior_sg.deploy.errors import UserError
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import TextEmbeddings
from prior_sg.schemas.foresight import Foresight, MissingLabel
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.members import MapMember
from prior_sg.schemas.priors import PriorList
from prior_sg.schemas.queries import SceneQuery, Spot
from prior_sg.schemas.topics import PRIOR, PRIORS, SCENE_QUERY, TEXT
from prior_sg.services.runtime.bus import Hub, LocalBus
from prior_sg.services.runtime.record import LogWriter
from prior_sg.services.scene_store.core.queries.answering import reply
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.ranking import calibrated
from tests.deploy.api.test_scene import message
from tests.help.foreseen import foresight
from tests.help.homes import marked_home
from tests.help.world import prior

ROBOT = "ada"
PRIOR_OF_SCENE = prior(["kitchen", "hall"], environment="home", task="tidy up")
AXES = {"kitchen": 0, "hall": 1, "oven": 0, "cook": 0, "leave": 1}


def vectors(phrases):
    """Whatever names a kitchen's things lies along one axis, a hall's along another."""
    rows = np.full((len(phrases), 3), 0.1, np.float32)
    for row, phrase in zip(rows, phrases, strict=True):
        for word, axis in AXES.items():
            row[axis] += word in phrase
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


class Told(Scene):
    """A scene whose texts are embedded here."""

    asked: list

    def embed(self, space, phrases):
        self.asked = [*getattr(self, "asked", []), list(phrases)]
        return vectors(phrases)


@pytest.fixture
def scene():
    return Told(message(prior_digest=PRIOR_OF_SCENE.digest()), PRIOR_OF_SCENE)


def test_positions_labels_and_neighbours(scene):
    assert [one.id for one in scene.near((2.0, 0.0, 1.0), k=2, what="place")] == [3, 2]
    assert [one.label for one in scene.near(np.array([0.0, 0.0, 0.0]), label="Oven")] == ["oven"]
    assert scene.near((9.0, 9.0, 9.0), radius_m=1.0) == []
    assert [(one.what, one.id) for one in scene.within((0.0, 0.0, 1.0), 0.5)] == [("region", 4), ("object", 9)]
    assert [one.id for one in scene.in_box((0.5, -1.0, 0.0), (3.0, 1.0, 2.0), what="place")] == [2, 3]
    assert [one.id for one in scene.labelled("KITCHEN")] == [4]
    assert [one.id for one in scene.objects_in("kitchen", "oven")] == [9]
    assert [one.thing.id for one in scene.neighbours("region", 4)] == [7]
    assert scene.describe("place", 1).place.radius_m == pytest.approx(0.5)
    assert [one.label for one in scene.candidates(4).beliefs] == ["kitchen", "hall"]


def test_what_cannot_be_understood_names_what_is_nearest(scene):
    with pytest.raises(prior_sg.NotInSceneError, match="the nearest labels are: kitchen"):
        scene.labelled("kitchn")
    with pytest.raises(prior_sg.NotInSceneError, match="no region 3"):
        scene.candidates(3)


NONE_MAY_HOLD = [
    lambda asked: asked.near((0, 0, 0), k=-1),
    lambda asked: asked.near((0, 0, 0), what="planet"),
    lambda asked: asked.within((1e308, 0, 0), 1e308, what="place"),
    lambda asked: asked.within((0, 0, 0), -1.0),
    lambda asked: asked.route("kitchen", "hall", clearance_m=-1.0),
    lambda asked: asked.labelled("a" * 3000),
]


@pytest.mark.parametrize("ask", NONE_MAY_HOLD)
def test_what_no_question_may_hold_is_refused_by_saved_scenes_and_clients_alike(scene, ask):
    with Client(robot=ROBOT, bus=LocalBus(Hub())) as client:
        for asked in (scene, client):
            with pytest.raises(ValueError, match=r"Expected|Invalid"):
                ask(asked)


def test_numbers_of_numpy_are_taken(scene):
    assert scene.describe("place", scene.places.ids[0]).place.radius_m == pytest.approx(0.5)
    assert scene.route(Spot(what="place", id=np.int64(1)), (2, 0, 1)).found


def test_a_route_between_whatever_names_a_place(scene):
    ends = ["oven", scene.region("kitchen"), scene.message.objects[0], scene.labelled("oven")[0], (0, 0, 1)]
    for end in ends:
        assert scene.route(end, "hall").place_ids == [1, 2]
    assert scene.route(Spot(what="place", id=1), (2, 0, 1)).length_m == pytest.approx(2)
    assert "the widest one has 0.25 m" in scene.route((0, 0, 1), (2, 0, 1), clearance_m=0.3).reason


def test_what_changed_between_two_scenes(scene):
    later = Scene(msgspec.structs.replace(scene.message, regions=scene.message.regions[:1], objects=[]))
    found = later.difference(scene)
    assert [(one.what, one.id) for one in found.gone] == [("region", 7), ("object", 9)]


def test_texts_are_answered_by_what_regions_and_objects_mean(scene):
    cook, leave = scene.find("cook"), scene.find("leave", what="region")
    assert cook[0].label in ("kitchen", "oven") and leave[0].label == "hall"
    assert {one.what for one in cook} == {"region", "place", "object"}
    assert all(0 < one.score < 1 for one in cook)
    assert scene.find("cook") == cook
    assert scene.asked[0][0] == "cook" and scene.asked[1:] == [["leave"]], "each phrase is embedded once"


def test_of_vectors_those_used_last_are_kept():
    asked = []

    def embed(space, phrases):
        asked.append((space, phrases))
        return vectors(phrases)

    kept = RecentVectors(2)
    assert kept.of("s", ["oven", "hall", "oven"], embed).keys() == {"oven", "hall"}
    kept.of("s", ["oven"], embed)
    kept.of("s", ["leave"], embed)
    assert kept.of("s", ["oven"], embed)["oven"].tolist() == vectors(["oven"])[0].tolist()
    assert kept.of("s", ["hall", "a", "b"], embed).keys() == {"hall", "a", "b"}, "more than are kept"
    kept.of("t", ["b"], embed)
    assert asked == [("s", ["oven", "hall"]), ("s", ["leave"]), ("s", ["hall", "a", "b"]), ("t", ["b"])]


def test_a_score_of_one_half_stands_where_it_was_fitted():
    assert calibrated(0.3) == pytest.approx(0.5)
    assert calibrated(1.0) == pytest.approx(1 / (1 + math.exp(2.5 * math.log(0.3))))
    assert calibrated(0.1) < calibrated(0.2) < calibrated(0.9)


def test_without_an_encoder_words_are_compared_and_that_is_said():
    with pytest.warns(UserWarning, match="word by word.*no encoder serves"):
        found = Scene(message(space="sim/0.3")).find("in the kitchen")
    assert found[0].label == "kitchen"
    with pytest.warns(UserWarning, match="nothing has been seen"):
        Scene(message(space="")).find("in the kitchen")


def test_without_its_prior_names_stand_alone_and_that_is_said():
    with pytest.warns(UserWarning, match="not at hand"):
        assert Told(message()).find("kitchen", what="region")[0].label == "kitchen"


def test_a_running_system_gives_the_same_answers(scene):
    hub = Hub()
    bus = LocalBus(hub)
    index = Index(msgspec.structs.replace(scene.message, revision=5))
    bus.serve(
        SCENE_QUERY.key.format(robot=ROBOT),
        lambda request: request.reply(encode(reply(index, decode(SceneQuery, request.payload)))),
    )
    bus.serve(PRIORS.key, lambda request: request.reply(encode(PriorList(priors=[PRIOR_OF_SCENE]))))
    bus.serve(TEXT.key.format(space="s"), lambda request: request.reply(encode(embedded(request.payload))))
    with Client(robot=ROBOT, bus=LocalBus(hub)) as client:
        assert client.find("cook") == scene.find("cook")
        assert client.near((2.0, 0.0, 1.0), what="place") == scene.near((2.0, 0.0, 1.0), what="place")
        assert client.route("oven", "hall") == scene.route("oven", "hall")
        assert client.answers().revision == 5
        with pytest.raises(prior_sg.NotInSceneError, match="revision 2 is not kept; the scene is at revision 5"):
            client.changed_since(2)


def embedded(payload):
    request = decode(TEXT.request, payload)
    found = vectors([phrases[0] for phrases in request.concepts])
    none = np.zeros(len(found), np.float32)
    return TextEmbeddings(
        space="s", embeddings=found, background_mean=none, background_std=none + 1, temperature=1.0, null_score=0.0
    )


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    log = LogWriter(folder / "log.mcap")
    log.attach("scene.msgpack", "application/msgpack", encode(message(prior_digest=PRIOR_OF_SCENE.digest())))
    log.add(PRIOR, PRIOR.key_of(PRIOR_OF_SCENE), encode(PRIOR_OF_SCENE), "gateway", 0, 1, 1)
    log.close()
    return folder


def test_a_saved_scene_is_as_it_was_with_its_prior(saved):
    for path in (saved, saved / "log.mcap"):
        found = prior_sg.Scene.read(path, ROBOT)
        assert found.message == message(prior_digest=PRIOR_OF_SCENE.digest())
        assert found.prior == PRIOR_OF_SCENE


def asked(capsys, saved, *words):
    status = main(["query", *words, "--scene", str(saved), "--robot", ROBOT])
    out, err = capsys.readouterr()
    return status, out, err


def test_the_command_answers_in_tables_and_json(capsys, saved):
    status, out, _ = asked(capsys, saved, "near", "-1.0", "0", "0.5", "--object", "oven")
    assert status == 0 and "oven" in out
    status, out, _ = asked(capsys, saved, "route", "place:1", "0,0,1", "--json")
    assert json.loads(out)["answer"]["place_ids"] == [1]
    for words in (
        ["region", "4"],
        ["place", "1"],
        ["object", "9"],
        ["label", "hall"],
        ["objects", "oven", "in", "kitchen"],
    ):
        status, out, _ = asked(capsys, saved, *words)
        assert status == 0 and ("kitchen" in out or "hall" in out or "oven" in out)
    for words in (["within", "0", "0", "1", "1"], ["in-box", "0", "0", "0", "2", "2", "2"]):
        status, out, _ = asked(capsys, saved, *words, "--what", "place", "--json")
        assert status == 0 and len(json.loads(out)["answer"]) >= 2


def test_the_command_says_what_is_made_of_what(capsys, tmp_path):
    parts = [MapMember(robot="r1", id=3), MapMember(robot="r2", session=1, id=8)]
    scene, path = message(), tmp_path / "scene.json"
    regions = [msgspec.structs.replace(scene.regions[0], members=parts), scene.regions[1]]
    objects = [msgspec.structs.replace(scene.objects[0], members=parts[1:])]
    Scene(message(regions=regions, objects=objects)).save(path)
    assert "; made of r1 #3, r2 (session 1) #8" in asked(capsys, path, "region", "4")[1]
    assert "; made of r2 (session 1) #8" in " ".join(asked(capsys, path, "object", "9")[1].split())
    assert "made of" not in asked(capsys, path, "region", "7")[1]


def test_the_command_tells_where_markers_are(capsys, tmp_path):
    path = tmp_path / "scene.json"
    Scene(marked_home()).save(path)

    def ask(*words):
        status = main(["query", *words, "--scene", str(path)])
        out, err = capsys.readouterr()
        return status, " ".join((out or err).split())

    status, out = ask("marker", "7", "--json")
    (found,) = json.loads(out)["answer"]
    assert status == 0 and found["marker"]["position_m"] == [4.45, 1.0, 1.5] and found["region"]["label"] == "kitchen"
    assert "kitchen (region 3)" in ask("marker", "7")[1] and "bedroom" not in ask("marker", "7")[1]
    assert "2 spots" in ask("marker")[1] and "kitchen (region 3)" in ask("marker")[1]
    status, out = ask("marker", "8")
    assert status == 1 and "there is no marker 8; the scene has marker 7 (apriltag_36h11)" in out
    assert "say `marker NUMBER`" in ask("marker", "seven")[1]
    assert "through kitchen 3" in ask("route", "place:10", "marker:7")[1]
    scene = prior_sg.Scene.read(path)
    (found,) = scene.markers(7)
    assert scene.route("place:10", found.marker).found
    elsewhere = msgspec.structs.replace(found.marker, dictionary="4x4_50")
    assert "no marker 7 of the dictionary '4x4_50'" in scene.route("place:10", elsewhere).reason


@pytest.mark.parametrize("robots", [None, 5, "r1", [1, 2], [["r1"]]])
def test_a_file_whose_merged_robots_are_no_names_is_refused(capsys, tmp_path, robots):
    path = tmp_path / "scene.json"
    Scene(message()).save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"merged_of": robots}))
    status, _, err = asked(capsys, path, "missing")
    assert status == 1 and "is not in the layout of scene.json" in " ".join(err.split())


def test_the_command_tells_what_was_not_seen(capsys, tmp_path):
    scene = message(foresight=foresight(message(), 2, "hall"))
    path = tmp_path / "scene.json"
    Scene(scene).save(path)
    status, out, _ = asked(capsys, path, "unseen", "Hall", "--start", "place:1", "--json")
    answer = json.loads(out)["answer"]
    assert (
        status == 0 and answer["prospects"][0]["opening"]["place_id"] == 3 and answer["route"]["place_ids"] == [1, 2, 3]
    )
    status, out, _ = asked(capsys, path, "unseen", "hall")
    assert status == 0 and "predicted" in out and "adjacency 0.75" in out
    assert "`in 6 m` for every 10 m" in " ".join(out.split()), "what was told before openings told what they lead to"
    status, out, _ = asked(capsys, path, "missing")
    assert status == 0 and "hall" in out and "0.50" in out
    status, _, err = asked(capsys, path, "unseen", "garage")
    assert status and "knows no region 'garage'" in err
    assert Scene(scene).missing()[0].label == "hall"


def test_the_table_of_the_unseen_shows_what_it_is_in_the_order_of(capsys, tmp_path):
    foreseen = foresight(message(), 2, "hall")
    (opening,) = foreseen.openings
    told = [msgspec.structs.replace(entry, toward=0.75) for entry in opening.labels]
    foreseen = msgspec.structs.replace(foreseen, openings=[msgspec.structs.replace(opening, labels=told)])
    Scene(message(foresight=foreseen)).save(tmp_path / "scene.json")
    _, out, _ = asked(capsys, tmp_path / "scene.json", "unseen", "hall", "--start", "place:3")
    out = " ".join(out.split())
    assert "7.50" in out and "0.75" in out and "the chance that the nearest unseen hall is come to through" in out
    assert "`leads there` for every 10 m of the way and of a look behind (1.0 m)" in out


def crowded():
    """A scene of which every list is longer than one."""
    scene = synthetic_scene(600, 50)
    label, other = scene.labels[:2]
    opening = foresight(scene, 40, label).openings[0]
    openings = [opening, *foresight(scene, 300, label).openings]
    missing = [MissingLabel(label=name, probability=0.5) for name in (label, other)]
    nodes = [LevelNode(level="zone", id=n, label="ward", probability=1.0, member_ids=[n], area_m2=9.0) for n in (1, 2)]
    foreseen = Foresight(openings=openings, missing=missing, steps=3, look_m=1.0, elsewhere_m=9.0)
    return msgspec.structs.replace(scene, markers=marked_home().markers, nodes=nodes, foresight=foreseen)


@pytest.mark.parametrize(
    ("words", "total"),
    [
        ("room kind", None),
        ("near 1 1 1", 50),
        ("near 1 1 1 --what place", 600),
        ("near 1 1 1 --what region", 4),
        ("within 1 1 1 99", 54),
        ("in-box 0 0 0 99 99 9", 54),
        ("label 'room kind 1' --what place", None),
        ("objects", 50),
        ("level zone", 2),
        ("region 2", 20),
        ("marker", 2),
        ("unseen 'room kind 0' --start place:3", 2),
        ("missing", 2),
    ],
)
def test_what_a_list_leaves_out_is_counted_and_the_way_to_it_told(capsys, tmp_path, words, total):
    path = tmp_path / "scene.json"
    Scene(crowded()).save(path)

    def ask(*more):
        assert main(["query", *shlex.split(words), "--scene", str(path), *more]) == 0
        return " ".join(capsys.readouterr().out.split())

    (left,) = re.findall(r"and (\d+) more[ a-z]*: --limit (\d+) lists all", ask("--limit", "1"))
    assert int(left[0]) + 1 == int(left[1]) == (total or int(left[1]))
    assert json.loads(ask("--limit", "1", "--json"))["notes"][-1].startswith(f"and {left[0]} more")
    assert "lists all" not in ask("--limit", left[1])


def test_whoever_wants_all_is_told_that_there_is_more():
    (one, _) = marked_home().markers
    many = Scene(message(markers=[msgspec.structs.replace(one, id=number) for number in range(150)]))
    with pytest.warns(UserWarning, match="100 of 150 are listed; limit=150 lists all") as said:
        found = many.markers()
    assert len(found) == 100 and found.total == 150 and said[0].filename == __file__
    assert many.markers(limit=3).total == 150 and many.markers(limit=150)[-1].marker.id == 149
    assert many.near((0.0, 0.0, 0.0), what="place").total == 3
    assert many.near((0.0, 0.0, 0.0), what="place", radius_m=1.1).total == 1


@pytest.mark.parametrize("words", [("near", "nan", "0", "0"), ("near", "1e12", "0", "0"), ("region", "9" * 30)])
def test_what_no_question_may_hold_is_one_sentence(capsys, saved, words):
    status, _, err = asked(capsys, saved, *words)
    assert status and "Traceback" not in err and any(said in err for said in ("finite", "Expected", "64 bits"))


def test_a_sentence_is_any_other_question_and_what_stands_in_is_said(capsys, saved):
    status, out, _ = asked(capsys, saved, "where", "is", "the", "kitchen?", "--json")
    found = json.loads(out)
    assert status == 0 and found["answer"][0]["label"] == "kitchen" and "word by word" in found["notes"][0]


def test_a_robot_of_whom_nothing_is_stored_is_told():
    hub, index = Hub(), Index(message(regions=[], objects=[]))
    LocalBus(hub).serve(
        SCENE_QUERY.key.format(robot="*"),
        lambda request: request.reply(encode(reply(index, decode(SceneQuery, request.payload)))),
    )
    with Client(robot="adda", bus=LocalBus(hub)) as client, pytest.raises(UserError, match="of a robot 'adda'"):
        _require_some(client)


def test_why_nothing_answers_is_said(capsys, tmp_path):
    bare = message(
        task="", regions=[], objects=[], labels=[], posteriors=np.zeros((3, 0), np.float16), merged_of=["r1", "r2"]
    )
    Scene(bare).save(tmp_path / "scene.json")
    status, out, _ = asked(capsys, tmp_path / "scene.json", "kitchen")
    assert status == 0 and "follow the tasks of r1, r2, and none of them was given any" in " ".join(out.split())


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["near", "the", "window"], "a sentence goes in quotes"),
        (["region", "kitchen"], "such as `prior-sg query region 7`"),
        (["object", "oven"], "such as `prior-sg query object 7`"),
        (["marker", "seven"], "such as `prior-sg query marker 7`"),
        (["marker", "7²"], "say `marker NUMBER`, such as `prior-sg query marker 7`"),
        (["region"], "say `region NUMBER`, such as `prior-sg query region 7`"),
        (["object"], "say `object NUMBER`"),
        (["place", "a", "b"], "say `place NUMBER`"),
        (["near"], "say `near X Y Z`, such as `prior-sg query near 1.0 2.0 0.5`"),
        (["within", "1", "2"], "say `within X Y Z RADIUS`, such as"),
        (["in-box"], "say `in-box X Y Z X Y Z`, such as"),
        (["label"], "say `label LABEL`, such as `prior-sg query label kitchen`; a sentence goes in quotes"),
        (["label", " "], "say `label LABEL`"),
        (["unseen"], "say `unseen LABEL`, such as `prior-sg query unseen bathroom`"),
        (["objects", "chair", "in"], "say `objects LABEL in REGION`, such as"),
        (["level"], "say `level zone|floor|"),
        (["level", "attic"], "such as `prior-sg query level zone ward`"),
        (["route"], "say `route FROM TO`"),
        ([""], 'say `"SENTENCE"`, such as `prior-sg query "somewhere to sit"`'),
        (["changed"], "say `changed NUMBER`"),
        (["changed", "yesterday"], "say `changed NUMBER`, such as `prior-sg query changed 120`"),
        (["label", "kitchn"], "nearest labels are: kitchen"),
        (["changed", "3"], "ask the running store"),
        (["route", "kitchen"], "say `route FROM TO`, such as `prior-sg query route kitchen 'dining room'`"),
        (["chairs", "--limit", "0"], "at least 1"),
        (["chairs", "--limit", "9999999"], "at most 100000"),
        (["route", "kitchen", "hall", "--clearance", "nan"], "--clearance is in metres"),
        (["route", "kitchen", "hall", "--clearance=-1"], "--clearance is in metres"),
        (["unseen", "hall", "--start", ""], "an end of a route is"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(capsys, saved, words, reason):
    if reason.startswith("say "):  # at once, with no system that runs and no scene
        assert main(["query", *words, "--connect", "tcp/127.0.0.1:1"]) == 2
        assert reason in " ".join(capsys.readouterr().err.split())
    status, _, err = asked(capsys, saved, *words)
    assert status == (1 if "nearest labels" in reason else 2) and reason in " ".join(err.split())
