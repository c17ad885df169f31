"""Objects of the map: detections associated over time (paper, eq. temporal_fusion_objects; pure).

A detection's points, moved into the world, fill cells of a grid. It belongs to the object whose cells it shares, the
descriptor deciding between several; objects that come to share most of their cells become one, the older stays. An
object whose cells lie in two parts that few detections show together is two; the part shown more often keeps the id. An
object seen once, and not again although several later frames looked at it, was none.

Detections stay in an archive, without their images: a corrected pose, or another embedding space, associates them
afresh. An object then keeps the id under which most of its detections were known.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np
import scipy

from prior_sg.schemas.codec import copied
from prior_sg.schemas.objects import Detections
from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.segmenter.core.evidence import kernel

AXIS_BITS = 21  # of a cell's number for each axis: 200 km of 0.1 m cells
_STEPS = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
AROUND = (_STEPS[:, 0] << 2 * AXIS_BITS) + (_STEPS[:, 1] << AXIS_BITS) + _STEPS[:, 2]  # a cell and its 26 neighbours
COLUMNS = AROUND[_STEPS[:, 2] == 0]  # and the middles of the nine columns that these are


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
        self.frames, self.bounds = _frames(self.sources), _bounds(self.cells)

    def firm(self, share: float = 0.0) -> np.ndarray:
        """Its cells, sorted, that at least a share of its frames shows; once it has three frames, one is not enough."""
        least = max(share * self.frames, 2 if self.frames > 2 else 1)
        return self.cells[self.hits >= min(least, self.hits.max())]

    def box_m(self, cfg: TrackingConfig) -> np.ndarray:
        """Corners (2, 3) of the box around what enough of its frames show."""
        numbers = unpacked(self.firm(cfg.box_share))
        return np.stack((numbers.min(axis=0), numbers.max(axis=0) + 1)) * cfg.cell_m


@dataclass
class Tracks:
    """All objects, and the detections they were made from."""

    space: str = ""  # of the detections that the objects are made from
    items: dict[int, Track] = field(default_factory=dict)  # by id
    archive: dict[tuple[str, str, int], Detections] = field(default_factory=dict)  # by space, detector and frame id
    widths: dict[str, int] = field(default_factory=dict)  # of the embeddings, by space
    next_id: int = 0
    merged: list[tuple[int, int]] = field(default_factory=list)  # (gone, into) since they were last told
    moved: bool = False  # a pose in the archive was corrected since `renewal` began
    newest: tuple[int, str] = (-1, "")  # frame id and detector of what was associated last, in the order of frames
    disordered: bool = False  # something older than that was associated after it
    forgetful: bool = False  # detections have left the archive
    renewal: "Renewal | None" = None
    changed: bool = False  # since they were last told


@dataclass
class Renewal:
    """An association of all detections afresh, under way; until it is done the objects stay as they are."""

    fresh: Tracks
    waiting: deque[tuple[str, str, int]]  # keys of the archive


def observe(tracks: Tracks, detections: Detections, cfg: TrackingConfig) -> bool:
    """Keep one frame's detections, and associate them if they are of the space in force; False for a repeat, or for
    embeddings of another width than the space's."""
    key = (detections.space, detections.detector, detections.frame_id)
    width = tracks.widths.setdefault(detections.space, detections.embeddings.shape[1])
    if key in tracks.archive or detections.embeddings.shape[1] != width:
        return False
    tracks.archive[key] = kept = copied(detections)
    if len(tracks.archive) > cfg.archive_frames:
        del tracks.archive[next(iter(tracks.archive))]
        tracks.forgetful = True
    if detections.space == (tracks.space if tracks.renewal is None else tracks.renewal.fresh.space):
        tracks.disordered |= _place(key) < tracks.newest
        tracks.newest = max(_place(key), tracks.newest)
    if tracks.renewal is not None and detections.space == tracks.renewal.fresh.space:
        tracks.renewal.waiting.append(key)
    elif detections.space == tracks.space and not tracks.moved:
        associate(tracks, kept, cfg)
    return True


def move(tracks: Tracks, poses: dict[int, np.ndarray]) -> None:
    """Give frames their corrected poses, world_from_camera by frame id; `renew` then associates afresh."""
    for key, kept in tracks.archive.items():
        if key[2] in poses:
            tracks.archive[key] = msgspec.structs.replace(kept, world_from_camera=poses[key[2]].copy())
            tracks.moved = True


def renumber(tracks: Tracks, number: Mapping[int, int], next_id: int) -> None:
    """Objects have other ids; nothing of them may have been told yet."""
    for track in tracks.items.values():
        track.id = number[track.id]
    tracks.items = dict(sorted((track.id, track) for track in tracks.items.values()))
    tracks.next_id, tracks.merged, tracks.changed = next_id, [], True


