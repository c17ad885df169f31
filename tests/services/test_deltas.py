"""Following deltas: whatever the order of arrival, the reader ends with what the writer holds."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prior_sg.schemas.codec import LAST_NUMBER
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.services.deltas import (
    BELIEVED_NS,
    BELIEVED_REVISIONS,
    LAST_BELIEVED,
    Follower,
    PoseCorrections,
    next_epoch,
)
from prior_sg.services.refusals import InputRefused


@dataclass(frozen=True)
class Delta:
    epoch: int
    revision: int
    snapshot: bool = False


def applied(follower, delta):
    return [(d.epoch, d.revision) for d in follower.take(delta)]


def test_in_order_repeat_gap_and_snapshot():
    follower = Follower()
    assert applied(follower, Delta(1, 0)) == [(1, 0)]
    assert applied(follower, Delta(1, 0)) == []
    assert applied(follower, Delta(1, 3)) == [] and follower.needs_snapshot
    assert applied(follower, Delta(1, 4)) == []
    assert applied(follower, Delta(1, 2, snapshot=True)) == [(1, 2), (1, 3), (1, 4)]
    assert not follower.needs_snapshot


def test_restarted_writer():
    follower = Follower(epoch=1, revision=9)
    assert applied(follower, Delta(2, 0)) == [(2, 0)]
    assert applied(follower, Delta(1, 10)) == []
    follower = Follower(epoch=1, revision=9)
    assert applied(follower, Delta(2, 3)) == [] and follower.needs_snapshot
    assert applied(follower, Delta(2, 5, snapshot=True)) == [(2, 5)]
    assert not follower.needs_snapshot


def test_a_gap_closed_by_the_missing_delta_needs_no_snapshot():
    follower = Follower()
    follower.take(Delta(1, 0))
    follower.take(Delta(1, 2))
    assert applied(follower, Delta(1, 1)) == [(1, 1), (1, 2)]
    assert not follower.needs_snapshot


@given(st.lists(st.integers(0, 12), max_size=40), st.integers(0, 12))
def test_never_out_of_order_never_twice(arrivals, snapshot_at):
    follower, seen = Follower(), []
    for revision in arrivals:
        seen += [d.revision for d in follower.take(Delta(1, revision))]
    assert seen == [revision for revision in range(13) if set(range(revision + 1)) <= set(arrivals)]
    before = follower.revision
    after = [d.revision for d in follower.take(Delta(1, snapshot_at, snapshot=True))]
    if snapshot_at > before:
        waited = [r for r in range(snapshot_at + 1, 13) if set(range(snapshot_at + 1, r + 1)) <= set(arrivals)]
        assert after == [snapshot_at, *waited]
    else:
        assert after == []


@given(st.permutations(list(range(10))))
def test_every_permutation_ends_complete(order):
    follower, seen = Follower(), []
    for revision in order:
        seen += [d.revision for d in follower.take(Delta(1, revision))]
    assert seen == list(range(10)) and not follower.needs_snapshot


def moved_to(x_m, *, epoch, revision, frame_ids=(7,)):
    pose = np.eye(4)
    pose[0, 3] = x_m
    return PoseUpdate(
        robot="r",
        epoch=epoch,
        revision=revision,
        stamp_ns=1,
        frame_ids=np.array(frame_ids, np.int64),
        world_from_camera=np.stack([pose] * len(frame_ids)),
    )


def test_a_pose_update_counts_once_and_only_if_newer_than_the_newest_of_its_epoch():
    corrections = PoseCorrections()
    assert sorted(corrections.take(moved_to(1.0, epoch=1, revision=3, frame_ids=(7, 8)))) == [7, 8]
    assert corrections.take(moved_to(2.0, epoch=1, revision=3)) is None
    assert corrections.take(moved_to(2.0, epoch=1, revision=2)) is None
    assert corrections.pose(7, np.eye(4))[0, 3] == 1.0
    assert corrections.take(moved_to(4.0, epoch=2, revision=0)) is not None  # another writer
    assert corrections.pose(7, np.eye(4))[0, 3] == 4.0 and corrections.pose(8, np.eye(4))[0, 3] == 1.0


def test_a_frame_without_a_correction_keeps_the_pose_it_was_announced_with():
    corrections, announced = PoseCorrections(), np.full((4, 4), 5.0)
    corrections.take(moved_to(1.0, epoch=1, revision=0))
    assert 7 in corrections and 9 not in corrections
    assert corrections.pose(9, announced) is announced


@pytest.mark.parametrize(
    ("followed", "absurd"),
    [
        ((5, 3), Delta(5 + BELIEVED_NS + 1, 0)),
        ((5, 3), Delta(2**63 - 1, 0, snapshot=True)),
        ((5, 3), Delta(5, 4 + BELIEVED_REVISIONS, snapshot=True)),
        ((5, 3), Delta(6, 2**63 - 1)),
        ((-1, -1), Delta(6, 2**63 - 1, snapshot=True)),
    ],
)
def test_what_a_stranger_numbers_in_the_far_future_locks_no_writer_out(followed, absurd):
    follower = Follower(*followed)
    with pytest.raises(InputRefused, match="not believed"):
        follower.take(absurd)
    assert (follower.epoch, follower.revision, follower.needs_snapshot) == (*followed, False)
    if followed[0] > 0:
        assert applied(follower, Delta(5, 4)) == [(5, 4)]


def test_a_writer_that_comes_back_after_years_is_believed():
    follower = Follower(5, 3)
    assert applied(follower, Delta(5 + BELIEVED_NS, 9, snapshot=True)) == [(5 + BELIEVED_NS, 9)]


def test_poses_numbered_far_above_those_before_lock_no_writer_out():
    def update(revision):
        return PoseUpdate(
            robot="r",
            epoch=1,
            revision=revision,
            stamp_ns=1,
            frame_ids=np.array([0]),
            world_from_camera=np.eye(4)[None],
        )

    known = PoseCorrections()
    assert known.take(update(10**18)) is not None  # whoever numbers by the time may
    with pytest.raises(InputRefused, match="lies far above"):
        known.take(update(2**63 - 1))
    assert known.take(update(10**18 + 10**9)) is not None


def test_a_single_message_cannot_use_up_the_epochs_and_who_goes_on_from_a_high_one_is_believed():
    fresh = Follower()
    with pytest.raises(InputRefused, match="hardly a number above itself"):
        fresh.take(Delta(LAST_NUMBER, 0))
    assert fresh.epoch == -1 and fresh.take(Delta(LAST_BELIEVED, 0))
    assert fresh.take(Delta(next_epoch(1, fresh.epoch), 0)) and fresh.epoch == LAST_BELIEVED + 1
    with pytest.raises(InputRefused):
        fresh.take(Delta(LAST_NUMBER, 0))
