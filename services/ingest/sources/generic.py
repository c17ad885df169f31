"""Folders in a layout of one's own: images, depth, a pose per frame, and a camera.

rgb/ color/ image/    (or their plurals) colour, any number in the name; depth/ 16 bit PNG, TIFF or NPY; floats = metres
pose/ or poses/       a file per frame: 4 x 4 or 3 x 4 numbers, or tx ty tz and a quaternion; or one file of them all
                      (pose_lists.py)
intrinsics.* camera.* camera_info.* beside them: a 3 x 3 (or 4 x 4) matrix, fx fy cx cy, or JSON or YAML with these
                      names, and where they have them width, height, depth_scale_m, model, distortion

Nothing is assumed in silence. What the poses map, the camera's axes, the order of quaternions and the unit of depth are
taken from the options, or found by how well depth images agree under each meaning; what cannot be told is asked for.
The direction up is the axis of the world to which cameras are upright. Numbers that are stamps are read as such; else
frames are spaced so that the camera walks rather than flies. All of it is noted.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.detection import (
    CHOICES,
    LEAST_SHARE,
    OPTIONS,
    USUAL_UNIT_M,
    Meaning,
    Verdict,
    Written,
    meaning_of,
    moving_pairs,
    plausible_units,
    up_of,
)
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import NPY_MAGIC, stored
from prior_sg.services.ingest.core.poses import Convention, PoseError, matrix_of, rigid
from prior_sg.services.ingest.sources import pose_lists
from prior_sg.services.ingest.sources.base import (
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    depth_pixels,
    first_size,
    lens_of,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.cameras import scaled
from prior_sg.services.ingest.sources.own_cameras import described, unit_of
from prior_sg.services.ingest.sources.pose_lists import PoseList
from prior_sg.services.ingest.sources.tables import stamps_ns

NAME = "generic"
COLORS = ("rgb", "color", "colour", "image", "images", "rgbs", "colors", "colours")
DEPTHS, POSES = ("depth", "depths"), ("pose", "poses")
LOOKS = "rgb/ (or color/, image/), depth/ and pose/ (or a list of poses) with intrinsics.* or camera.* (own layout)"
PICTURES, ARRAYS = (".png", ".jpg", ".jpeg", ".bmp", ".webp"), (".png", ".npy", ".tiff", ".tif", ".exr")
MATRICES = (".txt", ".npy", ".csv", ".pose")
POSITION_SCALES_M = (0.001, 0.01)  # millimetres and centimetres, tried when metres make no sense
PAIRS = 8  # pairs of frames that tell what poses mean
RATE_HZ = 30.0
EPOCH_S = 10**9  # numbers from here on are stamps


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    if not path.is_dir():
        return False
    colors, depths, poses = (folder_of(path, names) is not None for names in (COLORS, DEPTHS, POSES))
    if colors and poses:
        return True
    found = pose_lists.find(path)
    return found is not None and (colors or depths or found.name == pose_lists.TRANSFORMS)


@dataclass(frozen=True)
class Files:
    """The files of one frame."""

    color: Path | None
    depth: Path | None
    pose: Path | np.ndarray | None  # a file, or the numbers of a list


@dataclass(frozen=True)
class Folder:
    """What of a folder in a layout of one's own is taken."""

    colors: dict[float, Path]  # by the number of the frame
    depths: dict[float, Path]
    poses: Mapping[float, Path | np.ndarray]
    held: tuple[str, ...]  # what was found
    listed: PoseList | None = None
    depthless: bool = False  # there is colour alone


@dataclass(frozen=True)
class Known:
    """What the camera's file says."""

    camera: Camera
    depth_unit_m: float | None


def load(path: Path, options: ReadOptions) -> Found:
    """A folder in a layout of one's own. Raises SourceError."""
    folder = _folder(path, options)
    keys = sorted(folder.colors.keys() | folder.depths.keys() | folder.poses.keys())
    files = [Files(folder.colors.get(key), folder.depths.get(key), folder.poses.get(key)) for key in keys]
    camera, scale_m, notes = _camera(path, folder, options)
    verdict, said = _verdict(path, files, Known(camera, scale_m), folder, options)
    convention = verdict.meaning.convention
    up, clear = up_of([pose for file in files if (pose := _posed(file, convention)) is not None])
    said.append(
        f"up is {_direction(up)}: "
        + ("cameras are upright to it" if clear else "assumed, the cameras do not tell")
        + "; --up says otherwise"
    )
    stamps, timed, assumed_hz = _stamps(path, keys, options)
    return Found(
        NAME,
        path,
        camera,
        verdict.meaning.unit_m,
        [
            Entry(number, stamp, partial(_pose, file, convention), partial(_images, file, folder.depthless))
            for number, stamp, file in zip(_numbers(keys), stamps, files, strict=True)
        ],
        up=up,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{', '.join(folder.held)} lie in it, and no other layout fits",),
        notes=(*notes, *said, *timed),
        depthless=folder.depthless,
        assumed_hz=assumed_hz,
    )


