"""What followers have been told, and the smallest delta to what they should know (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelName, LevelNode, rank
from prior_sg.schemas.regions import Region, RegionDelta, RegionEvent

K = TypeVar("K")
V = TypeVar("V")
_NONE = np.zeros(0, dtype=np.int64)
Nodes = dict[tuple[LevelName, int], LevelNode]


class Beliefs(NamedTuple):
    """What is believed of some places, as it travels."""

    place_ids: np.ndarray  # (place,)
    regions: np.ndarray  # (place,)
    posteriors: np.ndarray  # (place, label) float16
    unknown: np.ndarray  # (place,) float16
    predicted: np.ndarray  # (place,) bool

    def at(self, rows: np.ndarray) -> "Beliefs":
        """Those of some rows."""
        return Beliefs(*(column[rows] for column in self))

    @classmethod
    def none(cls, labels: int) -> "Beliefs":
        """Of no place."""
        half = np.zeros(0, np.float16)
        return cls(_NONE, _NONE, np.zeros((0, labels), np.float16), half, np.zeros(0, dtype=bool))


def nothing(robot: str, epoch: int, labels: Sequence[str] = ()) -> RegionDelta:
    """The empty state that the first delta follows on; with what a map is made from, the head of its deltas."""
    return RegionDelta(
        robot=robot,
        epoch=epoch,
        revision=-1,
        stamp_ns=0,
        prior_digest="",
        environment="",
        task="",
        space="",
        labels=list(labels),
        regions=[],
        removed_ids=_NONE,
        place_ids=_NONE,
        place_regions=_NONE,
        posteriors=np.zeros((0, len(labels)), np.float16),
        unknown=np.zeros(0, np.float16),
        removed_place_ids=_NONE,
        energy=0.0,
    )


@dataclass
class Ledger:
    """Everything that a follower of all deltas knows. Places are kept by slot, so a delta costs what it changes."""

    revision: int = -1
    head: RegionDelta | None = None  # from what the last delta was made, without what it told
    regions: dict[int, Region] = field(default_factory=dict)
    nodes: Nodes = field(default_factory=dict)
    told: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (slot,)
    beliefs: Beliefs = field(default_factory=lambda: Beliefs.none(0))  # (slot,)
    gone: dict[int, Beliefs] = field(default_factory=dict)  # places that have left, but followers do not know yet
    foresight: Foresight | None = None

    def forget(self, slots: np.ndarray) -> None:
        """These slots' places have left the graph; the slots may be given to others."""
        known = slots[slots < len(self.told)]
        for slot in known[self.told[known]].tolist():
            self.gone[int(self.beliefs.place_ids[slot])] = self.beliefs.at(np.array([slot]))
        self.told[known] = False

    def tell(
        self,
        head: RegionDelta,
        slots: np.ndarray,
        now: Beliefs,
        regions: dict[int, Region],
        events: list[RegionEvent],
        *,
        nodes: Nodes,
        foresight: Foresight | None = None,
        everything: bool,
        tolerance: float,
    ) -> RegionDelta | None:
        """The delta from what is known to what is so; None when there is nothing to tell.

        `head` is a delta that says from what this one is made, with nothing to tell, see `nothing`. `now` holds the
        places in `slots` (sorted by id), which are all that may have changed, or all with `everything`.
        `foresight` is what is news of it, None = nothing.
        A belief is sent when the region of the place changed or a probability moved by more than `tolerance` since it
        was last sent.
        """
        self._reserve(int(slots.max(initial=-1)) + 1, len(head.labels), everything)
        sent = np.flatnonzero(~self.told[slots] | self._differs(slots, now, tolerance))
        upserts = sorted(_news(regions, self.regions), key=lambda region: region.id)
        gone_regions = sorted(self.regions.keys() - regions.keys())
        moved_nodes = _news(nodes, self.nodes)
        gone_nodes = sorted(self.nodes.keys() - nodes.keys())
        moved_on = self.head is not None and head.space != self.head.space
        changed = len(sent) or upserts or gone_regions or self.gone or events or moved_nodes or gone_nodes
        if not (everything or moved_on or changed or foresight is not None):
            return None
        self.foresight = self.foresight if foresight is None else foresight
        for known, news in zip(self.beliefs, now, strict=True):
            known[slots[sent]] = news[sent]
        self.told[slots[sent]] = True
        gone_places = [] if everything else sorted(self.gone)
        self.gone.clear()
        self.head, self.regions, self.revision = head, dict(regions), self.revision + 1
        self.nodes = dict(nodes)
        listed = list(self.regions.values()) if everything else upserts
        return self._delta(
            head,
            sorted(listed, key=lambda region: region.id),
            now.at(sent),
            removed=([] if everything else gone_regions, gone_places),
            events=events,
            nodes=([] if everything else gone_nodes, list(nodes.values()) if everything else moved_nodes),
            snapshot=everything,
            foresight=self.foresight if everything else foresight,
        )

    def snapshot(self, robot: str, epoch: int) -> RegionDelta:
        """Everything told so far; before the first delta, the empty state that it follows on."""
        rows = np.flatnonzero(self.told)
        parts = [self.beliefs.at(rows), *self.gone.values()]
        whole = Beliefs(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        whole = whole.at(np.argsort(whole.place_ids, kind="stable"))
        listed = [region for _, region in sorted(self.regions.items())]
        head = nothing(robot, epoch) if self.head is None else self.head
        return self._delta(
            head,
            listed,
            whole,
            removed=([], []),
            events=[],
            nodes=([], list(self.nodes.values())),
            snapshot=True,
            foresight=self.foresight,
        )

    def _delta(
        self,
        head: RegionDelta,
        regions: list[Region],
        beliefs: Beliefs,
        *,
        removed: tuple[list[int], list[int]],
        events: list[RegionEvent],
        nodes: tuple[list[tuple[LevelName, int]], list[LevelNode]],
        snapshot: bool,
        foresight: Foresight | None,
    ) -> RegionDelta:
        return msgspec.structs.replace(
            head,
            revision=self.revision,
            snapshot=snapshot,
            regions=regions,
            removed_ids=np.array(removed[0], dtype=np.int64),
            place_ids=beliefs.place_ids,
            place_regions=beliefs.regions,
            posteriors=beliefs.posteriors,
            unknown=beliefs.unknown,
            removed_place_ids=np.array(removed[1], dtype=np.int64),
            predicted_ids=beliefs.place_ids[beliefs.predicted],
            events=events,
            removed_nodes=nodes[0],
            nodes=sorted(nodes[1], key=rank),
            foresight=foresight,
        )

    def _differs(self, slots: np.ndarray, now: Beliefs, tolerance: float) -> np.ndarray:
        before = self.beliefs.at(slots)
        return (
            (now.regions != before.regions)
            | (now.predicted != before.predicted)
            | _moved(now.posteriors, before.posteriors, tolerance).any(axis=1)
            | _moved(now.unknown, before.unknown, tolerance)
        )

    def _reserve(self, slots: int, labels: int, everything: bool) -> None:
        """Room for `slots` slots; with `everything`, nothing is known any more."""
        if everything:
            self.told[:] = False
            self.gone.clear()
        have = len(self.told)
        if slots <= have and self.beliefs.posteriors.shape[1] == labels:
            return
        size = max(slots, 2 * have) if slots > have else have
        widths = (None, None, labels, None, None)
        grown = []
        for column, width in zip(self.beliefs, widths, strict=True):
            room = np.zeros((size,) if width is None else (size, width), dtype=column.dtype)
            if room.shape[1:] == column.shape[1:]:
                room[:have] = column
            grown.append(room)
        self.beliefs = Beliefs(*grown)
        self.told = np.concatenate((self.told, np.zeros(size - have, dtype=bool)))


def _news(now: dict[K, V], told: dict[K, V]) -> list[V]:
    """What is not told yet, or otherwise; most regions are the very ones that were told."""
    others = [(key, one) for key, one in now.items() if told.get(key) is not one]
    return [one for key, one in others if told.get(key) != one]


def _moved(now: np.ndarray, before: np.ndarray, tolerance: float) -> np.ndarray:
    return np.abs(now.astype(np.float32) - before.astype(np.float32)) > tolerance
