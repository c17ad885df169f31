"""Losses counted by reason."""

from hypothesis import given
from hypothesis import strategies as st

from prior_sg.services.losses import MOST_REASONS, Losses, kind_of, line, merged


def test_reasons_that_differ_in_numbers_are_one():
    losses = Losses()
    for number in range(3):
        losses.add("frames refused", f"its stamp is {number}.500 s before", of=f"frame {number}")
    losses.add("frames refused", "it is damaged")
    first, second = losses.told
    assert (first.count, first.reason) == (3, "its stamp is … s before")
    assert line(first, 9) == "3 of 9 frames refused: its stamp is … s before (frame 0: its stamp is 0.500 s before)"
    assert line(second) == "1 frame refused: it is damaged"
    assert losses.count("frames refused") == 4
    losses.add("frames refused", "its depth is empty", of="frame 9")
    assert line(losses.told[-1], 9) == "1 of 9 frames refused: its depth is empty (frame 9)"


def test_one_of_a_kind_is_told_in_the_singular():
    losses = Losses()
    losses.add("clock jumps", "the clock jumped by +3600.000 s at frame 6", reason="believed again")
    assert line(losses.told[0]).startswith("1 clock jump: believed again")
    losses.add("clock jumps", "the clock jumped by -3600.000 s at frame 9", reason="believed again")
    assert line(losses.told[0]).startswith("2 clock jumps: ")


@given(st.lists(st.text(max_size=8)))
def test_reasons_are_bounded_and_none_is_lost(texts):
    losses = Losses()
    for text in texts:
        losses.add("messages ignored", text)
    assert len(losses.told) <= MOST_REASONS + 1
    assert losses.count("messages ignored") == len(texts)


def test_losses_of_several_workers_are_added():
    one, other = Losses(), Losses()
    one.add("keyframes not encoded", "x")
    other.add("keyframes not encoded", "x")
    other.add("keyframes not encoded", "y")
    assert [(loss.reason, loss.count) for loss in merged(one.told + other.told)] == [("x", 2), ("y", 1)]


def test_numbers_of_any_form_are_left_out():
    assert kind_of("by -1.5e-3 m at 12:30, 50% of 000012.png") == "by … m at …, … of ….png"