def in_order(tracks: Tracks) -> None:
    """Detections that came late, or from several workers, are to be associated afresh in the order of their frames:
    what the objects are does not depend on the way. Not so once some are lost, of which objects would know less."""
    if tracks.disordered and not tracks.forgetful:
        tracks.archive = dict(sorted(tracks.archive.items(), key=lambda kept: _place(kept[0])))
        tracks.moved, tracks.disordered = True, False


def _place(key: tuple[str, str, int]) -> tuple[int, str]:
    """Where a key of the archive stands in the order of frames."""
    _, detector, frame_id = key
    return frame_id, detector


def outdated(tracks: Tracks, space: str) -> bool:
    """Whether `renew` has to be called, again, before the objects are those of a space and of the poses as they are."""
    return tracks.moved or tracks.renewal is not None or tracks.space != space


def renew(tracks: Tracks, space: str, frames: int, cfg: TrackingConfig) -> None:
    """Associate stored detections of a space afresh, in the order of frames, those of at most so many at a time.

    With the last of them the objects change over; ids last by the detections that objects share. Poses corrected
    meanwhile begin another renewal afterwards, so that frequent corrections do not keep the objects from changing.
    """
    if tracks.renewal is None or tracks.renewal.fresh.space != space:
        keys = sorted((key for key in tracks.archive if key[0] == space), key=_place)
        tracks.renewal = Renewal(Tracks(space=space, archive=tracks.archive), deque(keys))
        tracks.newest, tracks.moved, tracks.disordered = _place(keys[-1]) if keys else (-1, ""), False, False
    fresh, waiting = tracks.renewal.fresh, tracks.renewal.waiting
    for _ in range(min(frames, len(waiting))):
        detections = tracks.archive.get(waiting.popleft())
        if detections is not None:  # it may have left the archive meanwhile
            associate(fresh, detections, cfg)
    if not waiting:
        tracks.renewal = None
        _change_over(tracks, fresh)


def _change_over(tracks: Tracks, fresh: Tracks) -> None:
    """The fresh objects take the places of the former, under their ids. A former one of which the archive holds nothing
    any more stays where it was."""
    heirs = _heirs(list(tracks.items.values()), list(fresh.items.values()))
    items = {}
    for track in fresh.items.values():
        former = [old for old, heir in heirs.items() if heir == track.id]
        best = max(former, key=lambda old: (len(tracks.items[old].sources & track.sources), -old), default=None)
        number = tracks.next_id if best is None else best
        tracks.next_id += best is None
        tracks.merged += [(old, number) for old in former if old != best]
        track.id = number
        items[number] = track
    if fresh.space == tracks.space:
        items |= {number: track for number, track in tracks.items.items() if not _archived(tracks, track)}
    tracks.space, tracks.items, tracks.changed = fresh.space, dict(sorted(items.items())), True


def _archived(tracks: Tracks, track: Track) -> bool:
    """Whether any of its detections is in the archive."""
    return any((tracks.space, detector, frame_id) in tracks.archive for detector, frame_id, _ in track.sources)


def _heirs(before: list[Track], after: list[Track]) -> dict[int, int]:
    """The new object that holds most of each former one's detections, by id."""
    holder = {source: track.id for track in after for source in track.sources}
    heirs = {}
    for track in before:
        held = [holder[source] for source in track.sources if source in holder]
        if held:
            heirs[track.id] = max(sorted(set(held)), key=held.count)
    return heirs


def associate(tracks: Tracks, detections: Detections, cfg: TrackingConfig) -> None:
    """One frame's detections join objects or begin new ones; then merge, and drop what nobody saw again."""
    seen = _clouds(detections, cfg.cell_m)
    joined = _matches(tracks, detections, seen, cfg)
    touched = []
    for index, cells in enumerate(seen):
        source = {(detections.detector, detections.frame_id, index)}
        news = Track(-1, cells, np.ones_like(cells), [detections.embeddings[index]], source, vote(detections, index))
        track = tracks.items.get(joined.get(index, -1))
        if track is None:
            news.id, track = tracks.next_id, news
            tracks.items[news.id], tracks.next_id = news, tracks.next_id + 1
        else:
            _extend(track, news, cfg)
        touched.append(track.id)
    _merge(tracks, touched, cfg)
    _split(tracks, touched, cfg)
    _forget(tracks, detections, set(touched), cfg)
    tracks.changed = True


def _clouds(detections: Detections, cell_m: float) -> list[np.ndarray]:
    """The cells (cell,) that each detection's points fill in the world."""
    points_m = transform(detections.world_from_camera, detections.points_camera_m.astype(np.float64))
    clouds = np.split(_filled(points_m, cell_m), np.cumsum(detections.point_counts)[:-1])
    return [np.unique(cells) for cells in clouds[: len(detections.point_counts)]]


