"""Questions about a scene, against exhaustive search and networkx."""

import itertools

import msgspec
import networkx as nx
import numpy as np
import pytest

from prior_sg.deploy.benches.queries import KINDS, LABELS, changed, synthetic_scene
from prior_sg.schemas import queries as q
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Task
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.topics import SCENE_QUERY
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.scene_store import service
from prior_sg.services.scene_store.core import graph, telling
from prior_sg.services.scene_store.core.queries.answering import answer, reply
from prior_sg.services.scene_store.core.queries.index import Index
from tests.help.examples import QUESTIONS

SCENE = msgspec.structs.replace(synthetic_scene(1500, 300), revision=7)
INDEX = Index(SCENE)
CENTRES = SCENE.positions_m.astype(np.float64)
MIDDLE = tuple(CENTRES.mean(axis=0).tolist())


def place_delta(revision, places):
    """places: (id, x, y, z, radius)."""
    rows = np.array(places, np.float32)
    pairs, none = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    return PlaceDelta(
        robot="spot",
        epoch=1,
        revision=revision,
        stamp_ns=1000 * (revision + 1),
        frame_id=revision,
        place_ids=rows[:, 0].astype(np.int64),
        positions_m=rows[:, 1:4],
        radii_m=rows[:, 4],
        basis_points=np.full(len(rows), 2, np.int16),
        removed_ids=none,
        merged_ids=pairs,
        edges=pairs,
        clearances_m=np.zeros(0, np.float32),
        removed_edges=pairs,
    )


def points(count, seed=0):
    low, high = CENTRES.min(axis=0) - 1, CENTRES.max(axis=0) + 1
    return [tuple(point) for point in np.random.default_rng(seed).uniform(low, high, (count, 3)).tolist()]


def distances(what, point):
    """By id, one by one."""
    if what == "object":
        return {
            item.id: np.linalg.norm(np.array(point) - np.clip(point, item.min_m, item.max_m)) for item in SCENE.objects
        }
    away = np.linalg.norm(CENTRES - point, axis=1)
    if what == "place":
        return dict(zip(SCENE.place_ids.tolist(), away.tolist(), strict=True))
    return {region.id: away[SCENE.place_regions == region.id].min() for region in SCENE.regions}


def label_of(what, number):
    if what == "object":
        return SCENE.objects[number - 1].label
    region = SCENE.place_regions[number - 1] if what == "place" else number
    return next(one.label for one in SCENE.regions if one.id == region)


def listed(found):
    return [(thing.id, pytest.approx(thing.distance_m)) for thing in found.things]


@pytest.mark.parametrize("what", ["place", "region", "object"])
@pytest.mark.parametrize("labelled", [False, True])
def test_the_nearest_and_those_within_a_radius(what, labelled):
    for point in points(8):
        label = (KINDS[5] if what == "object" else LABELS[2]) if labelled else ""
        ranked = sorted(
            (away, number)
            for number, away in distances(what, point).items()
            if not label or label_of(what, number) == label
        )
        near = answer(INDEX, q.Nearest(point_m=point, what=what, label=label.upper(), limit=4))
        assert [(number, away) for away, number in ranked[:4]] == listed(near)
        within = answer(INDEX, q.InRadius(point_m=point, radius_m=3.0, what=what, label=label, limit=5))
        inside = [(number, away) for away, number in ranked if away <= 3.0]
        assert (inside[:5], len(inside)) == (listed(within), within.total)


def test_equally_near_places_come_by_their_ids():
    square = msgspec.structs.replace(
        synthetic_scene(4, 0), positions_m=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    )
    found = answer(Index(square), q.Nearest(point_m=(0.5, 0.5, 0.0), what="place", limit=3))
    assert [thing.id for thing in found.things] == [1, 2, 3]


def overlaps(item, low, high):
    return all(item.min_m[axis] <= high[axis] and item.max_m[axis] >= low[axis] for axis in range(3))


