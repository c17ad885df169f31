"""One object: its cells, its descriptor and what it was seen in (paper, eq. temporal_fusion_objects; pure)."""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.schemas.objects import Detections
from prior_sg.services.segmenter.core.objects.cells import bounds_of, unpacked


class TrackingConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How detections become objects, and how loudly these speak; the paper leaves these values open."""

    cell_m: float = 0.15  # grid of an object's surface; surfaces one cell apart count as the same
    match_overlap: float = 0.4  # of a detection and an object: least share of one in the other
    match_part: float = 0.1  # and least share the other way round: a cup on a table is not the table
    descriptor_weight: float = 0.5  # of the cosine similarity against the overlap, between several candidates
    merge_overlap: float = 0.6  # mean of both shares from which two objects are one
    box_share: float = 0.2  # of an object's frames that must show a cell for it to lie in the object's box
    firm_share: float = 0.33  # of an object's frames that must show a cell for it to hold two parts together
    split_frames: int = 4  # an object seen in fewer frames is not split
    split_joint: float = (
        0.25  # of the detections that show the lesser of two parts: if fewer show both, it is split off
    )
    part_share: float = 0.2  # of a detection's cells that must lie in a part, for it to show that part
    min_frames: int = 2  # keyframes that must have detected an object
    patience_frames: int = 5  # later frames that look at it in vain, after which one seen in fewer is dropped
    max_depth_m: float = 6.0  # frames farther away do not count as looking
    observations: int = 32  # embeddings kept per object, the newest
    renew_frames: int = 64  # associated afresh per half second after a correction of poses, or of another space
    renew_frames_at_rest: int = 512  # likewise, while no pyramids come
    archive_frames: int = 2000  # frames whose detections are kept, over all spaces, the newest
    label_least: float = (
        0.5  # probability of being one of the prior's objects from which on an object carries its label
    )
    detector_trust: float = 0.8  # share of an object's belief that the names have for which detectors found it
    unprompted_weight: float = 1.0  # in the object expert, of objects that none of the prior's names was sought for

    def __post_init__(self) -> None:
        counts = (self.min_frames, self.observations, self.archive_frames, self.renew_frames, self.renew_frames_at_rest)
        if not (self.cell_m > 0 and min(counts) >= 1):
            raise ValueError("cell_m and numbers of frames and observations must be positive")
        if not (0 < self.match_overlap <= 1 and 0 <= self.match_part <= 1 and 0 < self.merge_overlap <= 1):
            raise ValueError("match_overlap, match_part and merge_overlap are shares")
        shares = (self.label_least, self.detector_trust, self.unprompted_weight, self.box_share, self.firm_share)
        if not all(0 <= share <= 1 for share in (*shares, self.split_joint, self.part_share)):
            raise ValueError("label_least, detector_trust, unprompted_weight and shares lie in [0, 1]")


@dataclass
class Track:
    """One object."""

    id: int
    cells: np.ndarray  # (cell,) int64, sorted
    hits: np.ndarray  # (cell,) detections that touched it
    embeddings: list[np.ndarray]  # (dim,) float16 each, the newest last
    sources: set[tuple[str, int, int]]  # detector, frame id and number of each detection
    votes: dict[str, float]  # sums of the detections' scores, by the name that they were found for
    missed: int = 0  # frames that looked at it in vain
    look_again: int = 0  # number of frames from which on it is looked at whether it is two
    frames: int = field(init=False)  # keyframes in which it was detected
    bounds: np.ndarray = field(init=False)  # (2, 3) least and greatest cell numbers

    def __post_init__(self) -> None:
        self.frames, self.bounds = _frames(self.sources), bounds_of(self.cells)

    def firm(self, share: float = 0.0) -> np.ndarray:
        """Its cells, sorted, that at least a share of its frames shows; once it has three frames, one is not enough."""
        least = max(share * self.frames, 2 if self.frames > 2 else 1)
        return self.cells[self.hits >= min(least, self.hits.max())]

    def box_m(self, cfg: TrackingConfig) -> np.ndarray:
        """Corners (2, 3) of the box around what enough of its frames show."""
        numbers = unpacked(self.firm(cfg.box_share))
        return np.stack((numbers.min(axis=0), numbers.max(axis=0) + 1)) * cfg.cell_m


def extend(track: Track, more: Track, cfg: TrackingConfig) -> None:
    """`track` holds what `more` holds, too."""
    every, where = np.unique(np.concatenate((track.cells, more.cells)), return_inverse=True)
    counts = np.bincount(where, np.concatenate((track.hits, more.hits)), minlength=len(every))
    track.cells, track.hits = every, counts.astype(np.int64)
    track.bounds = np.stack((np.minimum(track.bounds[0], more.bounds[0]), np.maximum(track.bounds[1], more.bounds[1])))
    track.embeddings = [*track.embeddings, *more.embeddings][-cfg.observations :]
    track.sources |= more.sources
    track.frames = _frames(track.sources)
    for name, score in more.votes.items():
        track.votes[name] = track.votes.get(name, 0.0) + score


def _frames(sources: set[tuple[str, int, int]]) -> int:
    return len({frame_id for _, frame_id, _ in sources})


def vote(detections: Detections, index: int) -> dict[str, float]:
    """The name that a detection was found for, with its score; nothing where no names were sought."""
    if not detections.sought:
        return {}
    return {detections.sought[detections.names[index]]: float(detections.scores[index])}


def descriptor(embeddings: list[np.ndarray]) -> np.ndarray:
    """Unit descriptor (dim,) of unit observations: their mean, weighted by centrality (eq. temporal_fusion_objects).

    The weight of an observation is its mean cosine similarity to the others, at least 0; where all are 0, or there is
    one only, they count alike.
    """
    stack = np.array(embeddings, dtype=np.float64)
    weights = np.ones(len(stack))
    if len(stack) > 1:
        centrality = (stack @ stack.sum(axis=0) - (stack * stack).sum(axis=1)) / (len(stack) - 1)
        weights = np.maximum(centrality, 0.0) if (centrality > 0).any() else weights
    mean = weights @ stack
    return mean / max(float(np.linalg.norm(mean)), 1e-12)
