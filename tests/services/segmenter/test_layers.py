"""Levels above regions: storeys by geometry, zones and buildings by the prior, ids that last."""

import dataclasses

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.levels import Entry, LevelNode, LevelPrior, nodes_above, regions_in
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import Region, Transition
from prior_sg.services.segmenter.core.layers.alignment import AlignmentConfig, Members
from prior_sg.services.segmenter.core.layers.layer_map import LayerMap
from prior_sg.services.segmenter.core.layers.pieces import near_regions
from prior_sg.services.segmenter.core.layers.stacking import LayersConfig, LevelInForce, layers_of
from prior_sg.services.segmenter.core.layers.storeys import StoreyConfig, Storeys, split, storeys_of
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.map.table import Places
from prior_sg.services.segmenter.core.regions.components import numbered
from tests.help.examples import PRIOR

CFG = StoreyConfig()
STOREY_M = 3.0
RADIUS_M = 0.4  # of places in `known`


def storey(z_m, side=8):
    """Places in the middle of a room's height, their spheres from floor to ceiling."""
    x, y = np.mgrid[:side, :side].reshape(2, -1).astype(float)
    return np.stack((x, y, np.full(len(x), z_m + 1.25)), axis=1), np.full(len(x), 1.25)


def flight(z_m, count=12):
    """Places on stairs from one floor to the next."""
    share = np.linspace(0, 1, count)
    return np.stack((8 + 0 * share, 2 + 3 * share, z_m + STOREY_M * share + 1.0), axis=1), np.full(count, 0.9)


def graph_of(parts, near_m=1.3):
    positions_m, radii_m = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    apart = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
    edges = np.argwhere(np.triu(apart < near_m, 1))
    return ReceivedGraph(np.arange(len(positions_m)), positions_m, radii_m, edges, np.full(len(edges), 1.0))


def test_floors_are_found_and_stairs_lie_between():
    found = storeys_of(graph_of([storey(0), flight(0), storey(STOREY_M), storey(2 * STOREY_M)]), CFG)
    np.testing.assert_allclose(found.floors_m, (0, 3, 6), atol=0.15)
    assert found.of_place[:64].tolist() == [0] * 64 and found.of_place[-64:].tolist() == [2] * 64
    assert found.between[64:76].mean() > 0.5 and not found.between[:64].any()


@pytest.mark.parametrize("bottoms", ["slope", "hall", "far", "trees"])
def test_where_no_height_stands_out_there_is_one_storey(bottoms):
    (places, radii_m) = storey(0, 16)
    if bottoms == "slope":  # a ramp that rises 5 m
        places[:, 2] += places[:, 0] / 3
    elif bottoms == "hall":  # spheres as large as the hall is high stand on its floor
        places[:, 2], radii_m = 3.0, np.full(len(places), 3.0)
    elif bottoms == "trees":  # free space over a few of them
        places = np.concatenate((places, places[:10] + np.array((0, 0, 4.0))))
        radii_m = np.concatenate((radii_m, radii_m[:10]))
    else:  # a mistake of the map, too far off to be drawn up
        places[0, 2] = 1e7
    assert len(storeys_of(graph_of([(places, radii_m)]), CFG).floors_m) == 1


def test_a_map_without_places_has_no_storey():
    assert len(storeys_of(ReceivedGraph(), CFG).floors_m) == 0
    assert len(split(np.zeros(0, np.int64), np.zeros((0, 2), np.int64), storeys_of(ReceivedGraph(), CFG), CFG)) == 0


def test_regions_end_where_a_storey_does_but_stairs_do_not():
    graph = graph_of([storey(0), flight(0), storey(STOREY_M)])
    storeys = storeys_of(graph, CFG)
    everything = np.zeros(len(graph.ids), np.int64)
    assert numbered(everything, graph.edges).max() == 0  # one region, by its label alone
    parts = split(numbered(everything, graph.edges), graph.edges, storeys, CFG)
    assert len(np.unique(parts)) == 2 and parts[0] != parts[-1]
    stairs = everything.copy()
    stairs[64:76] = 1
    kept = split(numbered(stairs, graph.edges), graph.edges, storeys, CFG)
    assert len(np.unique(kept)) == 3 and len(np.unique(kept[64:76])) == 1


