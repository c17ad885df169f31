"""Going on where another process was: its evidence, and the same ids for the regions and objects that it knew (pure).

A segmenter that others have gone before tells nothing until it has caught up, so that readers keep what they have. From
one that still serves it gets everything that one has seen; after one that died, pyramids come from the caches of the
workers, and what is missing there is encoded again. A region's id goes with most of its places, an object's with the
box that overlaps most.
"""

from dataclasses import dataclass, field

import numpy as np

from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.levels import LEVELS, LevelName, LevelNode
from prior_sg.schemas.objects import Detections, ObjectDelta, SceneObject
from prior_sg.schemas.regions import NO_REGION, Region, RegionDelta
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.succession import Bequest, Evidence, EvidenceRequest
from prior_sg.services.geometry import inverse
from prior_sg.services.segmenter.core.evidence.archive import FrameArchive
from prior_sg.services.segmenter.core.evidence.kernel import Frame

PAGE_BYTES = 4e6
SAME_MAP = 0.5  # share of the former places that must be in the map for it to be the same
LEAST_OVERLAP = 0.1  # of two boxes, intersection over union, from which on they may be of one object


@dataclass
class Legacy:
    """What readers know of regions and objects before this process."""

    place_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    place_regions: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))  # of each
    seen_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))  # places that were looked at
    regions: list[Region] = field(default_factory=list)
    nodes: list[LevelNode] = field(default_factory=list)
    objects: list[SceneObject] = field(default_factory=list)
    digest: str = ""  # of the prior that regions were labelled by
    next_region_id: int = 0
    next_object_id: int = 0
    next_node_ids: dict[LevelName, int] = field(default_factory=dict)  # of the levels above regions

    def hear(self, told: RegionDelta | ObjectDelta | Scene) -> None:
        """Take a snapshot, or the stored scene."""
        if isinstance(told, RegionDelta | Scene):
            self.place_ids, self.place_regions = np.array(told.place_ids), np.array(told.place_regions)
            labelled = self.place_regions != NO_REGION
            self.seen_ids = np.setdiff1d(self.place_ids[labelled], told.predicted_ids)
            self.regions, self.nodes, self.digest = list(told.regions), list(told.nodes), told.prior_digest
            self.next_region_id = max(self.next_region_id, *(region.id + 1 for region in told.regions), 0)
        if isinstance(told, ObjectDelta | Scene):
            self.objects = list(told.objects)
            self.next_object_id = max(self.next_object_id, *(one.id + 1 for one in told.objects), 0)

    def regions_of(self, place_ids: np.ndarray) -> np.ndarray:
        """The former region (place,) of each place, NO_REGION where there was none."""
        found = np.full(len(place_ids), NO_REGION, np.int64)
        if len(self.place_ids):
            order = np.argsort(self.place_ids)
            at = np.minimum(np.searchsorted(self.place_ids[order], place_ids), len(order) - 1)
            known = self.place_ids[order][at] == place_ids
            found[known] = self.place_regions[order][at[known]]
        return found


@dataclass
class CatchingUp:
    """What a process waits for before it tells anything. `stands_by` = another is in charge."""

    stands_by: bool = False
    gathers: bool = False  # evidence comes from caches, whose end nobody tells
    waits: set[str] = field(default_factory=set)  # answers that are still to come
    legacy: Legacy | None = None  # until it is taken over
    still_ticks: int = 0  # since more of the former map was seen
    seen: int = 0  # of the places that were looked at before, how many have been again

    @property
    def silent(self) -> bool:
        """Whether readers keep what they have."""
        return self.legacy is not None

    def begin(self, predecessor: str) -> None:
        """Others have gone before."""
        self.stands_by, self.gathers, self.legacy = bool(predecessor), not predecessor, Legacy()
        self.waits = {"regions", "objects", "evidence"} if predecessor else {"scene"}

    def hear(self, told: RegionDelta | ObjectDelta | Scene) -> None:
        """What readers know of regions or objects."""
        if self.legacy is not None:
            self.legacy.hear(told)
        kinds: dict[type, str] = {RegionDelta: "regions", ObjectDelta: "objects", Scene: "scene"}
        self.waits.discard(kinds[type(told)])

    def take_over(self, bequest: Bequest | None) -> None:
        """From now on this process is in charge."""
        self.stands_by, self.still_ticks = False, 0
        self.waits.clear()
        if bequest is not None and self.legacy is not None:
            for told in (bequest.regions, bequest.objects):
                if told is not None:
                    self.legacy.hear(told)
            self.legacy.next_region_id = max(self.legacy.next_region_id, bequest.next_ids.get("regions", 0))
            self.legacy.next_object_id = max(self.legacy.next_object_id, bequest.next_ids.get("objects", 0))
            self.legacy.next_node_ids = {level: bequest.next_ids.get(level, 0) for level in LEVELS}

    def tick(self, seen: int) -> None:
        """Half a second has passed; so many of the places that were looked at before have been again."""
        self.still_ticks = self.still_ticks + 1 if seen == self.seen else 0
        self.seen = seen


