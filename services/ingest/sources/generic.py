"""Folders in a layout of one's own: images, depth, a pose per frame, and a camera.

rgb/ color/ image/    (or their plurals) colour, any number in the name; depth/ 16 bit PNG, TIFF or NPY; floats = metres
pose/ or poses/       a file per frame: 4 x 4 or 3 x 4 numbers, or tx ty tz and a quaternion
intrinsics.* camera.* beside them: a 3 x 3 (or 4 x 4) matrix, fx fy cx cy, or JSON or YAML with these names, and where
                      they have them width, height, depth_scale_m, model, distortion

Nothing is assumed in silence. What the poses map, the camera's axes, the order of quaternions and the unit of depth are
taken from the options, or found by how well depth images agree under each meaning; what cannot be told is asked for.
The direction up is the axis of the world to which cameras are upright. Numbers that are stamps are read as such; else
frames are spaced so that the camera walks rather than flies. All of it is noted.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.detection import (
    CHOICES,
    LEAST_SHARE,
    OPTIONS,
    USUAL_UNIT_M,
    Verdict,
    Written,
    meaning_of,
    moving_pairs,
    plausible_units,
    up_of,
)
from prior_sg.services.ingest.core.headers import ImageError
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import NPY_MAGIC, stored
from prior_sg.services.ingest.core.poses import Convention, PoseError, matrix_of, rigid
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
from prior_sg.services.ingest.sources.tables import read_json, stamps_ns, text_of

NAME = "generic"
COLORS = ("rgb", "color", "colour", "image", "images", "rgbs", "colors", "colours")
DEPTHS, POSES = ("depth", "depths"), ("pose", "poses")
CAMERAS = ("intrinsics.*", "intrinsic.*", "camera_intrinsics.*", "camera-intrinsics.*", "camera.*", "K.txt")
LOOKS = "rgb/ (or color/, image/), depth/ and pose/ with a camera in intrinsics.* or camera.* (own layout)"
PICTURES, ARRAYS = (".png", ".jpg", ".jpeg", ".bmp", ".webp"), (".png", ".npy", ".tiff", ".tif", ".exr")
MATRICES = (".txt", ".npy", ".csv", ".pose")
PAIRS = 8  # pairs of frames that tell what poses mean
RATE_HZ = 30.0
EPOCH_S = 10**9  # numbers from here on are stamps
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return path.is_dir() and all(folder_of(path, names) for names in (COLORS, DEPTHS, POSES))


@dataclass(frozen=True)
class Files:
    """The files of one frame."""

    color: Path | None
    depth: Path | None
    pose: Path | None


def load(path: Path, options: ReadOptions) -> Found:
    """A folder in a layout of one's own. Raises SourceError."""
    folders = [folder_of(path, names) for names in (COLORS, DEPTHS, POSES)]
    if None in folders:
        raise SourceError(f"{path} lacks folders of images, depth and poses: looked for {LOOKS}")
    colors, depths, poses = (
        _by_key(folder, endings)
        for folder, endings in zip(folders, (PICTURES, ARRAYS, MATRICES), strict=True)
        if folder is not None
    )
    keys = sorted(colors.keys() | depths.keys() | poses.keys())
    files = [Files(colors.get(key), depths.get(key), poses.get(key)) for key in keys]
    camera, scale_m, notes = _camera(path, colors, depths, options)
    verdict, said = _verdict(path, files, camera, scale_m, options)
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
            Entry(number, stamp, partial(_pose, file, convention), partial(_images, file))
            for number, stamp, file in zip(_numbers(keys), stamps, files, strict=True)
        ],
        up=up,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{', '.join(f'{folder.name}/' for folder in folders if folder)} lie in it, and no other layout fits",),
        notes=(*notes, *said, *timed),
        assumed_hz=assumed_hz,
    )


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


