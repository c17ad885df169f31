"""What judges an hour and a load, and a short run of each; `make soak` and `make load` take the hour."""

import pytest

from tests.chaos.streams import SAMPLE_NAME, made
from tests.endurance.edge import Plan
from tests.endurance.load import follows, load
from tests.endurance.meter import Late, Look, Process, percentiles, slope_per_hour
from tests.endurance.plots import draw
from tests.endurance.soak import soak, summed
from tests.help.long import long_run


def look(at_s, resident_mb):
    process = Process(resident_mb=resident_mb, handles=20, threads=5, worked_s=0.25 * at_s)
    return Look(at_s=at_s, keyframes=int(at_s), disk_mb=at_s / 36, processes={"segmenter-1": process})


def test_a_slope_is_per_hour_and_steps_do_not_move_it():
    looks = [look(at_s, 100 + at_s / 36 + (300 if at_s == 500 else 0)) for at_s in range(0, 1000, 100)]
    assert slope_per_hour(looks, lambda one: one.processes["segmenter-1"].resident_mb) == pytest.approx(100)
    assert slope_per_hour(looks[:1], lambda one: 1.0) == 0.0


def test_a_soak_tells_growth_from_filling_up_and_first_from_last():
    looks = [look(at_s, min(at_s, 100)) for at_s in range(0, 1001, 10)]
    late = [Late(at_s=float(at_s), segmented_s=0.1 if at_s < 500 else 0.4) for at_s in range(1000)] + [
        Late(at_s=1000.0)
    ]
    found = summed(looks, late, 100.0)
    assert found["processes"]["segmenter-1"]["resident_mb_per_hour"] == 0
    assert found["processes"]["segmenter-1"]["cores"] == pytest.approx(0.25)
    assert found["disk_mb_per_hour"] == pytest.approx(100)
    assert (found["segmented_first"]["p50_s"], found["segmented_last"]["p99_s"]) == (0.1, 0.4)
    assert found["place_first"]["never"] == 100


def test_percentiles_count_what_never_came():
    assert percentiles([1.0, None, 3.0]) == {"p50_s": 2.0, "p99_s": pytest.approx(2.98), "count": 2, "never": 1}


LATE = {"p50_s": 0.3, "count": 99, "never": 1}
FOLLOWED = {"came": 1.0, "dropped": 0, "place": LATE, "segmented": LATE}


@pytest.mark.parametrize(
    "fault",
    [
        {"came": 0.9},
        {"dropped": 1},
        {"segmented": {"p50_s": 3.0, "count": 100, "never": 0}},
        {"place": {"p50_s": 3.0, "count": 100, "never": 0}},
        {"segmented": {"p50_s": 0.3, "count": 90, "never": 10}},
        {"segmented": {"p50_s": 0.0, "count": 0, "never": 0}},
    ],
    ids=str,
)
def test_a_system_follows_only_without_any_of_these(fault):
    assert follows(FOLLOWED)
    assert not follows(FOLLOWED | fault)


@long_run
def test_a_minute_of_one_robot_and_two_robots(tmp_path):
    stream = made(SAMPLE_NAME, 200, tmp_path)
    figures, looks = soak(stream, Plan(1, 2.0), 40.0, tmp_path / "soak", lambda text: None)
    assert figures["started_again"] == []
    assert figures["keyframes"] > 40
    assert {name.split("-")[0] for name in figures["processes"]} >= {"ingest", "segmenter", "scene_store", "around"}
    assert figures["segmented_last"]["count"] > 10
    draw(looks, [], tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 10_000
    (row,) = load(stream, [[Plan(2, 1.0)]], 15.0, tmp_path / "load", lambda text: None)
    assert row["segmented"]["count"] > 10
    assert set(row["cores"]) >= {"ingest", "place_graph", "feature_pyramid", "segmenter", "scene_store"}