def _cloud(detections: Detections, index: int, cell_m: float) -> np.ndarray:
    """The cells (cell,) of one detection."""
    end = int(detections.point_counts[: index + 1].sum())
    points_m = detections.points_camera_m[end - int(detections.point_counts[index]) : end]
    return np.unique(_filled(transform(detections.world_from_camera, points_m.astype(np.float64)), cell_m))


def _filled(points_m: np.ndarray, cell_m: float) -> np.ndarray:
    return packed(np.floor(points_m / cell_m).astype(np.int64))


def _matches(tracks: Tracks, detections: Detections, seen: list[np.ndarray], cfg: TrackingConfig) -> dict[int, int]:
    """Object id by detection: at most one each, the sum of overlap and similarity as large as possible."""
    items = list(tracks.items.values())
    scores = np.zeros((len(seen), len(items)))
    for row, cells in enumerate(seen):
        for column in _near(_bounds(cells), items):
            track = items[column]
            shares = shared(cells, track.cells), shared(track.cells, cells)
            if max(shares) >= cfg.match_overlap and min(shares) >= cfg.match_part:
                cosine = float(descriptor(track.embeddings) @ detections.embeddings[row].astype(np.float64))
                scores[row, column] = max(shares) + cfg.descriptor_weight * (1 + cosine) + 1e-9
    rows, columns = scipy.optimize.linear_sum_assignment(-scores)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {row: items[column].id for row, column in pairs if scores[row, column] > 0}


def _merge(tracks: Tracks, touched: list[int], cfg: TrackingConfig) -> None:
    """Objects that have come to share most of their cells with one that grew become one; the older id stays."""
    waiting = list(dict.fromkeys(touched))
    while waiting:
        track = tracks.items.get(waiting.pop())
        if track is None:
            continue
        cells = track.firm()
        items = list(tracks.items.values())
        for other in (items[index] for index in _near(track.bounds, items)):
            if other.id == track.id:
                continue
            others = other.firm()
            least = 2 * cfg.merge_overlap - 1  # of one share, for their mean to be enough
            share = shared(cells, others)
            if share >= least and share + shared(others, cells) >= 2 * cfg.merge_overlap:
                into, gone = (track, other) if track.id < other.id else (other, track)
                _extend(into, gone, cfg)
                del tracks.items[gone.id]
                tracks.merged.append((gone.id, into.id))
                waiting.append(into.id)
                break