def _camera(
    path: Path, colors: dict[float, Path], depths: dict[float, Path], options: ReadOptions
) -> tuple[Camera, float | None, list[str]]:
    """The camera, metres per depth unit where its file says, and notes. Raises SourceError."""
    files = [file for pattern in CAMERAS for file in sorted(path.glob(pattern)) if file.is_file()]
    color_size = first_size(list(colors.values()), path)
    depth_size = first_size(list(depths.values()), path)
    if not files:
        if not options.intrinsics:
            raise SourceError(
                f"{path} has no camera: put intrinsics.txt (a 3 x 3 matrix) into it or give --intrinsics FX,FY,CX,CY "
                "(or --layout hm3d for a walk of HOV-SG)"
            )
        return Camera(Intrinsics(*depth_size, *options.intrinsics[:4])), None, []
    try:
        fields = _fields(files[0])
        fx, fy, cx, cy = (float(fields[name]) for name in ("fx", "fy", "cx", "cy"))
        size = (int(fields["width"]), int(fields["height"])) if "width" in fields and "height" in fields else None
        notes = [f"the camera is that of {files[0].name}"]
        if size is None:
            size = min((depth_size, color_size), key=lambda s: abs(2 * cx + 1 - s[0]) + abs(2 * cy + 1 - s[1]))
            notes[0] += f", taken to be for {size[0]} x {size[1]} pixels" if color_size != depth_size else ""
        scale_m = _scale(fields)
        return Camera(Intrinsics(*size, fx, fy, cx, cy), *lens_of(files[0], fields)), scale_m, notes
    except KeyError as error:
        raise SourceError(f"{files[0]} is not a camera: it does not say {error.args[0]}") from error
    except (OSError, TypeError, ValueError, AttributeError) as error:
        raise SourceError(f"{files[0]} is not a camera: {error}") from error


def _scale(fields: dict[str, Any]) -> float | None:
    """Metres per unit; names other than ours may mean units per metre."""
    if "depth_scale_m" in fields:
        return float(fields["depth_scale_m"])
    names = ("depth_scale", "depth_factor", "depthscale", "depthmapfactor", "scale")
    value = next((float(fields[name]) for name in names if name in fields), None)
    if value is None or not value > 0:
        return None
    return 1 / value if value >= 1 else value


def _fields(path: Path) -> dict[str, Any]:
    """Named numbers of a camera's file. Raises SourceError."""
    if path.suffix.lower() == ".npy":
        return _of_matrix(np.ravel(stored(path.read_bytes())).tolist(), path)
    if path.suffix.lower() == ".json":
        content = read_json(path)
        content = content.get("camera", content) if isinstance(content, dict) else {"k": content}
        fields = _flat({str(key).lower(): value for key, value in content.items()})
    else:
        text = text_of(path)
        named = re.findall(rf"^[\s\-]*([A-Za-z_][\w.]*)\s*[:=]\s*({NUMBER}|[A-Za-z_]\w*)\s*,?\s*$", text, re.MULTILINE)
        fields = _flat({name.lower().rpartition(".")[2]: value for name, value in named})
        listed = re.search(rf"(?:camera_matrix|\bK\b)[^\[]*\[((?:[\s,]|{NUMBER})+)\]", text)
        if "fx" not in fields:
            numbers = listed[1] if listed else re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE)
            fields |= _of_matrix([float(n) for n in re.findall(NUMBER, numbers)], path)
        bent = re.search(rf"distortion_coefficients[^\[]*\[((?:[\s,]|{NUMBER})+)\]", text)
        fields |= {"distortion": [float(n) for n in re.findall(NUMBER, bent[1])]} if bent else {}
    matrix = next((fields[k] for k in ("k", "camera_matrix", "intrinsic_matrix", "intrinsics") if k in fields), None)
    if "fx" not in fields and matrix is not None:
        matrix = matrix.get("data", matrix) if isinstance(matrix, dict) else matrix
        fields |= _of_matrix(np.ravel(np.array(matrix, float)).tolist(), path)
    return fields


