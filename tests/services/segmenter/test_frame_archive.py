"""What is kept of the pyramids when there are too many."""

import math

import pytest

from prior_sg.services.segmenter.core.evidence import kernel
from prior_sg.services.segmenter.core.evidence.archive import FrameArchive, integrate_all, size_bytes
from prior_sg.services.segmenter.core.evidence.kernel import Evidence, KernelConfig, Targets
from tests.help.world import look, place_grid, pyramid, walk

LONE = look(6.0, 2.0, 0.0)


def frame(number, pose):
    return kernel.compact(pyramid(number, pose, rooms=2))


def room(frames):
    return frames * size_bytes(frame(0, LONE))


def test_the_limit_holds_and_the_oldest_of_the_fullest_view_goes():
    archive = FrameArchive()
    assert archive.add(0, frame(0, LONE), room(4))
    for number in range(1, 40):
        assert archive.add(number, frame(number, look(2.2, 2.2, 0.02 * (number % 3))), room(4))
    assert archive.size_bytes == room(4)
    assert sorted(archive.kept_ids) == [0, 37, 38, 39]  # the only one that looks from there, and the newest


def test_what_was_heard_is_not_taken_again():
    archive = FrameArchive()
    for number in range(9):
        archive.add(number, frame(number, LONE), room(2))
    assert sorted(archive.kept_ids) == [7, 8]
    assert not archive.add(0, frame(0, LONE), room(2))
    assert archive.frame_ids == set(range(9))
    assert len(archive) == 9


def test_one_frame_larger_than_the_limit_is_kept():
    archive = FrameArchive()
    archive.add(0, frame(0, LONE), 1.0)
    assert sorted(archive.kept_ids) == [0]


def test_a_corrected_frame_counts_where_it_is_now():
    archive = FrameArchive()
    for number in range(3):
        archive.add(number, frame(number, look(2.2, 2.2, 0.0)), math.inf)
    archive.move(0, LONE)
    for number in range(3, 6):
        archive.add(number, frame(number, look(2.2, 2.2, 0.0)), room(3))
    assert sorted(archive.kept_ids) == [0, 4, 5]
    assert archive.move(1, LONE) is None


@pytest.mark.parametrize("frames", [24, 36])
def test_places_look_the_same_from_what_is_kept_of_many_rounds(frames):
    positions, _ = place_grid(2)
    rounds = [pyramid(number, message.world_from_camera, rooms=2) for number, message in enumerate(walk(2) * 10)]

    def descriptors(limit_bytes):
        archive, evidence, ids = FrameArchive(), Evidence(), list(range(len(positions)))
        for message in rounds:
            archive.add(message.frame_id, kernel.compact(message), limit_bytes)
        evidence.add(ids)
        targets = Targets(evidence.of(ids), positions.astype(float))
        integrate_all(evidence, archive, targets, 0.75, KernelConfig())
        return evidence.descriptors(targets.slots), evidence.frames[targets.slots], len(archive.kept_ids)

    (every, seen, _), (some, seen_again, kept) = descriptors(math.inf), descriptors(room(frames))
    assert kept == frames < len(rounds)
    assert ((seen > 0) == (seen_again > 0)).all()
    assert ((every * some).sum(axis=1)[seen > 0] > 0.95).all()
