"""The crash points of the store: a small sample of what the bench does, and that a loss would be seen."""

import numpy as np

from prior_sg.deploy.benches import crashes, store
from prior_sg.deploy.benches.crashes import Found, killed_writers, torn_files
from prior_sg.deploy.benches.store import PLACES, _measure


def test_torn_files_lose_nothing_acknowledged(tmp_path):
    found = torn_files(tmp_path, points=120, rng=np.random.default_rng(5))
    assert (found.points, found.lost, found.refused, found.wrong) == (120, 0, 0, 0)
    assert {"old", "short", "rubbish"} <= found.kinds.keys()


def test_killed_writers_lose_nothing_acknowledged(tmp_path):
    found = killed_writers(tmp_path, kills=2, rng=np.random.default_rng(5))
    assert (found.points, found.lost, found.refused, found.wrong) == (2, 0, 0, 0)


def test_a_tail_torn_where_it_was_acknowledged_is_seen(tmp_path, monkeypatch):
    def torn(old, new, rng):
        return new[: int(rng.integers(len(new) // 2))], "short"

    monkeypatch.setattr(crashes, "_torn_tail", torn)
    found = torn_files(tmp_path, points=60, rng=np.random.default_rng(5))
    assert found.lost > 0


def test_a_scene_other_than_announced_is_seen(tmp_path):
    found = Found()
    found.note(tmp_path / "new.sqlite", 3, {}, "none")
    (tmp_path / "bad.sqlite").write_text("no database " * 1000)
    found.note(tmp_path / "bad.sqlite", 3, {}, "none")
    assert (found.points, found.lost, found.refused, found.wrong) == (2, 4, 1, 1)


def test_the_store_is_measured(monkeypatch):
    monkeypatch.setattr(store, "OBJECTS", 200)
    with PLACES["sqlite"]() as place:
        metrics = _measure(place, places=64, deltas=6, asked=4, past=2)
    assert metrics["commit_ms_p50"] > 0 and metrics["disk_bytes_per_place"] > 0 and metrics["snapshot_bytes"] > 0