def _split(tracks: Tracks, touched: list[int], cfg: TrackingConfig) -> None:
    """Objects whose firm cells fall into two parts that few detections show together become two."""
    for number in dict.fromkeys(touched):
        track = tracks.items.get(number)
        if track is None or track.frames < max(cfg.split_frames, track.look_again):
            continue
        track.look_again = track.frames + max(1, track.frames // 4)
        parts = _parts(track.firm(cfg.firm_share))
        if len(parts) < 2:
            continue
        halves = _halves(tracks, track, parts[0], parts[1], cfg)
        if halves is not None:
            tracks.items[number], split_off = halves
            split_off.id, tracks.next_id = tracks.next_id, tracks.next_id + 1
            tracks.items[split_off.id] = split_off


def _parts(cells: np.ndarray) -> list[np.ndarray]:
    """Cells (sorted) that touch each other, also at corners, the largest group first."""
    near = cells[:, None] + AROUND
    at = np.minimum(np.searchsorted(cells, near), len(cells) - 1)
    row, column = np.nonzero(cells[at] == near)
    links = scipy.sparse.csr_array((np.ones(len(row), bool), (row, at[row, column])), shape=(len(cells),) * 2)
    count, labels = scipy.sparse.csgraph.connected_components(links, directed=False)
    return sorted((cells[labels == part] for part in range(count)), key=len, reverse=True)


def _halves(
    tracks: Tracks, track: Track, one: np.ndarray, other: np.ndarray, cfg: TrackingConfig
) -> tuple[Track, Track] | None:
    """What the object becomes if it is two, that with more frames first and under the old id; None if it is one.

    Its detections are taken from the archive; every cell of theirs goes with the nearer part.
    """
    tree = scipy.spatial.cKDTree(np.concatenate((unpacked(one), unpacked(other))))
    both, shown, halves = 0, [0, 0], (_blank(track), _blank(track))
    views = list(_views(tracks, track, cfg))
    if len(views) < len(track.sources):  # too old for the archive: nobody can say to which part they belong
        return None
    for detections, index, cells in views:
        _, nearest = tree.query(unpacked(cells))
        sides = [cells[nearest < len(one)], cells[nearest >= len(one)]]
        main = int(len(sides[1]) > len(sides[0]))
        joint = len(sides[1 - main]) >= cfg.part_share * len(cells)
        both += joint
        for side, half in enumerate(halves):
            if side == main:
                source = {(detections.detector, detections.frame_id, index)}
                said = [detections.embeddings[index]], source, vote(detections, index)
                _extend(half, Track(-1, sides[side], np.ones_like(sides[side]), *said), cfg)
            elif joint:
                _extend(half, Track(-1, sides[side], np.ones_like(sides[side]), [], set(), {}), cfg)
            shown[side] += side == main or joint
    if both >= cfg.split_joint * min(shown) or min(half.frames for half in halves) == 0:
        return None
    kept, split_off = sorted(halves, key=lambda half: -half.frames)
    return kept, split_off


def _blank(track: Track) -> Track:
    none = np.zeros(0, np.int64)
    return Track(track.id, none, none, [], set(), {}, look_again=track.look_again)


def _views(tracks: Tracks, track: Track, cfg: TrackingConfig) -> Iterator[tuple[Detections, int, np.ndarray]]:
    """The object's detections that the archive holds, by frame: message, index, and cells in the world."""
    for detector, frame_id, index in sorted(track.sources, key=lambda source: (source[1], source)):
        detections = tracks.archive.get((tracks.space, detector, frame_id))
        if detections is not None:
            yield detections, index, _cloud(detections, index, cfg.cell_m)


def _forget(tracks: Tracks, detections: Detections, touched: set[int], cfg: TrackingConfig) -> None:
    """Count frames that look at a barely seen object in vain; enough of them, and it is dropped."""
    doubtful = [t for t in tracks.items.values() if t.frames < cfg.min_frames and t.id not in touched]
    if not doubtful:
        return
    centres_m = np.array([track.box_m(cfg).mean(axis=0) for track in doubtful])
    none = np.zeros(0, np.float32)
    view = kernel.Frame(
        inverse(detections.world_from_camera),
        detections.intrinsics,
        centers_px=none.reshape(0, 2),
        sigmas_px=none,
        layer_starts=np.zeros(0, np.int64),
        embeddings=none.reshape(0, 0),
        surface_m=kernel.fill_holes(detections.surface_m),
    )
    looks = kernel.visible(view, centres_m, kernel.KernelConfig(max_depth_m=cfg.max_depth_m))
    for row in looks.tolist():
        doubtful[row].missed += 1
        if doubtful[row].missed >= cfg.patience_frames:
            del tracks.items[doubtful[row].id]


def _extend(track: Track, more: Track, cfg: TrackingConfig) -> None:
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


def shared(cells: np.ndarray, others: np.ndarray) -> float:
    """Share of the cells that are at most one cell from one of the others (both sorted)."""
    return count_near(cells, others, COLUMNS) / len(cells)


@compiled()
def count_near(cells: np.ndarray, others: np.ndarray, steps: np.ndarray) -> int:
    """How many of the cells have, at one of the steps from them, one of the others or its neighbour on the last axis.

    All int64 and sorted; a step along the last axis is 1.
    """
    count = 0
    for cell in cells:
        for step in steps:
            at = np.searchsorted(others, cell + step - 1)
            if at < len(others) and others[at] <= cell + step + 1:
                count += 1
                break
    return count


def _frames(sources: set[tuple[str, int, int]]) -> int:
    return len({frame_id for _, frame_id, _ in sources})


def _bounds(cells: np.ndarray) -> np.ndarray:
    """Least and greatest numbers (2, 3) of some cells; of none, a box that is near nothing."""
    if not len(cells):
        return np.array([[1 << AXIS_BITS] * 3, [-(1 << AXIS_BITS)] * 3])
    numbers = unpacked(cells)
    return np.stack((numbers.min(axis=0), numbers.max(axis=0)))


def _near(bounds: np.ndarray, items: list[Track]) -> list[int]:
    """Indices of the objects whose bounds overlap a box, or touch it."""
    if not items:
        return []
    every = np.array([track.bounds for track in items])
    touches = (every[:, 0] <= bounds[1] + 1) & (every[:, 1] >= bounds[0] - 1)
    return np.flatnonzero(touches.all(axis=1)).tolist()


def packed(numbers: np.ndarray) -> np.ndarray:
    """Cell numbers (n, 3) as one integer each (n,), so that a step along an axis is a constant sum."""
    x, y, z = (numbers + (1 << AXIS_BITS - 1)).T
    return (x << 2 * AXIS_BITS) + (y << AXIS_BITS) + z


def unpacked(cells: np.ndarray) -> np.ndarray:
    """Inverse of `packed`."""
    mask = (1 << AXIS_BITS) - 1
    return np.stack((cells >> 2 * AXIS_BITS, cells >> AXIS_BITS & mask, cells & mask), 1) - (1 << AXIS_BITS - 1)
