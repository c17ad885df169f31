"""The one step that every source passes: sizes, lens, depth, poses and origin become what the pipeline expects."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.detection import likely_unit_m
from prior_sg.services.ingest.core.due import Due
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame, View
from prior_sg.services.ingest.core.options import ORIGIN_AUTO, ORIGIN_KEPT, ReadOptions, offset_of
from prior_sg.services.ingest.core.pairing import risen
from prior_sg.services.ingest.core.pixels import measured, stored
from prior_sg.services.ingest.core.poses import EXACT, rigid, stretch
from prior_sg.services.ingest.sources.base import (
    Entry,
    Found,
    Images,
    Source,
    Wanted,
    levelling,
    shifted_truth,
)
from prior_sg.services.ingest.sources.cameras import Sizes, camera_of_images, straight_maps
from prior_sg.services.ingest.sources.normaliser import UNUSABLE, Depth, Normaliser, valid_depth
from prior_sg.services.ingest.sources.tables import FEW, SourceError

Samples = Sequence[tuple[np.ndarray, Images]]  # source_from_camera and pictures of a few frames
LOOKED_AT, TRIED = 8, 64  # frames that are decoded when a source is opened, and how many may be bad before them
FAR_M, HIGH_M = 1000.0, 50.0  # coordinates beyond are of a map's grid, or above the sea
EYE_LEVEL_M = 1.5
FLIGHT_M_S, WALK_M_S = 10.0, 2.5  # a camera faster than this is refused as a jump; how fast one is carried
SLOWER_HZ = (10.0, 5.0, 2.0, 1.0)
DEEPEST_M, SHALLOWEST_M = 200.0, 0.01  # no room and no street has a median depth beyond
STORED_M = 65.535  # beyond, depth that is not of whole numbers does not fit into millimetres of 16 bits


def finish(found: Found, options: ReadOptions) -> Source:
    """The source of what a loader found. Raises SourceError."""
    _check_applicable(found, options)
    samples, reasons = _look(found.entries)
    if not samples and len(found.entries) >= FEW:
        raise SourceError(f"none of the frames of {found.path} can be read: {_most_common(reasons)}")
    poses = [pose for pose, _ in samples]
    normaliser, notes = prepare(found, options, samples)
    others = [_beside(other, normaliser, options) for other in found.beside]
    corrections = [
        msgspec.structs.replace(correction, world_from_camera=normaliser.pose(correction.world_from_camera))
        for correction in found.corrections
    ]
    entries, paced = _paced(found, options)
    rolls = _interleaved([(normaliser, entries), *((one, other.entries) for one, other, _ in others)])
    total = len(rolls)
    return Source(
        layout=found.layout,
        path=found.path,
        intrinsics=normaliser.intrinsics,
        total=total,
        frames=lambda: _frames(rolls),
        ground_truth=shifted_truth(found.ground_truth, normaliser.origin_m),
        corrections=lambda: iter(corrections),
        why=found.why,
        notes=(*found.notes, *paced, *_rounded(poses), *notes, *(note for _, _, told in others for note in told)),
        origin_m=normaliser.origin_m,
        convention=found.convention,
        depth_unit_m=normaliser.depth.unit_m,
        world_from_source=normaliser.world_from_source,
        thinned=lambda wanted: _frames(rolls, wanted),
        sparing=partial(_sparing, rolls, options) if found.costly and isinstance(options, Config) else None,
    )


def beside(found: Found, first: Normaliser, options: ReadOptions, samples: Samples) -> tuple[Normaliser, list[str]]:
    """What is to be done to the frames of a robot's further camera, which is in the first one's world, and notes on it.

    Raises SourceError.
    """
    own, notes = prepare(found, msgspec.structs.replace(options, origin=ORIGIN_KEPT), samples)
    own = replace(own, world_from_source=first.world_from_source, origin_m=first.origin_m, camera=found.name)
    return own, [f"{found.name}: {note}" for note in notes]


def _beside(found: Found, first: Normaliser, options: ReadOptions) -> tuple[Normaliser, Found, list[str]]:
    """The same, of a recording's. Raises SourceError."""
    samples, reasons = _look(found.entries)
    if not samples and len(found.entries) >= FEW:
        raise SourceError(f"none of the frames of {found.name} can be read: {_most_common(reasons)}")
    own, notes = beside(found, first, options, samples)
    return own, found, [*(f"{found.name}: {note}" for note in found.notes), *notes]


