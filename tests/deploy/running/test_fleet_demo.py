"""`prior-sg demo --fleet` without its page: two robots in one generated home become one map."""

from prior_sg.deploy.running.fleet_demo import FleetDemo, summary
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
    assert "regions: " in summary(scene)
