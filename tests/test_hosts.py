"""A robot and an edge as two hosts, as docs/security.md sets them up, and a link that is cut in mid-stream."""

import time

import pytest

from tests.help.hosts import Network
from tests.help.long import long_run
from tests.help.two_hosts import TwoHosts, alone, differences

FRAMES, CUT_S, MANY = 8, 10.0, 16


@pytest.fixture
def pair(tmp_path):
    with Network() as network:
        yield TwoHosts(tmp_path, network, FRAMES, speed=0.5)


@long_run
@pytest.mark.timeout(1800)
def test_two_hosts_by_the_documented_commands_lose_nothing_to_a_link_that_is_cut(pair, tmp_path):
    assert "regions for 'serve drinks' after" in pair.begin()
    pair.mapped(3)
    pair.link.cut = True
    before = len(pair.scene().trajectory)
    time.sleep(CUT_S)
    during = len(pair.scene().trajectory)
    pair.link.cut = False
    assert during <= before + 1 < FRAMES  # what was under way
    scene = pair.settled()
    different, labels = differences(scene, alone(tmp_path, pair.source))
    assert different == []
    assert labels < 0.3  # here the task comes while images are looked at already, there before
    health = pair.health()
    assert health["segmenter"]["PYRAMID"]["consumed"] >= FRAMES
    for service, topics in health.items():
        assert not any(count["malformed"] or count["limited"] for count in topics.values()), (service, topics)
    assert sum(pair.link.lost) > 0


@long_run
@pytest.mark.timeout(1800)
def test_workers_of_a_third_host_share_the_work_of_the_edges(tmp_path):
    """A robot's jobs reach them through the router of the edge, which passes them on."""
    with Network() as network:
        three = TwoHosts(tmp_path, network, MANY, speed=6.0, more_workers=True)
        three.begin()
        scene = three.settled()
        done = three.encoders()
        assert len(done) == 2 and min(done.values()) > 0 and sum(done.values()) == MANY, done
        assert differences(scene, alone(tmp_path, three.source))[0] == []