@pytest.mark.parametrize("label", ["", LABELS[0]])
def test_in_a_box(label):
    for low in points(8, seed=1):
        high = tuple(value + 4 for value in low)
        inside = ((low <= CENTRES) & (high >= CENTRES)).all(axis=1)
        held = set(SCENE.place_regions[inside].tolist())
        touched = [item.id for item in SCENE.objects if overlaps(item, low, high)]
        expected = {"place": SCENE.place_ids[inside].tolist(), "region": sorted(held), "object": touched}
        for what, numbers in expected.items():
            if label and what == "object":
                continue
            found = answer(INDEX, q.InBox(min_m=low, max_m=high, what=what, label=label, limit=1000))
            assert [thing.id for thing in found.things] == [
                n for n in numbers if not label or label_of(what, n) == label
            ]
            assert found.total == len(found.things)


def test_a_box_upside_down_is_told():
    assert "empty" in answer(INDEX, q.InBox(min_m=(1.0, 0.0, 0.0), max_m=(0.0, 1.0, 1.0))).reason


def weighted(least=0.0):
    graph = nx.Graph()
    graph.add_nodes_from(SCENE.place_ids.tolist())
    for (a, b), clearance in zip(SCENE.edges.tolist(), SCENE.clearances_m.tolist(), strict=True):
        if clearance >= least:
            graph.add_edge(a, b, length=float(np.linalg.norm(CENTRES[a - 1] - CENTRES[b - 1])), clearance=clearance)
    return graph


@pytest.mark.parametrize("least", [0.0, 0.2, 0.3])
def test_routes_between_places_are_the_shortest(least):
    graph, rng = weighted(np.float32(least)), np.random.default_rng(2)
    roomy = SCENE.place_ids[SCENE.radii_m >= np.float32(least)].tolist()
    found_some = lost_some = False
    for _ in range(20):
        a, b = rng.choice(roomy, 2).tolist()
        way = answer(INDEX, q.RouteBetween(start=spot("place", a), goal=spot("place", b), clearance_m=least))
        assert way.found == nx.has_path(graph, a, b)
        if way.found:
            found_some = True
            assert way.length_m == pytest.approx(nx.shortest_path_length(graph, a, b, "length"))
            steps = list(itertools.pairwise(way.place_ids))
            assert way.length_m == pytest.approx(sum(graph.edges[step]["length"] for step in steps))
            assert way.clearance_m == pytest.approx(min(graph.edges[step]["clearance"] for step in steps))
            assert (way.place_ids[0], way.place_ids[-1]) == (a, b) and way.start_gap_m == way.goal_gap_m == 0
            assert way.waypoints_m == [tuple(SCENE.positions_m[number - 1].tolist()) for number in way.place_ids]
        else:
            lost_some = True
            assert way.reason
    assert found_some and (lost_some or least < 0.3)


def spot(what, number):
    return q.Spot(what=what, id=number)


def test_a_route_passes_regions_in_order():
    way = answer(INDEX, q.RouteBetween(start=spot("region", 1), goal=spot("region", 9)))
    regions = [int(SCENE.place_regions[number - 1]) for number in way.place_ids]
    assert [region.id for region in way.regions] == [number for number, _ in itertools.groupby(regions)]
    assert (way.start.id, way.goal.id) == (1, 9) and len(way.regions) >= 3


def test_a_route_to_a_label_goes_to_the_one_that_is_reached_first():
    start = points(1, seed=3)[0]
    far = synthetic_scene(1500, 300)
    regions = [msgspec.structs.replace(one, label="goal" if one.id in (2, 9) else one.label) for one in far.regions]
    index = Index(msgspec.structs.replace(far, regions=regions))
    to = {n: answer(index, q.RouteBetween(start=q.Spot(point_m=start), goal=spot("region", n))) for n in (2, 9)}
    either = answer(index, q.RouteBetween(start=q.Spot(point_m=start), goal=q.Spot(label="GOAL")))
    nearer = min(to.values(), key=lambda way: way.length_m)
    assert (either.goal.id, either.length_m) == (nearer.goal.id, pytest.approx(nearer.length_m))
    assert either.start is None and either.start_gap_m == pytest.approx(min(distances("place", start).values()))


