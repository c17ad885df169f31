"""What a service says to an input that is well formed and absurd, and to a question that comes too early (pure)."""

AHEAD_DAYS = 30  # by which a clock may be ahead of another before what it stamped is refused
CLOCK_SET_NS = 1_700_000_000 * 10**9  # a clock that says less has not been set, and judges no other


class InputRefused(ValueError):
    """An input cannot be what it says; the message is one sentence. Nothing has been changed by it. Faults of a program
    are never told this way: they end the service."""


class NotYet(Exception):
    """A question cannot be answered yet; the message is one sentence. Whoever asks may ask again."""


def fault_of_stamp(what: str, stamp_ns: int, now_ns: int) -> str:
    """Why a stamp that decides which of several is newer is not believed, as a sentence; empty when it is."""
    ahead_days = (stamp_ns - now_ns) / 86_400e9
    if now_ns < CLOCK_SET_NS or ahead_days <= AHEAD_DAYS:
        return ""
    return f"{what} is stamped {ahead_days:.0f} days ahead of the clock here: set the clock of one of the two hosts"
