"""What `prior-sg bench encoder_swap` counts, on made-up deltas."""

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.benches.encoder_swap import NEW, OLD, Watch, metrics_of, unlabelled
from prior_sg.schemas.regions import Region, RegionDelta

HALL = Region(id=0, label="hall", place_count=1, probability=1.0, position_m=(0, 0, 0), area_m2=1.0)


def delta(places=(), removed=(), regions=(), **changes):
    fields = {
        "robot": "r",
        "epoch": 1,
        "revision": 0,
        "stamp_ns": 0,
        "prior_digest": "",
        "environment": "",
        "task": "",
        "space": OLD,
        "labels": ["hall"],
        "regions": list(regions),
        "removed_ids": np.zeros(0, np.int64),
        "place_ids": np.array(places, np.int64),
        "place_regions": np.zeros(len(places), np.int64),
        "posteriors": np.ones((len(places), 1), np.float16),
        "unknown": np.zeros(len(places), np.float16),
        "removed_place_ids": np.array(removed, np.int64),
        "energy": 0.0,
    }
    return RegionDelta(**(fields | changes))


def after(*deltas, removed_s=None):
    watch = Watch(deltas=[(float(second), one) for second, one in enumerate(deltas)])
    watch.removed_s = removed_s or {}
    return unlabelled(watch)


def test_a_place_that_the_place_graph_keeps_must_keep_its_label():
    assert after(delta([1, 2], regions=[HALL]), delta([1])) == 0
    assert after(delta([1, 2], regions=[HALL]), delta(removed=[2])) == 1
    assert after(delta([1, 2], regions=[HALL]), delta(removed=[2]), removed_s={2: [0.5]}) == 0
    assert after(delta([1, 2], regions=[HALL]), delta(removed=[2]), removed_s={2: [1.5]}) == 1  # later
    comes_back = delta([1], regions=[HALL]), delta(removed=[1]), delta([1]), delta(removed=[1])
    assert after(*comes_back, removed_s={1: [0.5]}) == 1  # it left once and lost its label twice
    assert after(delta([1, 2], regions=[HALL]), delta([1], regions=[HALL], snapshot=True)) == 1


def test_a_region_without_a_name_or_gone_is_no_label():
    nameless = msgspec.structs.replace(HALL, label="")
    assert after(delta([1], regions=[nameless]), delta([1], regions=[HALL])) == 1
    assert after(delta([1], regions=[HALL]), delta(removed_ids=np.array([0]))) == 1


def test_figures_of_a_change():
    watch = Watch(keyframes_s={0: 0.0, 1: 1.0, 2: 5.0, 3: 9.0})
    watch.pyramids = {
        OLD: [(0, 0.5), (1, 1.5), (1, 2.0), (2, 5.5), (3, 9.5)],
        NEW: [(2, 6.0), (0, 7.0), (1, 7.5), (3, 9.5)],
    }
    watch.deltas = [(1.0, delta([1], regions=[HALL])), (3.0, delta([1])), (8.0, delta([1], space=NEW))]
    found = metrics_of(watch, started_s=2.0, joined_s=4.0)
    assert found == pytest.approx(
        {
            "seconds_from_start": 6.0,
            "seconds_from_joining": 4.0,
            "seconds_from_first_pyramid": 2.0,
            "frames_backfilled": 2,
            "frames_before_switch": 3,
            "keyframes_after_switch": 1,
            "frames_twice": 1,
            "frames_missing": 0,
            "deltas": 3,
            "deltas_with_unlabelled": 0,
            "longest_gap_s_before": 1.0,
            "longest_gap_s_streaming": 5.0,
            "longest_gap_s": 5.0,
        }
    )