def test_no_way_says_how_wide_the_widest_is():
    way = answer(INDEX, q.RouteBetween(start=spot("region", 1), goal=spot("region", 9), clearance_m=0.5))
    assert not way.found and way.start.id == 1
    ends = [
        answer(INDEX, q.RouteBetween(start=spot("region", n), goal=spot("region", n), clearance_m=0.5)).place_ids[0]
        for n in (1, 9)
    ]
    tree = nx.maximum_spanning_tree(weighted(), "clearance")
    widest = min(tree.edges[step]["clearance"] for step in itertools.pairwise(nx.shortest_path(tree, *ends)))
    assert f"the widest one has {widest:.2f} m" in way.reason


def test_no_way_through_what_was_never_joined():
    apart = msgspec.structs.replace(SCENE, edges=SCENE.edges[:0], clearances_m=SCENE.clearances_m[:0])
    way = answer(Index(apart), q.RouteBetween(start=spot("place", 1), goal=spot("place", 2)))
    assert (way.found, way.reason) == (False, "no way: no free space that was seen so far joins the start and the goal")


def test_a_scrap_of_free_space_near_an_end_does_not_hide_the_way():
    """A place without edges is nearest to the point."""
    scrap = {
        "place_ids": np.append(SCENE.place_ids, 5000),
        "positions_m": np.append(SCENE.positions_m, [[3.0, 3.0, 1.05]], axis=0).astype(np.float32),
        "radii_m": np.append(SCENE.radii_m, np.float32(0.1)),
        "basis_points": np.append(SCENE.basis_points, np.int16(3)),
        "place_regions": np.append(SCENE.place_regions, NO_REGION),
        "posteriors": np.append(SCENE.posteriors, SCENE.posteriors[:1], axis=0),
        "unknown": np.append(SCENE.unknown, SCENE.unknown[:1]),
    }
    index = Index(msgspec.structs.replace(SCENE, **scrap))
    start = q.Spot(point_m=(3.0, 3.0, 1.05))
    assert answer(index, q.Nearest(point_m=start.point_m, what="place")).things[0].id == 5000
    assert answer(index, q.RouteBetween(start=start, goal=spot("region", 9))).found
    assert answer(index, q.RouteBetween(start=start, goal=spot("place", 5000))).place_ids == [5000]


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (q.Spot(what="region", id=999), "the goal: there is no region 999; the scene has regions"),
        (q.Spot(id=3), "say whether"),
        (q.Spot(), "names nothing"),
        (q.Spot(label="romo kind 3"), "the nearest labels are: room kind"),
    ],
)
def test_an_end_that_means_nothing_is_told(end, reason):
    way = answer(INDEX, q.RouteBetween(start=spot("place", 1), goal=end))
    assert not way.found and reason in way.reason


def test_labels_whatever_their_case_and_what_is_spelled_alike():
    found = answer(INDEX, q.ByLabel(label="ROOM KIND 3"))
    assert [thing.id for thing in found.things] == [r.id for r in SCENE.regions if r.label == "room kind 3"] != []
    assert {thing.what for thing in found.things} == {"region"}
    places = answer(INDEX, q.ByLabel(label="room kind 3", what="place", limit=2))
    assert len(places.things) == 2 and places.total == int(
        np.isin(SCENE.place_regions, [t.id for t in found.things]).sum()
    )
    unknown = answer(INDEX, q.ByLabel(label="object kin 7"))
    assert unknown.things == [] and "object kind 7" in unknown.nearest_labels and "object kin 7" in unknown.reason
    assert answer(INDEX, q.ByLabel(label="zzz")).nearest_labels == []


def test_objects_of_a_kind_in_regions_of_a_kind():
    held = {n for r in SCENE.regions if r.label == LABELS[1] for n in r.object_ids}
    for kind in KINDS:
        found = answer(INDEX, q.ObjectsInRegions(object_label=kind, region_label=LABELS[1]))
        assert {thing.id for thing in found.things} == {n for n in held if SCENE.objects[n - 1].label == kind}
        assert all(thing.region in {r.id for r in SCENE.regions if r.label == LABELS[1]} for thing in found.things)
    assert held and answer(INDEX, q.ObjectsInRegions(region_label=LABELS[1])).total == len(held)
    assert "no region is labelled 'attic'" in answer(INDEX, q.ObjectsInRegions(region_label="attic")).reason


