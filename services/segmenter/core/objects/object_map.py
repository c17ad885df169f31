"""The objects of the map: their tracks, what experts see of them, and what followers know (pure)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from prior_sg.schemas.objects import Detections, ObjectDelta, SceneObject
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.objects import association, renewal, tracks
from prior_sg.services.segmenter.core.objects.ledger import ObjectLedger, view_of
from prior_sg.services.segmenter.core.objects.names import Named
from prior_sg.services.segmenter.core.objects.track import TrackingConfig
from prior_sg.services.segmenter.core.objects.tracks import Tracks
from prior_sg.services.segmenter.core.succession import same_objects


@dataclass
class ObjectMap:
    """Objects as tracked, as experts see them, and as followers know them."""

    tracks: Tracks
    view: ObjectView = field(default_factory=ObjectView)
    present: ObjectView | None = None  # as they are now, where they are named
    ledger: ObjectLedger = field(default_factory=ObjectLedger)

    def observe(self, detections: Detections, cfg: TrackingConfig) -> bool:
        """Associate one frame's detections; False for those that cannot be used."""
        return association.observe(self.tracks, detections, cfg)

    def holds(self, detections: Detections) -> bool:
        """Whether these are here already."""
        return (detections.space, detections.detector, detections.frame_id) in self.tracks.archive

    def sort(self) -> None:
        """Associate all detections afresh if they did not come in the order of their frames."""
        tracks.in_order(self.tracks)

    def outdated(self, space: str) -> bool:
        """Whether `renew` has to be called before these are the objects of a space."""
        return tracks.outdated(self.tracks, space)

    def inherit(self, former: list[SceneObject], next_id: int, cfg: TrackingConfig) -> None:
        """Give the objects the ids that they had before this process, and tell them all anew."""
        items = list(self.tracks.items.values())
        boxes_m = np.array([track.box_m(cfg) for track in items]).reshape(-1, 2, 3)
        number = same_objects(former, [track.id for track in items], boxes_m)
        next_id = max(next_id, self.tracks.next_id)
        for track in items:
            if track.id not in number:
                number[track.id], next_id = next_id, next_id + 1
        tracks.renumber(self.tracks, number, next_id)
        self.ledger = ObjectLedger()

    def move(self, poses: Mapping[int, np.ndarray]) -> None:
        """Frames have other poses (4, 4), by frame id."""
        tracks.move(self.tracks, dict(poses))

    def floor_changed(self) -> None:
        """Heights of objects count from the floor: they are to be named again."""
        self.tracks.changed = True

    def renew(self, space: str, rests: bool, cfg: TrackingConfig) -> bool:
        """Go on with associating afresh where that is due, which for those that came late is when no more come; whether
        the objects are those of the space."""
        if rests:
            tracks.in_order(self.tracks)
        if tracks.outdated(self.tracks, space):
            renewal.renew(self.tracks, space, cfg.renew_frames_at_rest if rests else cfg.renew_frames, cfg)
        return self.tracks.space == space

    def tell(self, robot: str, epoch: int, stamp_ns: int, *, now: dict[int, Named], digest: str) -> ObjectDelta | None:
        """The delta to the objects as they are `now`, named by the prior with this digest; None without news."""
        merged = self.tracks.merged
        self.tracks.merged, self.tracks.changed = [], False
        delta = self.ledger.tell(robot, epoch, stamp_ns, now=now, merged=merged, digest=digest)
        if now or delta is not None or self.present is not None:
            self.present = view_of(now.values())
        return delta

    def see(self, view: ObjectView) -> np.ndarray:
        """From now on these are the objects of the map; where (n, 3) some are new, changed or gone."""
        changed_m = view.changed_m(self.view)
        self.view = view
        return changed_m

    def start_afresh(self, prior: Prior, switched: bool) -> None:
        """A prior has come into force, with `switched` after another: the objects are to be named in its terms."""
        if len(prior.objects) != self.view.concepts.shape[1] or switched:
            self.view = ObjectView()  # its columns are the former prior's objects
        self.present = None
        self.tracks.changed = True