def page(
    robot: str, space: str, spaces: dict[str, FrameArchive], detections: list[Detections], request: EvidenceRequest
) -> Evidence:
    """The next of what was seen, in the order of frame numbers; frames are whole."""
    frames: dict[int, list[tuple[str, Frame] | Detections]] = {}
    for name, archive in spaces.items():
        for frame_id in archive.kept_ids:
            frames.setdefault(frame_id, []).append((name, archive.get(frame_id)))
    for one in detections:
        frames.setdefault(one.frame_id, []).append(one)
    size, last, pyramids, found = 0.0, request.after_frame_id, [], []
    for frame_id in sorted(number for number in frames if number > request.after_frame_id):
        if size > PAGE_BYTES:
            break
        last = frame_id
        for kept in frames[frame_id]:
            if isinstance(kept, Detections):
                found.append(kept)
                size += kept.embeddings.nbytes + kept.points_camera_m.nbytes + kept.surface_m.nbytes
            else:
                pyramids.append(_pyramid(robot, frame_id, *kept))
                size += kept[1].embeddings.nbytes + 2 * kept[1].surface_m.nbytes
    return Evidence(robot=robot, space=space, last_frame_id=last, pyramids=pyramids, detections=found)


def _pyramid(robot: str, frame_id: int, space: str, frame: Frame) -> Pyramid:
    """What integration needs of a frame, as it came."""
    count = len(frame.sigmas_px)
    layers = np.zeros(count, np.uint8)
    layers[frame.layer_starts[1:]] = 1
    return Pyramid(
        robot=robot,
        frame_id=frame_id,
        stamp_ns=0,
        space=space,
        worker="",
        intrinsics=frame.intrinsics,
        world_from_camera=inverse(frame.camera_from_world),
        centers_px=frame.centers_px,
        sigmas_px=frame.sigmas_px,
        layers=np.cumsum(layers, dtype=np.uint8),
        depths_m=np.zeros(count, np.float32),
        embeddings=frame.embeddings,
        surface_m=frame.surface_m.astype(np.float32),
        crops_total=count,
    )


def same_objects(former: list[SceneObject], ids: list[int], boxes_m: np.ndarray) -> dict[int, int]:
    """The former id of each object (`ids`, with boxes (object, 2, 3)) that has one: most overlap first, each once."""
    if not (former and len(ids)):
        return {}
    before = np.array([(one.min_m, one.max_m) for one in former])
    low = np.maximum(before[:, None, 0], boxes_m[None, :, 0])
    high = np.minimum(before[:, None, 1], boxes_m[None, :, 1])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    volumes = (np.prod(before[:, 1] - before[:, 0], axis=1)[:, None], np.prod(boxes_m[:, 1] - boxes_m[:, 0], axis=1))
    overlap = shared / np.maximum(volumes[0] + volumes[1] - shared, 1e-12)
    rows, columns = np.nonzero(overlap >= LEAST_OVERLAP)
    found: dict[int, int] = {}
    taken: set[int] = set()
    for at in np.lexsort((columns, rows, -overlap[rows, columns])).tolist():
        old, own = former[rows[at]].id, ids[columns[at]]
        if own not in found and old not in taken:
            found[own] = old
            taken.add(old)
    return found