def test_one_thing_and_its_neighbours():
    region = SCENE.regions[4]
    found = answer(INDEX, q.ById(what="region", id=region.id))
    assert (found.region, found.thing.label) == (region, region.label)
    neighbours = answer(INDEX, q.NeighboursOf(what="region", id=region.id)).neighbours
    assert [one.thing.id for one in neighbours] == region.neighbour_ids
    assert [way for one in neighbours for way in one.ways] == sorted(region.transitions, key=lambda way: way.region)
    place = answer(INDEX, q.ById(what="place", id=5)).place
    assert place.radius_m == pytest.approx(float(SCENE.radii_m[4])) and place.beliefs[0].label == LABELS[0]
    around = answer(INDEX, q.NeighboursOf(what="place", id=400)).neighbours
    assert [one.thing.id for one in around] == sorted(weighted()[400])
    assert all(one.length_m == pytest.approx(weighted().edges[400, one.thing.id]["length"]) for one in around)
    item = region.object_ids[0]
    assert answer(INDEX, q.ById(what="object", id=item)).object.id == item
    assert answer(INDEX, q.NeighboursOf(what="object", id=item)).neighbours[0].thing.id == region.id
    assert answer(INDEX, q.ById(what="object", id=-3)).reason == (
        "there is no object -3; the scene has 300 objects with ids from 1 to 300"
    )


def test_beliefs_of_a_region_are_the_mean_of_its_places():
    half = msgspec.structs.replace(SCENE, predicted_ids=SCENE.place_ids[::2])
    found = answer(Index(half), q.BeliefsOf(region=3, limit=2))
    rows = SCENE.place_regions == 3
    mean = SCENE.posteriors[rows].astype(float).mean(axis=0)
    assert [one.label for one in found.beliefs] == [LABELS[i] for i in np.argsort(-mean, kind="stable")[:2]]
    assert found.beliefs[0].probability == pytest.approx(mean.max())
    assert found.unknown == pytest.approx(SCENE.unknown[rows].astype(float).mean(), abs=1e-6)
    assert found.places == rows.sum() and found.predicted_share == pytest.approx((SCENE.place_ids[rows] % 2).mean())


def test_what_changed():
    before = msgspec.structs.replace(changed(SCENE, np.random.default_rng(1)), revision=3)
    old = Index(before)
    found = answer(INDEX, q.ChangedSince(revision=3), {3: before}.get)
    labels = {region.id: region.label for region in SCENE.regions}
    renamed = {r.id: r.label for r in before.regions if r.label != labels[r.id]}
    assert renamed and {one.thing.id: one.former_label for one in found.renamed} == renamed
    assert (found.places_appeared, found.places_gone) == (150, 0)
    relabelled = np.isin(before.place_regions, list(renamed)).sum()
    assert found.places_relabelled == relabelled and found.since_revision == 3
    back = answer(old, q.ChangedSince(revision=7), {7: SCENE}.get)
    assert (back.places_appeared, back.places_gone) == (0, 150)
    fewer = msgspec.structs.replace(SCENE, regions=SCENE.regions[1:], objects=SCENE.objects[2:], task="other")
    gone = answer(Index(fewer), q.ChangedSince(revision=7), {7: SCENE}.get)
    assert [(one.what, one.id) for one in gone.gone] == [("region", 1), ("object", 1), ("object", 2)]
    assert gone.task_before == "bench"
    assert "not kept" in answer(INDEX, q.ChangedSince(revision=2)).reason


def test_words_stand_in_for_an_embedding_and_it_is_said():
    found = answer(INDEX, q.AnswersTo(text="where is the object kind 7?", what="object", limit=3))
    assert found.note and {thing.label for thing in found.things[:1]} == {"object kind 7"}
    scores = [thing.score for thing in found.things]
    assert scores == sorted(scores, reverse=True) and 0 < scores[-1] < scores[0] <= 1


