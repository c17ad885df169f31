"""Parts of a scene: one floor of several."""

import msgspec

from prior_sg.deploy.parts import floors_of, storey_of
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.scene import Scene
from tests.help.homes import joined_home, printed, two_floors


def test_a_floor_holds_what_is_on_it_and_nothing_else():
    markers = [printed(number, (1.0, 0.2, height_m), (0.0, 1.0, 0.0)) for number, height_m in ((7, 1.5), (9, 4.5))]
    scene = msgspec.structs.replace(two_floors(), markers=markers)
    assert [floor.id for floor in floors_of(scene)] == [4, 1]  # from below
    below, above = (storey_of(scene, floor.id) for floor in floors_of(scene))
    home = joined_home()
    assert below.place_ids.tolist() == home.place_ids.tolist() and below.edges.tolist() == home.edges.tolist()
    assert [region.id for region in below.regions] == [region.id for region in home.regions]
    assert (above.positions_m[:, 2] > 2).all() and len(above.place_ids) == len(home.place_ids)
    assert [item.label for item in below.objects] == ["table"] and [item.label for item in above.objects] == ["bed"]
    assert ([one.id for one in below.markers], [one.id for one in above.markers]) == ([7], [9])
    assert len(below.trajectory) == 1 and len(above.trajectory) == 2
    assert [one.place_id for one in below.foresight.openings] == [int(home.place_ids[0])]
    assert [(one.level, one.id) for one in above.nodes] == [("zone", 5), ("floor", 1), ("building", 0)]
    assert [(one.level, one.id) for one in below.nodes] == [("floor", 4), ("building", 0)]
    for part in (below, above):
        assert encode(decode(Scene, encode(part))) == encode(part)  # as whole as any scene


def test_a_floor_that_is_not_there_holds_nothing():
    nothing = storey_of(two_floors(), 9)
    assert not nothing.regions and not len(nothing.place_ids) and not nothing.objects and not nothing.nodes
    assert not len(nothing.trajectory) and not nothing.foresight.openings
