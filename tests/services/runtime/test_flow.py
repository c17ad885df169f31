"""Back-pressure: who is waited for, and for how long."""

import math

from prior_sg.services.runtime.host.flow import STUCK_S, Progress


def progress_at(clock):
    return Progress(lambda: clock[0])


def test_a_reader_counts_once_it_is_alive_and_no_longer_when_it_is_gone():
    progress = progress_at([0.0])
    progress.reader("claimed", ["T"])
    assert progress.lag("T") == math.inf
    progress.reader("real", ["T"])
    progress.alive("real", True)
    progress.published("T", 4)
    progress.consumed("real", "T", 3)
    assert progress.lag("T") == 1
    progress.alive("real", False)
    assert progress.lag("T") == math.inf


def test_a_reader_that_only_claims_to_exist_is_not_waited_for_without_bound(caplog):
    clock = [0.0]
    progress = progress_at(clock)
    for name in ("real", "claimed"):
        progress.reader(name, ["T"])
        progress.alive(name, True)
    for number in range(6):
        progress.published("T", number)
        clock[0] += STUCK_S / 4
        progress.consumed("real", "T", number)
        assert progress.lag("T") == (number + 1 if number < 4 else 0)
    assert "waited for no longer" in caplog.text and len(caplog.records) == 1
    progress.consumed("claimed", "T", 3)  # it was only slow
    assert progress.lag("T") == 2


def test_a_reader_that_had_nothing_to_do_is_not_stuck():
    clock = [0.0]
    progress = progress_at(clock)
    progress.reader("a", ["T"])
    progress.alive("a", True)
    progress.published("T", 0)
    progress.consumed("a", "T", 0)
    clock[0] += 10 * STUCK_S
    progress.published("T", 1)
    assert progress.lag("T") == 1
