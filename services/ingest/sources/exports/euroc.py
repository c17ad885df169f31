"""Sequences in the layout of EuRoC (ASL): two cameras beside each other, and a body whose poses are known.

mav0/cam0/data/NS.png, mav0/cam1/data/NS.png   pictures, named by their stamps, ns; the left camera first
mav0/camN/sensor.yaml                          T_BS (body_from_sensor), resolution, intrinsics (fu fv cu cv),
                                               distortion_model, distortion_coefficients
mav0/state_groundtruth_estimate0/data.csv      stamp (ns), position, quaternion wxyz of the body: world_from_body, z
                                               up; or mav0/vicon0, mocap0, or poses.txt here: rows of stamp tx ty tz
                                               qx qy qz qw

Depth comes from the two pictures: rectified, then matched by OpenCV's SGBM, or by a network of one's own with
--depth-model (depth_models.py); by one that sees it in one picture, of cam0 alone (mono/film.py). Poses are
interpolated. Unknown lenses are told, and sequences of one camera without such a network.
Source: projects.asl.ethz.ch/datasets, the paper of Burri et al. 2016.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse
from prior_sg.services.ingest.core import stereo
from prior_sg.services.ingest.core.options import ReadOptions, check_lens
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import PoseError, rigid
from prior_sg.services.ingest.core.ros.transforms import Track
from prior_sg.services.ingest.sources import base, depth_models, pose_lists
from prior_sg.services.ingest.sources.base import (
    LENS_NAMES,
    MILLIMETRE,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    color_pixels,
    numbered,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.own_cameras import in_brackets
from prior_sg.services.ingest.sources.tables import lines_of, text_of, words_of

NAME = "euroc"
LOOKS = "mav0/cam0 and mav0/cam1 (EuRoC)"
POSES = ("mav0/state_groundtruth_estimate0/data.csv", "mav0/vicon0/data.csv", "mav0/mocap0/data.csv", "poses.txt")
WITHIN_NS = 20_000_000  # of a first or last pose
PARTNER_NS = 1_000_000


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / "mav0" / "cam0").is_dir()


def load(path: Path, options: ReadOptions) -> Found:
    """A sequence of EuRoC. Raises SourceError."""
    lefts, rights = (numbered(path / "mav0" / name / "data", r"(\d+)\.(?:png|jpg)") for name in ("cam0", "cam1"))
    if lefts and depth_models.sees_one(options):
        return _of_one(path, lefts, options)
    if not lefts or not rights:
        raise SourceError(
            f"{path} has pictures of {'one camera' if lefts else 'no left camera'}: depth needs cam0 and cam1, or cam0 "
            "and a --depth-model that sees it in one picture"
        )
    (left, body_from_left), (right, body_from_right) = (
        _sensor(path / "mav0" / name / "sensor.yaml") for name in ("cam0", "cam1")
    )
    try:
        pair = stereo.Pair.of(left, right, inverse(body_from_right) @ body_from_left)
    except ValueError as error:
        raise SourceError(f"{path} is no stereo camera: {error}") from error
    track, file = _track(path, options)
    matcher, said = depth_models.matcher_of(options)
    body_from_camera = body_from_left @ pair.left_from_rectified
    entries = [
        Entry(
            number,
            options.told_ns(number, stamp),
            partial(_pose, track, stamp, body_from_camera),
            partial(_images, pair, matcher, *files),
        )
        for number, (stamp, files) in enumerate(_both(lefts, rights))
    ]
    if not entries:
        raise SourceError(f"{path} has no picture of cam0 with one of cam1 within 1 ms: name both by the same stamps")
    return Found(
        NAME,
        path,
        base.Camera(pair.intrinsics),
        MILLIMETRE,
        entries,
        ground_truth=truth_beside(path),
        why=("mav0/cam0 lies in it",),
        notes=(f"depth is that of two cameras {pair.baseline_m:.3f} m apart, {said}", f"poses of {file.name}"),
    )


def _of_one(path: Path, files: dict[int, Path], options: ReadOptions) -> Found:
    """The left camera alone. Raises SourceError."""
    lens, body_from_camera = _sensor(path / "mav0/cam0/sensor.yaml")
    track, file = _track(path, options)
    entries = [
        Entry(
            number,
            options.told_ns(number, stamp),
            partial(_pose, track, stamp, body_from_camera),
            partial(_picture, picture),
        )
        for number, (stamp, picture) in enumerate(files.items())
    ]
    return Found(
        NAME,
        path,
        base.Camera(lens.intrinsics, lens.model, lens.distortion),
        MILLIMETRE,
        entries,
        ground_truth=truth_beside(path),
        why=("mav0/cam0 lies in it",),
        notes=(f"poses of {file.name}",),
        depthless=True,
    )


def _picture(file: Path) -> Images:
    return Images(read_bytes(file), b"")


def _both(lefts: dict[int, Path], rights: dict[int, Path]) -> list[tuple[int, tuple[Path, Path]]]:
    """Pictures of both cameras with one stamp, or nearly."""
    stamps = np.array(sorted(rights), np.int64)
    pairs = []
    for stamp, file in lefts.items():
        nearest = int(stamps[np.abs(stamps - stamp).argmin()])
        if abs(nearest - stamp) <= PARTNER_NS:
            pairs.append((stamp, (file, rights[nearest])))
    return pairs


def _pose(track: Track, stamp_ns: int, body_from_camera: np.ndarray) -> np.ndarray:
    return track.at(stamp_ns, WITHIN_NS) @ body_from_camera


def _images(pair: stereo.Pair, matcher: stereo.Matcher, left: Path, right: Path) -> Images:
    """Raises FrameError."""
    pictures = color_pixels(read_bytes(left)), color_pixels(read_bytes(right))
    size = pair.intrinsics.height_px, pair.intrinsics.width_px
    if any(picture.shape[:2] != size for picture in pictures):
        raise FrameError(f"its pictures do not have the {size[1]} x {size[0]} pixels of the cameras")
    first, second = pair.rectified(*pictures)
    return Images(encoded(first, ".png"), pair.depth_m(matcher(first, second)))


def _sensor(path: Path) -> tuple[stereo.Lens, np.ndarray]:
    """The camera, and body_from_sensor. Raises SourceError."""
    text = text_of(path)
    model = re.search(r"^distortion_model:\s*([\w-]+)", text, re.MULTILINE)
    word = model[1].replace("-", "_").lower() if model else ""
    lens = next((name for name, words in LENS_NAMES.items() if word in words), "" if word else "pinhole")
    try:
        body_from_sensor = rigid(np.array(_numbers(text, r"T_BS:.*?data", 16)).reshape(4, 4))
        size, focal = _numbers(text, "resolution", 2), _numbers(text, "intrinsics", 4)
        written = tuple(_numbers(text, "distortion_coefficients", 0))
        if not lens:
            raise ValueError(f"its distortion_model {word} is not known")
        if any(written) and not word:
            raise ValueError("it has distortion_coefficients and no distortion_model")
        bent = written if lens != "pinhole" else ()
        check_lens(lens, bent)
        return stereo.Lens(Intrinsics(int(size[0]), int(size[1]), *focal), lens, bent), body_from_sensor
    except (ValueError, PoseError) as error:
        raise SourceError(f"{path} is not a camera: {error}") from error


def _numbers(text: str, key: str, count: int) -> list[float]:
    """Numbers in brackets behind a key; 0 = however many. Raises ValueError."""
    numbers = in_brackets(text, rf"^{key}:\s*")
    if numbers is None or (count and len(numbers) != count):
        raise ValueError(f"it has no {key.split(':', maxsplit=1)[0]} with {count or 'nothing but'} numbers")
    return numbers


def _track(path: Path, options: ReadOptions) -> tuple[Track, Path]:
    """Where the body was, and the file that says so. Raises SourceError."""
    file = next((path / name for name in POSES if (path / name).is_file()), None)
    if file is None:
        raise SourceError(f"{path} has no poses: looked for {', '.join(POSES)}")
    words = [words_of(line)[:8] for line in lines_of(file)]
    try:
        table = np.array([row[1:] for row in words], np.float64).reshape(-1, 7)
        stamps = [round(float(row[0]) * 1e9) if "." in row[0] else int(row[0]) for row in words]
    except (ValueError, IndexError, OverflowError) as error:
        raise SourceError(f"{file} is no list of poses with stamps: {error}") from error
    rows = table[:, (0, 1, 2, 4, 5, 6, 3)] if file.suffix == ".csv" else table
    return pose_lists.track_of(file, stamps, rows, options), file