ALIASES = {"w": "width", "h": "height", "image_width": "width", "image_height": "height", "fl_x": "fx", "fl_y": "fy",
           "fx_px": "fx", "fy_px": "fy", "cx_px": "cx", "cy_px": "cy", "ppx": "cx", "ppy": "cy",
           "width_px": "width", "height_px": "height"}  # fmt: skip


def _flat(fields: dict[str, Any]) -> dict[str, Any]:
    return {ALIASES.get(name, name): value for name, value in fields.items()}


def _of_matrix(numbers: Sequence[float], path: Path) -> dict[str, Any]:
    """fx fy cx cy of a matrix in a row, by rows or by columns, or of the four (or six, with the size) themselves."""
    if len(numbers) in (4, 6):
        names = ("fx", "fy", "cx", "cy", "width", "height")
        return dict(zip(names, numbers, strict=False))
    side = {9: 3, 12: 4, 16: 4}.get(len(numbers))
    if side is None:
        raise SourceError(f"{path} is not a camera: it has {len(numbers)} numbers instead of a matrix of 3 x 3")
    matrix = np.array(numbers, float).reshape(-1, side)[:3, :3]
    if matrix[2, 0] and not matrix[0, 2]:  # written by columns
        matrix = matrix.T
    return {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}


# Poses, and what they mean.


def _numbers_of(file: Files) -> np.ndarray:
    """The pose as it is written, (4, 4) or (7,). Raises FrameError or PoseError."""
    if file.pose is None:
        raise FrameError("it has no pose file")
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


def _images(file: Files) -> Images:
    if file.color is None or file.depth is None:
        raise FrameError(f"it has no {'colour' if file.color is None else 'depth'} file")
    return Images(read_bytes(file.color), read_bytes(file.depth))


def _verdict(
    path: Path, files: list[Files], camera: Camera, scale_m: float | None, options: ReadOptions
) -> tuple[Verdict, list[str]]:
    """What poses and depth mean, and how that is known. Raises SourceError that names the options."""
    pairs = _pairs(path, files)
    depths = [written.depth for pair in pairs for written in pair]
    told = {"poses": options.poses, "axes": options.camera_axes, "quaternion": options.quaternion}
    if not any(written.pose.shape == (7,) for pair in pairs for written in pair):
        told["quaternion"] = told["quaternion"] or "xyzw"
    open_ = [name for name, value in told.items() if not value]
    choices = [(told[name],) if told[name] else CHOICES[name] for name in CHOICES]
    conventions = [Convention(poses, axes, quaternion) for poses, axes, quaternion in product(*choices)]
    known_m = options.depth_scale_m or scale_m
    floats = any(depth.dtype.kind == "f" for depth in depths)
    units_m = [known_m] if known_m else [1.0] if floats else plausible_units(depths) or [USUAL_UNIT_M]
    if not pairs and open_:
        raise SourceError(f"{path} does not tell what its poses mean, the camera hardly moves: give {_asked(open_)}")
    size = depths[0].shape if depths else (camera.intrinsics.height_px, camera.intrinsics.width_px)
    verdict = meaning_of(pairs, _at(camera.intrinsics, (size[1], size[0])), conventions, units_m)
    unclear = [name for name in verdict.unclear if name in open_]
    if open_ and (unclear or verdict.share < LEAST_SHARE):
        raise SourceError(
            f"{path} does not tell what its poses mean: depth images agree by {verdict.share:.0%} at best; "
            f"give {_asked(unclear or open_)}, and --depth-scale"
        )
    how = f"found: depth images agree by {verdict.share:.0%}" if open_ else "as told"
    said = [f"{verdict.meaning.convention.said()} ({how})"]
    if not floats:
        usual = "assumed, the movement does not tell; --depth-scale says otherwise"
        found = "found by the same agreement" if len(units_m) > 1 else "the one that makes a room"
        how = "as told" if known_m else usual if "unit" in verdict.unclear else found
        said.append(f"{verdict.meaning.unit_m:.6g} metres per depth unit ({how})")
    return verdict, said


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