def _folder(path: Path, options: ReadOptions) -> Folder:
    """The files of a folder by the number of their frame. Raises SourceError."""
    colors, depths, poses = (folder_of(path, names) for names in (COLORS, DEPTHS, POSES))
    found = None if poses is not None else pose_lists.find(path)
    listed = None if found is None else pose_lists.read(found)
    colors = colors or (None if listed is None else listed.images)
    if colors is None or not colors.is_dir() or (poses is None and listed is None):
        raise SourceError(f"{path} lacks images or poses: looked for {LOOKS}; poses may be {pose_lists.UNDERSTOOD}")
    depthless = depths is None and not (listed and listed.depth_names)
    if depthless and not options.depth_model:
        raise SourceError(
            f"{path} lacks depth images: put a folder depth/ with one for each colour image into it, or give "
            "--depth-model FILE.onnx, a network that sees depth in one picture"
        )
    by_color = _by_key(colors, PICTURES)
    stems = {file.stem: key for key, file in by_color.items()}
    by_depth = {} if depths is None else _by_key(depths, ARRAYS)
    if listed is not None and listed.depth_names:
        by_depth = {stems[s]: listed.path.parent / name for s, name in listed.depth_names.items() if s in stems}
    held = tuple(f"{part.name}/" for part in (colors, depths, poses) if part is not None)
    if listed is None:
        return Folder(by_color, by_depth, _by_key(poses, MATRICES) if poses else {}, held, depthless=depthless)
    held = (*held, listed.path.name)
    return Folder(by_color, by_depth, listed.of(sorted(by_color), stems), held, listed, depthless)


def folder_of(path: Path, names: Sequence[str]) -> Path | None:
    """The folder in `path` with the first of these names, in letters of any size."""
    found = {child.name.lower(): child for child in path.iterdir() if child.is_dir()} if path.is_dir() else {}
    return next((found[name] for name in names if name in found), None)


def _by_key(folder: Path, endings: Sequence[str]) -> dict[float, Path]:
    """Files by the number in their names: the one that differs from file to file."""
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in endings and not f.name.startswith("."))
    words = [re.findall(r"\d+\.\d+|\d+", file.stem) for file in files]
    width = min((len(row) for row in words), default=0)
    if not width:
        return {}
    column = max(range(width), key=lambda i: (len({row[i] for row in words}), i))
    return {float(row[column]): file for row, file in zip(words, files, strict=True)}


def _numbers(keys: Sequence[float]) -> list[int]:
    plain = all(key == int(key) and key < EPOCH_S for key in keys)
    return [int(key) for key in keys] if plain else list(range(len(keys)))


# The camera.


def _camera(path: Path, folder: Folder, options: ReadOptions) -> tuple[Camera, float | None, list[str]]:
    """The camera, metres per depth unit where its file says, and notes. Raises SourceError."""
    color_size = first_size(list(folder.colors.values()), path)
    depth_size = color_size if folder.depthless else first_size(list(folder.depths.values()), path)
    file, fields = described(path, folder.listed)
    if file is None:
        if not options.intrinsics:
            raise SourceError(
                f"{path} has no camera: put intrinsics.txt (a 3 x 3 matrix) into it or give --intrinsics FX,FY,CX,CY "
                "(or --layout hm3d for a walk of HOV-SG)"
            )
        return Camera(Intrinsics(*depth_size, *options.intrinsics[:4])), None, []
    try:
        fx, fy, cx, cy = (float(fields[name]) for name in ("fx", "fy", "cx", "cy"))
        size = (int(fields["width"]), int(fields["height"])) if "width" in fields and "height" in fields else None
        notes = [f"the camera is that of {file.name}"]
        if size is None:
            size = min((depth_size, color_size), key=lambda s: abs(2 * cx + 1 - s[0]) + abs(2 * cy + 1 - s[1]))
            notes[0] += f", taken to be for {size[0]} x {size[1]} pixels" if color_size != depth_size else ""
        scale_m = unit_of(fields)
        return Camera(Intrinsics(*size, fx, fy, cx, cy), *lens_of(file, fields)), scale_m, notes
    except KeyError as error:
        raise SourceError(f"{file} is not a camera: it does not say {error.args[0]}") from error
    except (OSError, TypeError, ValueError, AttributeError) as error:
        raise SourceError(f"{file} is not a camera: {error}") from error