def _interleaved(cameras: Sequence[tuple[Normaliser, Sequence[Entry]]]) -> list[tuple[Normaliser, Entry]]:
    """Frames of all cameras by stamp, numbered anew where there are several; one camera's stay as they are."""
    rolls = [(normaliser, entry) for normaliser, entries in cameras for entry in entries]
    if len(cameras) == 1:
        return rolls
    told = []
    newest_ns: int | None = None
    for number, (normaliser, entry) in enumerate(sorted(rolls, key=lambda roll: roll[1].stamp_ns)):
        newest_ns = risen(entry.stamp_ns, newest_ns)
        told.append((normaliser, replace(entry, frame_id=number, stamp_ns=newest_ns)))
    return told


def _check_applicable(found: Found, options: ReadOptions) -> None:
    """Raise SourceError when something is said of poses that are read in one way only."""
    told = {
        "--poses": options.poses,
        "--axes": options.camera_axes,
        "--quaternion": options.quaternion,
        "--position-scale": options.position_scale_m != 1.0,
    }
    if found.convention is None and any(told.values()):
        flags = ", ".join(flag for flag, given in told.items() if given)
        raise SourceError(f"poses of the layout {found.layout} are read in one way only: leave out {flags}")


def _frames(rolls: Sequence[tuple[Normaliser, Entry]], wanted: Wanted | None = None) -> Iterator[RawFrame | BadFrame]:
    total = len(rolls)
    for index, (normaliser, entry) in enumerate(rolls):
        try:
            pose = entry.pose()
            whole = wanted is None or wanted(index, normaliser.pose(pose))
            make = normaliser.frame if whole else normaliser.bare
            images = entry.images if whole else entry.glance or entry.images
            yield make(index, total, entry.frame_id, entry.stamp_ns, pose, images())
        except UNUSABLE as error:
            yield BadFrame(frame_id=entry.frame_id, reason=str(error), index=index, total=total)


def _sparing(rolls: Sequence[tuple[Normaliser, Entry]], cfg: Config) -> Iterator[RawFrame | BadFrame]:
    """All frames, with images where a keyframe may be due."""
    due = Due(cfg)
    wanted = set[int]()

    def wants(index: int, pose: np.ndarray) -> bool:
        normaliser, entry = rolls[index]
        if due(View(entry.frame_id, entry.stamp_ns, pose, camera=normaliser.camera)):
            wanted.add(index)
        return index in wanted

    for frame in _frames(rolls, wants):
        if isinstance(frame, RawFrame):
            yield frame if frame.index in wanted else msgspec.structs.replace(frame, pose_only=True)
            continue
        if frame.index in wanted:
            due.failed()
        yield frame


def _paced(found: Found, options: ReadOptions) -> tuple[Sequence[Entry], tuple[str, ...]]:
    """The entries with stamps at which the camera walks rather than flies, and a note on the rate."""
    if options.rate_hz:
        return found.entries, (f"{options.rate_hz:g} frames a second, as told",)
    if not found.assumed_hz:
        return found.entries, ()
    steps_m = _steps_m(found.entries)
    step_m = float(np.quantile(steps_m, 0.9)) if len(steps_m) >= FEW else 0.0
    if step_m * found.assumed_hz <= FLIGHT_M_S:
        return found.entries, (f"there are no stamps: {found.assumed_hz:g} frames a second are assumed",)
    rate_hz = next((rate for rate in SLOWER_HZ if step_m * rate <= WALK_M_S), SLOWER_HZ[-1])
    slower = [replace(entry, stamp_ns=round(entry.stamp_ns * found.assumed_hz / rate_hz)) for entry in found.entries]
    return slower, (
        f"there are no stamps: {rate_hz:g} frames a second are assumed, as steps of {step_m:.2f} m are too long for "
        f"{found.assumed_hz:g} (--rate says it)",
    )


def _steps_m(entries: Sequence[Entry]) -> list[float]:
    """How far the camera moves from one number to the next, at places from all over the source."""
    steps = []
    for index in spread(len(entries) - 1, TRIED, TRIED):
        first, second = entries[index : index + 2]
        try:
            moved_m = np.linalg.norm(second.pose()[:3, 3] - first.pose()[:3, 3])
        except UNUSABLE:
            continue
        if np.isfinite(moved_m) and second.frame_id > first.frame_id:
            steps.append(float(moved_m) / (second.frame_id - first.frame_id))
    return steps


