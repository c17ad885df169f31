"""What followers have been told of the objects, and the smallest delta to what they should know (pure)."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from prior_sg.schemas.markers import MarkerKey, SceneMarker
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.objects.names import Named

VISIBLE_CHANGE = 0.02  # smaller changes of a probability are not sent


@dataclass
class ObjectLedger:
    """What followers know."""

    told: dict[int, Named] = field(default_factory=dict)
    markers: dict[MarkerKey, SceneMarker] = field(default_factory=dict)
    digest: str = ""
    revision: int = -1
    stamp_ns: int = 0

    def snapshot(self, robot: str, epoch: int) -> ObjectDelta:
        """Everything told so far; before the first delta, the empty state that it follows on."""
        entries = [item.entry for _, item in sorted(self.told.items())]
        markers = [marker for _, marker in sorted(self.markers.items())]
        return self._delta(robot, epoch, entries, markers=markers, snapshot=True)

    def tell(
        self,
        robot: str,
        epoch: int,
        stamp_ns: int,
        *,
        now: dict[int, Named],
        merged: list[tuple[int, int]],
        digest: str,
    ) -> ObjectDelta | None:
        """The delta from what is known to what is so; None when nothing changed visibly."""
        known = self.told if digest == self.digest else {}
        upserts = [item for number, item in now.items() if number not in known or _differs(item, known[number])]
        heirs = dict(merged)
        joined = []
        for gone in sorted(self.told.keys() & heirs.keys() - now.keys()):
            into = heirs[gone]
            while into not in now and into in heirs:
                into = heirs[into]
            joined += [(gone, into)] if into in now else []
        removed = sorted(self.told.keys() - now.keys() - {gone for gone, _ in joined})
        if not (upserts or joined or removed):
            return None
        self.told = {number: known.get(number, item) for number, item in now.items()}
        self.told |= {item.entry.id: item for item in upserts}
        self.digest, self.revision, self.stamp_ns = digest, self.revision + 1, stamp_ns
        return self._delta(robot, epoch, [item.entry for item in upserts], removed, joined)

    def tell_markers(self, robot: str, epoch: int, stamp_ns: int, news: list[SceneMarker]) -> ObjectDelta | None:
        """The delta of markers that stand otherwise than was told; None without any."""
        if not news:
            return None
        self.markers |= {marker.key: marker for marker in news}
        self.revision, self.stamp_ns = self.revision + 1, stamp_ns
        return self._delta(robot, epoch, [], markers=news)

    def _delta(
        self,
        robot: str,
        epoch: int,
        entries: list[SceneObject],
        removed: list[int] | None = None,
        joined: list[tuple[int, int]] | None = None,
        *,
        markers: list[SceneMarker] | None = None,
        snapshot: bool = False,
    ) -> ObjectDelta:
        return ObjectDelta(
            robot=robot,
            epoch=epoch,
            revision=self.revision,
            stamp_ns=self.stamp_ns,
            prior_digest=self.digest,
            snapshot=snapshot,
            objects=entries,
            removed_ids=np.array(removed or [], np.int64),
            merged_ids=np.array(joined or [], np.int64).reshape(-1, 2),
            markers=markers or [],
        )


def view_of(items: Iterable[Named]) -> ObjectView:
    """Those objects that carry a label or have a say, for regions and experts."""
    named = [item for item in items if item.entry.label or item.weight > 0]
    if not named:
        return ObjectView()
    return ObjectView(
        ids=np.array([item.entry.id for item in named], np.int64),
        positions_m=np.array([item.entry.position_m for item in named]),
        concepts=np.array([item.concepts for item in named]),
        weights=np.array([item.weight for item in named]),
        sought=np.array([item.sought for item in named]),
    )


def _differs(now: Named, before: Named) -> bool:
    """Whether somebody who looks would see it; a number of frames counts when it has doubled."""
    one, other = now.entry, before.entry
    return (
        (one.label, one.min_m, one.max_m) != (other.label, other.min_m, other.max_m)
        or abs(one.probability - other.probability) > VISIBLE_CHANGE
        or abs(one.known - other.known) > VISIBLE_CHANGE
        or one.frames >= 2 * other.frames
        or one.frames < other.frames
        or len(now.concepts) != len(before.concepts)
    )