def level(name, parents, adjacency=0.5, names=("ward", "surgery")):
    matrix = np.array(parents, np.float32)
    touch = np.full((len(names), len(names)), adjacency, np.float32)
    np.fill_diagonal(touch, 1)
    entries = [Entry(name=one, existence=1 / len(names)) for one in names]
    prior = LevelPrior(name=name, entries=entries, parents=matrix, adjacency=touch)
    return LevelInForce(prior, 3.0 * (1 - np.eye(len(names))))


# Regions in a row: patient room, supply room, operating room. The middle one may be in either zone.
ROOMS = np.eye(3)
ZONES = [(0.95, 0.05), (0.5, 0.5), (0.05, 0.95)]


def row_of(labels, areas_m2=60.0):
    count = len(labels)
    edges = np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)
    return Members(np.full(count, areas_m2), ROOMS[labels], edges, np.ones(count - 1))


def test_zones_follow_their_members_and_their_neighbours():
    labels = [0, 1, 0, 2, 1, 2]
    zones, floors, buildings = layers_of(
        row_of(labels), np.zeros(6, np.int64), {"zone": level("zone", ZONES)}, AlignmentConfig()
    )
    assert (zones.level, zones.groups.tolist(), zones.labels) == ("zone", [0, 0, 0, 1, 1, 1], ["ward", "surgery"])
    assert min(zones.probabilities) > 0.8
    assert (floors.labels, buildings.labels) == (["floor 0"], ["building"])


def test_zones_never_span_storeys_and_each_storey_is_a_floor():
    zones, floors, _ = layers_of(
        row_of([0, 0, 0, 0]), np.array([0, 0, 1, 1]), {"zone": level("zone", ZONES)}, AlignmentConfig()
    )
    assert zones.labels == ["ward", "ward"] and zones.groups.tolist() == [0, 0, 1, 1]
    assert floors.labels == ["floor 0", "floor 1"] and floors.groups.tolist() == [0, 0, 1, 1]


def test_floors_are_of_one_building_each():
    outside = level("building", [(0.95, 0.05), (0.9, 0.1), (0.05, 0.95)], names=("building", "outdoors"))
    floors, buildings = layers_of(
        row_of([0, 1, 2, 2, 0, 0]), np.zeros(6, np.int64), {"building": outside}, AlignmentConfig()
    )
    assert buildings.labels == ["building", "outdoors", "building"]
    assert buildings.groups.tolist() == floors.groups.tolist() == [0, 0, 1, 1, 2, 2]


def test_no_region_has_no_level():
    none = Members(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 2), np.int64), np.zeros(0))
    assert layers_of(none, np.zeros(0, np.int64), {"zone": level("zone", ZONES)}, AlignmentConfig()) == []


def known(labels, first_id=0, x_m=None, z_m=None, joined=True):
    """Regions of one place each in a row, 60 m2, an open way between neighbours; their graph, and the table of their
    places."""
    ids = [first_id + row for row in range(len(labels))]
    x_m = np.arange(len(labels)) if x_m is None else np.array(x_m)
    z_m = np.zeros(len(labels)) if z_m is None else np.array(z_m)
    regions = {}
    for row, number in enumerate(ids):
        ways = [
            Transition(region=other, edge=(0, 1), position_m=(0, 0, 0), clearance_m=1.0, door=False)
            for other in (number - 1, number + 1)
            if other in ids and joined
        ]
        regions[number] = Region(
            id=number,
            label="",
            place_count=1,
            probability=1.0,
            position_m=(float(row), 0.0, 1.0),
            area_m2=60.0,
            transitions=ways,
        )
    places = dataclasses.replace(Places.none(), regions=np.array(ids), posteriors=ROOMS[labels].astype(np.float32))
    count = len(labels)
    floors_m, storey = np.unique(z_m, return_inverse=True)
    ground = Storeys(floors_m, storey, np.ones(count, bool), np.zeros(count, bool), np.ones(count))
    positions_m = np.stack((x_m, 0.0 * x_m, z_m), axis=1)
    graph = ReceivedGraph(np.arange(count), positions_m, np.full(count, RADIUS_M))
    return regions, graph, places, ground


