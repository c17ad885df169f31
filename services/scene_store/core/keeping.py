"""Which snapshots the history of a robot needs and which of it may go (pure)."""

from collections.abc import Sequence
from typing import NamedTuple

from prior_sg.services.scene_store.core.config import Config

EVENT_WEIGHT = 512  # bytes that applying any event is worth, beside its own
LEAST_WEIGHT = 65_536  # below it a snapshot does not pay
HELD_BACK = 4  # times the weight at which a snapshot is due; then it no longer waits for a quiet moment
NS_PER_S = 1e9


class Mark(NamedTuple):
    """Where one snapshot stands: after which event, at which revision, of which session, at what time."""

    sequence: int
    revision: int
    session: int
    stamp_ns: int


NO_MARK = Mark(0, -1, 0, 0)  # before the first snapshot


class Thinned(NamedTuple):
    """What goes: all events up to `sequence`, and the snapshots after these events."""

    sequence: int
    snapshots: list[int]


def due(weight: int, snapshot_bytes: int, *, waited: bool) -> bool:
    """Whether the events since a snapshot outweigh it, so that reading a revision costs at most about two snapshots;
    `waited`: there was no quiet moment so far, and there may be none."""
    return weight > max(snapshot_bytes, LEAST_WEIGHT) * (HELD_BACK if waited else 1)


def sampled(cfg: Config, newest_ns: int, stamp_ns: int) -> bool:
    """Whether a snapshot is due because the setting wants one every so often."""
    return cfg.history == "sampled" and abs(stamp_ns - newest_ns) >= cfg.history_every_s * NS_PER_S


def thinned(cfg: Config, marks: Sequence[Mark], present: int) -> Thinned | None:
    """What may go, given all snapshots in order and the present revision; None = nothing.

    The newest `history_last` revisions and the present keep their events, counted from the last snapshot before them.
    Of older ones `last` keeps nothing, `sampled` the last snapshot of each interval of a session.
    """
    old = [mark for mark in marks if mark.revision <= present - cfg.history_last]
    if cfg.history == "all" or not old:
        return None
    interval_ns = max(int(cfg.history_every_s * NS_PER_S), 1)
    kept = {(mark.session, mark.stamp_ns // interval_ns): mark.sequence for mark in old[:-1]}
    stays = set(kept.values()) if cfg.history == "sampled" else set()
    return Thinned(old[-1].sequence, [mark.sequence for mark in old[:-1] if mark.sequence not in stays])