# Poses, and what they mean.


def _numbers_of(file: Files) -> np.ndarray:
    """The pose as it is written, (4, 4) or (7,). Raises FrameError or PoseError."""
    if file.pose is None:
        raise FrameError("it has no pose file, and no line in a list of poses")
    if isinstance(file.pose, np.ndarray):
        return file.pose
    data = read_bytes(file.pose)
    if data.startswith(NPY_MAGIC):
        text = " ".join(repr(float(number)) for number in np.ravel(stored(data)))
    else:
        lines = data.decode("utf-8-sig", errors="replace").splitlines()
        text = re.sub(r"[,;\[\]]", " ", " ".join(line for line in lines if not line.lstrip().startswith("#")))
    words = text.split()
    if len(words) != 7:
        return matrix_of(text)
    try:
        return np.array(words, float)
    except ValueError as error:
        raise PoseError(f"its pose is not seven numbers: {error}") from error


def _pose(file: Files, convention: Convention) -> np.ndarray:
    pose = _numbers_of(file)
    return Written(np.zeros((1, 1)), pose).source_from_camera(convention)


def _posed(file: Files, convention: Convention) -> np.ndarray | None:
    try:
        return rigid(_pose(file, convention))
    except (FrameError, PoseError, ImageError):
        return None


def _images(file: Files, depthless: bool) -> Images:
    if depthless and file.color is not None:
        return Images(read_bytes(file.color), b"")
    if file.color is None or file.depth is None:
        raise FrameError(f"it has no {'colour' if file.color is None else 'depth'} file")
    return Images(read_bytes(file.color), read_bytes(file.depth))


def _verdict(
    path: Path, files: list[Files], known: Known, folder: Folder, options: ReadOptions
) -> tuple[Verdict, list[str]]:
    """What poses and depth mean, and how that is known. Raises SourceError that names the options."""
    pairs = _pairs(path, files)
    if folder.depthless:
        return _told_verdict(path, files, folder.listed, options)
    depths = [written.depth for pair in pairs for written in pair]
    told = _told(pairs, folder.listed, options)
    open_ = [name for name, value in told.items() if not value]
    if not pairs and open_:
        raise SourceError(f"{path} does not tell what its poses mean, the camera hardly moves: give {_asked(open_)}")
    camera, known_m = known.camera.intrinsics, options.depth_scale_m or known.depth_unit_m
    floats = any(depth.dtype.kind == "f" for depth in depths)
    units_m = [known_m] if known_m else [1.0] if floats else plausible_units(depths) or [USUAL_UNIT_M]
    size = depths[0].shape if depths else (camera.height_px, camera.width_px)
    at = _at(camera, (size[1], size[0]))
    verdict = meaning_of(pairs, at, _conventions(told, options.position_scale_m), units_m)
    if verdict.share < LEAST_SHARE and options.position_scale_m == 1.0:
        tried = [meaning_of(pairs, at, _conventions(told, scale), units_m) for scale in POSITION_SCALES_M]
        verdict = max((verdict, *tried), key=lambda one: one.share if one.share >= LEAST_SHARE else 0.0)
    unclear = [name for name in verdict.unclear if name in open_]
    if open_ and (unclear or verdict.share < LEAST_SHARE):
        raise SourceError(
            f"{path} does not tell what its poses mean: depth images agree by {verdict.share:.0%} at best; "
            f"give {_asked(unclear or open_)}, and --depth-scale"
        )
    said = _said(verdict, folder.listed, open_)
    return verdict, said if floats else [*said, _unit_said(known_m, units_m, verdict)]


def _told_verdict(
    path: Path, files: list[Files], listed: PoseList | None, options: ReadOptions
) -> tuple[Verdict, list[str]]:
    """What poses mean where no depth images could tell. Raises SourceError that names the options."""
    first = Written(np.zeros((1, 1)), _first_numbers(files))
    told = _told([(first, first)], listed, options)
    if open_ := [name for name, value in told.items() if not value]:
        raise SourceError(f"{path} has no depth that would tell what its poses mean: give {_asked(open_)}")
    (convention,) = _conventions(told, options.position_scale_m)
    verdict = Verdict(Meaning(convention, USUAL_UNIT_M), 0.0, ())
    return verdict, _said(verdict, listed, ())