def test_nodes_keep_their_ids_while_regions_come_and_go():
    layers, levels = LayerMap(), {"zone": level("zone", ZONES)}
    layers.renew(*known([0, 1, 0, 2, 1, 2]), levels=levels, cfg=LayersConfig())
    assert {key: one.member_ids for key, one in layers.known.items() if key[0] == "zone"} == {
        ("zone", 0): [0, 1, 2],
        ("zone", 1): [3, 4, 5],
    }
    assert layers.known["zone", 1].label == layers.zones[4] == "surgery"
    assert layers.known["floor", 0].members == "zone" and layers.known["floor", 0].member_ids == [0, 1]
    assert layers.known["zone", 0].parent_id == 0 and layers.known["zone", 0].area_m2 == 180
    layers.renew(*known([1, 0, 2, 1, 2, 2], first_id=1), levels=levels, cfg=LayersConfig())  # 0 is gone, 6 is new
    assert layers.known["zone", 1].member_ids == [3, 4, 5, 6] and layers.known["zone", 0].member_ids == [1, 2]


APART_M = LayersConfig().join_m + 2 * RADIUS_M  # of centres whose spheres are just near enough


@pytest.mark.parametrize(("apart_m", "count"), [(APART_M - 0.1, 1), (APART_M + 0.1, 3)])
def test_pieces_without_a_way_are_one_building_where_they_stand_side_by_side(apart_m, count):
    """Three regions that no way joins, as what was seen over a counter or through a window is."""
    layers = LayerMap()
    layers.renew(*known([0, 1, 2], x_m=apart_m * np.arange(3), joined=False), levels={}, cfg=LayersConfig())
    for name in ("building", "floor"):
        assert sum(level == name for level, _ in layers.known) == count


def test_what_stands_above_is_a_floor_of_the_same_building():
    layers = LayerMap()
    layers.renew(*known([0, 0], x_m=(0, 0), z_m=(0, 1.5), joined=False), levels={}, cfg=LayersConfig())
    assert [one.label for one in layers.known.values()] == ["floor 0", "floor 1", "building"]


def test_pieces_side_by_side_are_one_building_only_where_the_prior_takes_them_for_one():
    outside = level("building", [(0.95, 0.05), (0.9, 0.1), (0.05, 0.95)], names=("building", "outdoors"))
    layers = LayerMap()
    arguments = known([0, 1, 2], x_m=(APART_M - 0.1) * np.arange(3), joined=False)
    layers.renew(*arguments, levels={"building": outside}, cfg=LayersConfig())
    assert [(one.label, one.member_ids) for one in layers.known.values() if one.level == "building"] == [
        ("building", [0]),
        ("outdoors", [1]),
    ]
    floors = [one for one in layers.known.values() if one.level == "floor"]
    assert [one.member_ids for one in floors] == [[0, 1], [2]]


def test_zones_do_not_go_through_walls():
    layers = LayerMap()
    arguments = known([0, 0], x_m=(0, APART_M - 0.1), joined=False)
    layers.renew(*arguments, levels={"zone": level("zone", ZONES)}, cfg=LayersConfig())
    assert [one.level for one in layers.known.values()].count("zone") == 2
    assert [one.level for one in layers.known.values()].count("building") == 1


