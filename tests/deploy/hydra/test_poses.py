"""Keyframes beside Hydra's agent: those that it never comes to are forgotten."""

from types import SimpleNamespace

import numpy as np

from prior_sg.deploy.hydra.core import poses
from prior_sg.deploy.hydra.core.poses import Poses


def test_keyframes_that_never_pair_are_forgotten_and_the_others_are_not(monkeypatch):
    monkeypatch.setattr(poses, "MOST_WAITING", 8)
    known = Poses()
    for number in range(50):
        known.heard(number, number * 10**9, np.eye(4))
    stamps_ns = np.array([10 * 10**9, 45 * 10**9])
    graph = SimpleNamespace(agent_stamps_ns=stamps_ns, world_from_agent=np.tile(np.eye(4), (2, 1, 1)))
    assert known.follow(graph, 0.1, 0.1) == {}
    assert list(known.pairs) == [45] and len(known._waiting) == 7