def _look(entries: Sequence[Entry]) -> tuple[list[tuple[np.ndarray, Images]], list[str]]:
    """Poses and images of a few frames from all over the source, and why others could not be read."""
    samples: list[tuple[np.ndarray, Images]] = []
    reasons: list[str] = []
    for index in spread(len(entries), LOOKED_AT, TRIED):
        if len(samples) == LOOKED_AT:
            break
        try:
            pose = entries[index].pose()
            rigid(pose)
            samples.append((pose, entries[index].images()))
        except UNUSABLE as error:
            reasons.append(str(error))
    return samples, reasons


def spread(count: int, first: int, most: int) -> list[int]:
    """Up to `most` indices below `count`; the first few are spread evenly, the others lie between them."""
    if count <= 0:
        return []
    few = np.unique(np.linspace(0, count - 1, min(first, count)).astype(int)).tolist()
    more = np.unique(np.linspace(0, count - 1, min(most, count)).astype(int)).tolist()
    return few + [index for index in more if index not in set(few)]


def _most_common(reasons: Sequence[str]) -> str:
    return Counter(reasons).most_common(1)[0][0] if reasons else "it holds none"


def _rounded(poses: Sequence[np.ndarray]) -> tuple[str, ...]:
    """A note on rotations that few decimals made inexact."""
    worst = max((stretch(pose) for pose in poses), default=0.0)
    return (f"rotations are made orthonormal again (off by up to {worst:.2%})",) if worst > EXACT else ()


def prepare(found: Found, options: ReadOptions, samples: Samples) -> tuple[Normaliser, tuple[str, ...]]:
    """What is to be done to the frames of a source, and the notes on it. Raises SourceError."""
    notes: list[str] = []
    images = [images for _, images in samples]
    sizes = _sizes(images, found.camera.intrinsics)
    camera = camera_of_images(found, options, sizes, notes)
    depth = _depth(found, options, images, notes)
    world_from_source = levelling(list(options.world_up) or found.up, options.floor_m)
    origin_m = _origin([pose for pose, _ in samples], world_from_source, options, notes)
    if any(origin_m):
        world_from_source = np.eye(4) if world_from_source is None else world_from_source
        world_from_source[:3, 3] -= origin_m
    maps = straight_maps(camera)
    normaliser = Normaliser(camera.intrinsics, sizes, depth, maps, world_from_source, origin_m, found.name)
    _check_frames(normaliser, found.path, samples)
    return normaliser, tuple(notes)


def _sizes(images: Sequence[Images], camera: Intrinsics) -> Sizes:
    """The sizes most images have; the camera's where none can be read."""
    camera_size = (camera.width_px, camera.height_px)
    colors = Counter(filter(None, (_size(image.color) for image in images)))
    depths = Counter(filter(None, (_size(image.depth) for image in images)))
    return Sizes(_commonest(colors, camera_size), _commonest(depths, camera_size))


def _commonest(counts: Counter, camera_size: tuple[int, int]) -> tuple[int, int]:
    """The camera's own size wins a draw."""
    return max(counts, key=lambda size: (counts[size], size == camera_size), default=camera_size)


def _size(data: bytes | np.ndarray | None) -> tuple[int, int] | None:
    if data is None:
        return None
    if isinstance(data, np.ndarray):
        return data.shape[1], data.shape[0]
    try:
        width_px, height_px, _ = measured(data)
    except ImageError:
        return None
    return width_px, height_px


