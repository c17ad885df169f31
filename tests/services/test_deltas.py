"""Following deltas: whatever the order of arrival, the reader ends with what the writer holds."""

from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st

from prior_sg.services.deltas import Follower


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
    assert seen == list(range(len(seen)))
    before = follower.revision
    after = [d.revision for d in follower.take(Delta(1, snapshot_at, snapshot=True))]
    if snapshot_at > before:
        assert after == list(range(snapshot_at, snapshot_at + len(after)))
    else:
        assert after == []


@given(st.permutations(list(range(10))))
def test_every_permutation_ends_complete(order):
    follower, seen = Follower(), []
    for revision in order:
        seen += [d.revision for d in follower.take(Delta(1, revision))]
    assert seen == list(range(10)) and not follower.needs_snapshot
