"""What was seen: the frames of the space in force, the evidence of each place, and the spaces that wait (pure)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from prior_sg.schemas.features import Pyramid
from prior_sg.services.losses import Losses
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.evidence import handover, kernel
from prior_sg.services.segmenter.core.evidence.archive import FrameArchive, integrate_all
from prior_sg.services.segmenter.core.evidence.handover import Spaces
from prior_sg.services.segmenter.core.evidence.surfaces import Shown

RESTING_TICKS = 2  # without a pyramid, after which the map rests


@dataclass
class Seen:
    """All frames, the evidence that places hold of them, and the spaces that may take over."""

    spaces: Spaces
    query_radius_m: float  # r_Q with which the evidence was integrated
    archive: FrameArchive = field(default_factory=FrameArchive)
    evidence: kernel.Evidence = field(default_factory=kernel.Evidence)
    shown: Shown = field(default_factory=Shown)
    losses: Losses = field(default_factory=Losses)  # pyramids ignored

    @property
    def rests(self) -> bool:
        """Whether no pyramids come at the moment."""
        return self.spaces.still_ticks >= RESTING_TICKS

    @property
    def archives(self) -> dict[str, FrameArchive]:
        """All frames, by space."""
        return {name: rival.archive for name, rival in self.spaces.rivals.items()} | {self.spaces.force: self.archive}

    def holds(self, pyramid: Pyramid) -> bool:
        """Whether this pyramid is here already."""
        archive = self.archives.get(pyramid.space)
        return archive is not None and pyramid.frame_id in archive.frame_ids

    def observe(self, pyramid: Pyramid, targets: kernel.Targets, cfg: Config) -> np.ndarray | None:
        """Integrate a frame into the targets that it sees; their rows. None for a repeat; a pyramid of another space is
        kept apart."""
        limit_bytes = cfg.evidence_mb * 1e6
        if pyramid.space != self.spaces.force:
            if not handover.hear(self.spaces, pyramid, self.archive, cfg.spaces, limit_bytes):
                self._ignore(pyramid, "its space is not in force")
            return None
        handover.heard_in_force(self.spaces)
        frame = kernel.compact(pyramid)
        if not self.evidence.fits(frame):
            self._ignore(pyramid, "its embeddings have another size than those before")
            return None
        if not self.archive.add(pyramid.frame_id, frame, limit_bytes):
            self._ignore(pyramid, "it repeats one")
            return None
        return kernel.integrate(self.evidence, frame, targets, self.query_radius_m, cfg.kernel)

    def _ignore(self, pyramid: Pyramid, reason: str) -> None:
        self.losses.add("pyramids ignored", reason, of=f"keyframe {pyramid.frame_id}, {pyramid.space}")

    def integrate_afresh(self, place_ids: np.ndarray, positions_m: np.ndarray, cfg: Config) -> np.ndarray:
        """Compute the evidence of some places afresh from all frames that are kept; the slots (place,) that hold it."""
        self.evidence.add(place_ids.tolist())
        slots = self.evidence.of(place_ids.tolist())
        targets = kernel.Targets(slots, positions_m)
        integrate_all(self.evidence, self.archive, targets, self.query_radius_m, cfg.kernel)
        return slots

    def move(self, poses: Mapping[int, np.ndarray], positions_m: np.ndarray, cfg: Config) -> np.ndarray:
        """Re-anchor frames; mask (place,) of the positions that they saw from the old pose or see from the new one."""
        affected = np.zeros(len(positions_m), dtype=bool)
        for frame_id, world_from_camera in poses.items():
            handover.move(self.spaces, frame_id, world_from_camera)
            for frame in self.archive.move(frame_id, world_from_camera) or ():
                affected[kernel.visible(frame, positions_m, cfg.kernel)] = True
        return affected

    def succeed(self, name: str, targets: kernel.Targets, cfg: Config) -> bool:
        """Put another space in force if its frames cover the targets; otherwise it is tried again when it has grown."""
        evidence, archive = self.evidence.blank(), self.spaces.rivals[name].archive
        integrate_all(evidence, archive, targets, self.query_radius_m, cfg.kernel)
        if not handover.covers(evidence, self.evidence, targets.slots, cfg.spaces):
            handover.refuse(self.spaces, name)
            return False
        self.archive, self.evidence = handover.succeed(self.spaces, name), evidence
        return True

    def pretend(self, place_ids: np.ndarray, embeddings: np.ndarray) -> None:
        """Places (place,) that were observed look as if nothing but `embeddings` (place, dim) had been seen there."""
        slots = self.evidence.of(place_ids.tolist())
        observed = self.evidence.frames[slots] > 0
        self.evidence.sums[slots[observed]] = embeddings[observed]
