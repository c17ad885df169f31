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

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.errors import reason_of
from prior_sg.services.ingest.core.detection import up_of
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.sources import pose_lists
from prior_sg.services.ingest.sources.base import (
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    first_size,
    lens_of,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.own_cameras import described, unit_of
from prior_sg.services.ingest.sources.own_files import (
    ARRAYS,
    COLORS,
    DEPTHS,
    MATRICES,
    PICTURES,
    POSES,
    Files,
    Folder,
    by_number,
    folder_of,
)
from prior_sg.services.ingest.sources.own_poses import Known, pose_of, usable_pose, verdict_of
from prior_sg.services.ingest.sources.tables import stamps_ns

NAME = "generic"
LOOKS = "rgb/ (or color/, image/), depth/ and pose/ (or a list of poses) with intrinsics.* or camera.* (own layout)"
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


def load(path: Path, options: ReadOptions) -> Found:
    """A folder in a layout of one's own. Raises SourceError."""
    folder = _folder(path, options)
    keys = sorted(folder.colors.keys() | folder.depths.keys() | folder.poses.keys())
    files = [Files(folder.colors.get(key), folder.depths.get(key), folder.poses.get(key)) for key in keys]
    camera, scale_m, notes = _camera(path, folder, options)
    verdict, said = verdict_of(path, files, Known(camera, scale_m), folder, options)
    convention = verdict.meaning.convention
    up, clear = up_of([pose for file in files if (pose := usable_pose(file, convention)) is not None])
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
            Entry(number, stamp, partial(pose_of, file, convention), partial(_images, file, folder.depthless))
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
    by_color = by_number(colors, PICTURES)
    stems = {file.stem: key for key, file in by_color.items()}
    by_depth = {} if depths is None else by_number(depths, ARRAYS)
    if listed is not None and listed.depth_names:
        by_depth = {stems[s]: listed.path.parent / name for s, name in listed.depth_names.items() if s in stems}
    held = tuple(f"{part.name}/" for part in (colors, depths, poses) if part is not None)
    if listed is None:
        return Folder(by_color, by_depth, by_number(poses, MATRICES) if poses else {}, held, depthless=depthless)
    held = (*held, listed.path.name)
    return Folder(by_color, by_depth, listed.of(sorted(by_color), stems), held, listed, depthless)


def _numbers(keys: Sequence[float]) -> list[int]:
    plain = all(key == int(key) and key < EPOCH_S for key in keys)
    return [int(key) for key in keys] if plain else list(range(len(keys)))


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
        raise SourceError(f"{file} is not a camera: {reason_of(error)}") from error


def _images(file: Files, depthless: bool) -> Images:
    if depthless and file.color is not None:
        return Images(read_bytes(file.color), b"")
    if file.color is None or file.depth is None:
        raise FrameError(f"it has no {'colour' if file.color is None else 'depth'} file")
    return Images(read_bytes(file.color), read_bytes(file.depth))


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