def _depth(found: Found, options: ReadOptions, images: Sequence[Images], notes: list[str]) -> Depth:
    """How the depth images are read. Raises SourceError when nothing real is that deep."""
    scale_m = found.depth_scale_m if options.depth_scale_m is None else options.depth_scale_m
    if not (np.isfinite(scale_m) and scale_m > 0):
        raise SourceError(f"depth_scale_m of {found.path} is {scale_m}: it must be positive; give --depth-scale METRES")
    invalid = found.depth_invalid if options.depth_invalid is None else tuple(options.depth_invalid)
    units = [array for array in (_stored(image.depth) for image in images) if array is not None]
    whole = [array for array in units if array.dtype.kind != "f"]
    floats = [array for array in units if array.dtype.kind == "f"]
    float_scale_m = _float_scale(floats, invalid, scale_m, options, notes)
    lost = sum(int(np.isin(array, [v for v in invalid if v]).sum()) for array in units)
    if lost:
        told = ", ".join(f"{value:g}" for value in invalid if value)
        share = lost / sum(array.size for array in units)
        notes.append(f"depth of {told} is taken as no measurement ({share:.1%} of the pixels looked at)")
    measured_m = chain(  # one image's at a time: of eight they take 20 MB
        (array[valid_depth(array, ())] for array in (image.depth for image in images) if isinstance(array, np.ndarray)),
        (array[valid_depth(array, invalid)] * scale_m for array in whole),
        (array[valid_depth(array, invalid)] * float_scale_m for array in floats),
    )
    medians = [float(np.median(values)) for values in measured_m if values.size]
    unit_m = float_scale_m if floats and not whole else scale_m
    deepest_m = STORED_M if floats and not whole else DEEPEST_M
    if medians and not SHALLOWEST_M <= (median_m := float(np.median(medians))) <= deepest_m:
        raise SourceError(
            f"the median depth of {found.path} is {median_m:.4g} m: check depth_scale_m ({unit_m:g} metres per unit); "
            f"--depth-scale METRES sets it, {likely_unit_m(median_m / unit_m):.6g} would make a room of it"
        )
    return Depth(scale_m, float_scale_m, invalid, options.depth_min_m, options.depth_max_m, unit_m)


def _float_scale(
    floats: Sequence[np.ndarray], invalid: Sequence[float], scale_m: float, options: ReadOptions, notes: list[str]
) -> float:
    """Metres per unit of floating-point depth: metres, unless these would be absurd and the source's unit is not."""
    if options.depth_scale_m is not None or not floats:
        return scale_m if options.depth_scale_m is not None else 1.0
    values = np.concatenate([array[valid_depth(array, invalid)] for array in floats])
    median = float(np.median(values)) if values.size else 1.0
    absurd = not SHALLOWEST_M <= median <= DEEPEST_M and SHALLOWEST_M <= median * scale_m <= DEEPEST_M
    notes.append(f"depth of floating-point numbers is read as {f'units of {scale_m:g} m' if absurd else 'metres'}")
    return scale_m if absurd else 1.0


def _stored(data: bytes | np.ndarray) -> np.ndarray | None:
    """Numbers of a depth image that can be used."""
    if isinstance(data, np.ndarray):
        return None
    try:
        units = stored(data)
    except ImageError:
        return None
    return units if units.ndim == 2 and units.dtype.itemsize > 1 else None


def _origin(
    poses: Sequence[np.ndarray], world_from_source: np.ndarray | None, options: ReadOptions, notes: list[str]
) -> tuple[float, float, float]:
    """Where the new origin lies in the levelled world."""
    if (told := offset_of(options.origin)) is not None:
        notes.append(f"the origin is moved to {_place(told)}, as told")
        return told
    if options.origin != ORIGIN_AUTO or not poses:
        return 0.0, 0.0, 0.0
    places = np.array(
        [pose[:3, 3] if world_from_source is None else (world_from_source @ pose)[:3, 3] for pose in poses]
    )
    x_m, y_m, z_m = np.median(places, axis=0)
    if max(abs(x_m), abs(y_m), abs(z_m)) < FAR_M:
        return 0.0, 0.0, 0.0
    high = abs(z_m) >= HIGH_M and not options.floor_m
    floor_m = float(np.floor(places[:, 2].min() - EYE_LEVEL_M)) if high else 0.0
    origin_m = float(np.round(x_m)), float(np.round(y_m)), floor_m
    height = ", with the floor taken to be there (--floor says it)" if high else ""
    notes.append(
        f"the coordinates are kilometres away: recentred at {_place(origin_m)}{height}; --origin keep does not"
    )
    return origin_m


def _place(origin_m: Sequence[float]) -> str:
    return " ".join(f"{value:.10g}" for value in origin_m) + " m"


def _check_frames(normaliser: Normaliser, path: Path, samples: Samples) -> None:
    """Raise SourceError when not one of the frames looked at can be used."""
    reasons = []
    for pose, images in samples:
        try:
            normaliser.frame(0, 0, 0, 0, pose, images)
            return
        except UNUSABLE as error:
            reasons.append(str(error))
    if len(reasons) >= FEW:
        raise SourceError(f"none of the frames of {path} can be used: {_most_common(reasons)}")
