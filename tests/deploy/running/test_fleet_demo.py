"""`prior-sg demo --fleet` without its page: two robots in one generated home become one map."""

import msgspec

from prior_sg.deploy.running.fleet_demo import FleetDemo, summary
from prior_sg.schemas.levels import LevelNode
from tests.help import houses
from tests.help.long import long_run


@long_run
def test_two_robots_meet_in_one_house(tmp_path):
    said = []
    demo = FleetDemo(tmp_path, said.append, kind="home", seed=0)
    try:
        demo.walk(step_s=0.05)
        scene = demo.scene()
    finally:
        demo.close()
    assert any("has been found in the map of home" in line for line in said)
    assert scene is not None and len(scene.regions) >= 4 and scene.objects
    assert {(node.level, node.label) for node in scene.nodes if node.level != "zone"} == {
        ("floor", "floor 0"),
        ("building", "building"),
    }
    assert any(node.level == "zone" for node in scene.nodes)
    assert f"{len(scene.regions)} regions; floor 0: " in summary(scene)


def test_the_summary_says_what_is_on_which_floor():
    floors = [
        LevelNode(
            level="floor",
            id=1 - number,
            label=f"floor {number}",
            probability=1.0,
            member_ids=members,
            position_m=(0.0, 0.0, 3.0 * number),
        )
        for number, members in enumerate(([0, 2], [1, 3, 4]))
    ][::-1]
    told = summary(msgspec.structs.replace(houses.scene(), nodes=floors))
    assert told.endswith(
        "5 regions; floor 0: kitchen 1 m2, hallway 1 m2; floor 1: living room 1 m2, bedroom 1 m2, bathroom 1 m2"
    )