def _first_numbers(files: list[Files]) -> np.ndarray:
    """The first pose that can be read, as it is written; there is one."""
    for file in files:
        try:
            return _numbers_of(file)
        except (FrameError, PoseError, ImageError):
            continue
    raise AssertionError("_pairs has found one")


def _told(pairs: Sequence[tuple[Written, Written]], listed: PoseList | None, options: ReadOptions) -> dict[str, str]:
    """What options, or the format of a list, say of the poses; empty = nobody says."""
    told: dict[str, str] = {"poses": options.poses, "axes": options.camera_axes, "quaternion": options.quaternion}
    if listed is not None and listed.convention is not None:
        told = {name: value or getattr(listed.convention, name) for name, value in told.items()}
    if not any(written.pose.shape == (7,) for pair in pairs for written in pair):
        told["quaternion"] = told["quaternion"] or "xyzw"
    return told


def _conventions(told: dict[str, str], position_scale_m: float) -> list[Convention]:
    choices = [(told[name],) if told[name] else CHOICES[name] for name in CHOICES]
    return [Convention(poses, axes, quaternion, position_scale_m) for poses, axes, quaternion in product(*choices)]


def _unit_said(known_m: float | None, units_m: Sequence[float], verdict: Verdict) -> str:
    how = "found by the same agreement" if len(units_m) > 1 else "the one that makes a room"
    if "unit" in verdict.unclear:
        how = "assumed, the movement does not tell; --depth-scale says otherwise"
    return f"{verdict.meaning.unit_m:.6g} metres per depth unit ({'as told' if known_m else how})"


def _said(verdict: Verdict, listed: PoseList | None, open_: Sequence[str]) -> list[str]:
    """What the poses were taken for, and how that is known."""
    convention = verdict.meaning.convention
    how = f"found: depth images agree by {verdict.share:.0%}" if open_ else "as told"
    if listed is not None and listed.convention == replace(convention, position_scale_m=1.0):
        how = f"as {listed.path.name} has them"
    said = [f"{convention.said()} ({how})"]
    if convention.position_scale_m != 1.0:
        said.append(
            f"positions are read as units of {convention.position_scale_m:g} m (--position-scale says otherwise)"
        )
    return said


def _at(camera: Intrinsics, size: tuple[int, int]) -> Intrinsics:
    return camera if (camera.width_px, camera.height_px) == size else scaled(camera, size)


def _asked(names: Sequence[str]) -> str:
    return " and ".join(f"{OPTIONS[name]} {'|'.join(CHOICES[name])}" for name in names)


def _pairs(path: Path, files: list[Files]) -> list[tuple[Written, Written]]:
    """Pairs of frames between which the camera moved, as they are written. Raises SourceError without any pose."""
    posed, reasons = [], []
    for file in files:
        try:
            numbers = _numbers_of(file)
            pose = rigid(Written(np.zeros((1, 1)), numbers).source_from_camera(Convention()))
            posed.append((file, numbers, pose))
        except (FrameError, PoseError, ImageError) as error:
            reasons.append(str(error))
    if reasons and not posed:
        raise SourceError(f"none of the poses of {path} can be used: {Counter(reasons).most_common(1)[0][0]}")
    pairs = []
    for i, j in moving_pairs([pose for _, _, pose in posed], PAIRS):
        try:
            first, second = (Written(_depth(posed[k][0]), posed[k][1]) for k in (i, j))
            pairs.append((first, second))
        except FrameError:
            continue
    return pairs


def _depth(file: Files) -> np.ndarray:
    """A depth image in its own units, 0 where it says nothing. Raises FrameError."""
    depth = depth_pixels(read_bytes(file.depth) if file.depth else b"")
    if depth.ndim != 2:
        raise FrameError("the depth image does not have one channel")
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0) & (depth != 65535), depth, 0)


# Time.


def _stamps(path: Path, keys: Sequence[float], options: ReadOptions) -> tuple[list[int], list[str], float]:
    """Stamps of the frames, a note on them, and the rate they assume where the files have none. Raises SourceError."""
    numbers = _numbers(keys)
    if options.rate_hz or numbers == [int(key) for key in keys]:
        stamps = [round(number * options.frame_ns(RATE_HZ)) for number in numbers]
        return stamps, [], 0.0 if options.rate_hz else RATE_HZ
    read, _ = stamps_ns([repr(key) for key in keys], path, "s", options.stamp_unit)
    return [stamp or 0 for stamp in read], ["the files' names are read as stamps"], 0.0


def _direction(up: Sequence[float]) -> str:
    axis = int(np.abs(up).argmax())
    return f"{'-' if up[axis] < 0 else ''}{'xyz'[axis]}"