def test_nearest_regions_of_pieces_are_found_as_by_looking_at_all_pairs():
    rng = np.random.default_rng(5)
    for _ in range(30):
        count, places = 5, 60
        rows = np.sort(np.concatenate((np.arange(count), rng.integers(0, count, places - count))))
        positions_m = rng.uniform(-1, 1, (places, 3)) + 3.0 * rng.uniform(-1, 1, (count, 3))[rows]
        graph = ReceivedGraph(np.arange(places), positions_m, np.full(places, 0.2))
        edges = np.array([(0, 1), (2, 3)])
        piece = np.array([0, 0, 1, 1, 2])[rows]
        apart_m = np.linalg.norm(positions_m[:, None] - positions_m, axis=2) - 0.4
        wanted = []
        for one, other in ((0, 1), (0, 2), (1, 2)):
            between = np.where((piece[:, None] == one) & (piece == other), apart_m, np.inf)
            if between.min() <= 1.0:
                first, second = np.unravel_index(between.argmin(), between.shape)
                wanted.append(sorted((int(rows[first]), int(rows[second]))))
        assert near_regions(graph, rows, np.arange(count), edges, 1.0).tolist() == sorted(wanted)


def test_a_successor_goes_on_with_the_ids():
    former, levels = LayerMap(), {"zone": level("zone", ZONES)}
    former.renew(*known([0, 0, 2, 2, 2]), levels=levels, cfg=LayersConfig())
    successor = LayerMap()
    successor.inherit(list(former.known.values()), {"zone": 9})
    successor.renew(*known([0, 2, 2, 2, 0, 0, 0], first_id=1), levels=levels, cfg=LayersConfig())
    assert sorted(number for name, number in successor.known if name == "zone") == [0, 1, 9]


def node(level, number, members, of="region", label=""):
    return LevelNode(level=level, id=number, label=label or level, probability=1.0, member_ids=members, members=of)


NODES = [
    node("zone", 5, [1, 2]),
    node("zone", 7, [4]),
    node("floor", 0, [5, 7], "zone"),
    node("building", 3, [0], "floor"),
]


def test_regions_know_all_that_holds_them():
    assert regions_in(NODES, "zone") == {1: 5, 2: 5, 4: 7}
    assert regions_in(NODES[::-1], "building") == {1: 3, 2: 3, 4: 3}
    assert [(one.level, one.id) for one in nodes_above(NODES)[4]] == [("zone", 7), ("floor", 0), ("building", 3)]


def test_a_prior_without_levels_has_the_zones_that_its_regions_name():
    bare = msgspec.structs.replace(PRIOR, levels=[])
    (zones,) = bare.levels_above
    assert zones.names == list(dict.fromkeys(filter(None, (region.parent for region in PRIOR.regions))))
    assert bare.zones == [region.parent for region in PRIOR.regions]
    assert PRIOR.levels_above == PRIOR.levels


FAULTS = {
    "come once each": lambda prior: [prior.levels[0]] * 2,
    "do not fit": lambda prior: [msgspec.structs.replace(prior.levels[0], parents=np.full((3, 2), 0.5, np.float32))],
}


@pytest.mark.parametrize("fault", FAULTS)
def test_levels_that_do_not_stand_on_each_other_are_refused(fault):
    with pytest.raises(ValueError, match=fault):
        msgspec.structs.replace(PRIOR, levels=FAULTS[fault](PRIOR)).check()


CHANGES = {
    "no distribution": {"parents": np.full((2, 2), 0.6, np.float32)},
    "in \\(0, 1\\]": {"adjacency": np.zeros((2, 2), np.float32)},
    "not symmetric": {"adjacency": np.array([[1, 0.5], [0.25, 1]], np.float32)},
    "sum to one": {"entries": [Entry(name="a", existence=1.0), Entry(name="b", existence=1.0)]},
    "the same name": {"entries": [Entry(name="a", existence=0.5)] * 2},
}


@pytest.mark.parametrize("fault", CHANGES)
def test_absurd_levels_are_refused(fault):
    fields = msgspec.structs.asdict(PRIOR.levels[0]) | CHANGES[fault]
    with pytest.raises(ValueError, match=fault):
        LevelPrior(**fields)


def test_a_prior_of_the_example_is_whole():
    assert isinstance(PRIOR, Prior) and PRIOR.zones == ["day zone", "way"]