def test_the_store_answers_over_its_revision_and_keeps_what_it_made_of_it():
    runner = Runner(service.SERVICE, service.Config(path=":memory:"), wire=True)
    asked = q.SceneQuery(robot="spot", questions=[q.WordsInUse(), q.Nearest(point_m=(0.0, 0.0, 0.0), what="place")])
    assert runner.answer(SCENE_QUERY, asked).revision == -1
    runner.feed(place_delta(0, [(1, 0, 0, 1, 0.5), (2, 3, 0, 1, 0.5)]))
    first = runner.answer(SCENE_QUERY, asked)
    assert (first.revision, first.stamp_ns, first.answers[1].things[0].id) == (0, 1000, 1)
    kept = runner.state.robots["spot"].index
    assert runner.answer(SCENE_QUERY, asked) == first and runner.state.robots["spot"].index is kept
    runner.feed(place_delta(1, [(3, 0, 0, 0, 0.5)]))
    second = runner.answer(SCENE_QUERY, asked)
    assert (second.revision, second.answers[1].things[0].id) == (1, 3)


def test_a_task_is_in_the_answers_at_once_though_it_is_no_revision():
    runner = Runner(service.SERVICE, service.Config(path=":memory:"), wire=True)
    runner.feed(place_delta(0, [(1, 0, 0, 1, 0.5)]))
    asked = q.SceneQuery(robot="spot", questions=[q.WordsInUse()])
    tasks = []
    for stamp_ns, text in ((1, "tidy up"), (2, "serve drinks")):
        runner.feed(Task(robot="spot", stamp_ns=stamp_ns, environment="home", task=text))
        found = runner.answer(SCENE_QUERY, asked)
        tasks.append((found.revision, found.answers[0].task))
    assert tasks == [(0, "tidy up"), (0, "serve drinks")]


def test_every_kind_of_question_about_an_empty_scene_has_an_answer():
    empty = Index(telling.scene(graph.Graph("r")))
    answers = reply(empty, q.SceneQuery(robot="r", questions=QUESTIONS)).answers
    for question, found in zip(QUESTIONS, answers, strict=True):
        assert isinstance(question, q.WordsInUse) or found.reason or not found.things, question


def levelled():
    """Regions 1 to 4 in two wards on one floor."""

    def node(level, number, label, members, of):
        return LevelNode(level=level, id=number, label=label, probability=1.0, member_ids=members, members=of)

    nodes = [
        node("zone", 2, "Ward", [1, 2], "region"),
        node("zone", 6, "surgery", [3, 4], "region"),
        node("floor", 0, "floor 0", [2, 6], "zone"),
    ]
    return Index(msgspec.structs.replace(SCENE, nodes=nodes))


def regions_by_node(found):
    return {(one.node.level, one.node.id): [region.id for region in one.regions] for one in found.nodes}


def test_levels_are_asked_for_by_label_by_id_and_by_what_they_hold():
    index = levelled()
    assert regions_by_node(answer(index, q.NodesOf(label="ward"))) == {("zone", 2): [1, 2]}
    assert regions_by_node(answer(index, q.NodesOf(level="zone", id=6))) == {("zone", 6): [3, 4]}
    assert regions_by_node(answer(index, q.NodesOf(region=3))) == {("zone", 6): [3, 4], ("floor", 0): [1, 2, 3, 4]}
    some = answer(index, q.NodesOf(limit=1))
    assert some.total == 3 and len(some.nodes) == 1


@pytest.mark.parametrize(
    ("question", "reason"),
    [
        (q.NodesOf(region=10**6), "there is no region 1000000"),
        (q.NodesOf(label="wart"), "no zone, floor, building or district is labelled 'wart'; there are: Ward"),
        (q.NodesOf(level="zone", id=3), "there is no such zone; there are: zone 2 (Ward), zone 6 (surgery)"),
        (q.NodesOf(level="district"), "the scene has no district yet"),
    ],
)
def test_levels_that_are_not_there_are_told(question, reason):
    assert answer(levelled(), question).reason.startswith(reason)


def test_of_many_labels_some_are_named_and_the_others_counted():
    labels = len(INDEX.labels("region")) + len(INDEX.labels("object"))
    assert f" and {labels - 6} others" in answer(INDEX, q.ByLabel(label="xyzzy")).reason
