"""A folder of clouds of a lidar, with pictures of a camera or without.

lidar/STAMP.npy .pcd .ply .bin   points x y z in the lidar's frame (x forward, y left, z up), and where the sensor
                                 writes it the time of each: t, time, timestamp, offset_time; .npy (n, 3) or
                                 structured, .bin as KITTI's (x y z intensity)
color/STAMP.jpg or .png          (or rgb/, image/) pictures; without them the lidar gives places that have no appearance
lidar.json                       {"camera": {"width": …, "height": …, "fx": …, "fy": …, "cx": …, "cy": …, and where it
                                 has them "model", "distortion"}, "camera_from_lidar": 4 x 4, "body_from_lidar": 4 x 4}
poses.txt                        (any name and format of a list with stamps) world_from_body, the lidar's own where
                                 body_from_lidar is left out; at any rate, as it is interpolated

Each picture gets the sweep nearest in time, each sweep one picture. Points go to where the lidar was when each was
measured, then into the camera at the picture's stamp, and are upsampled (core/clouds/upsampling.py). World z up.
"""

from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.services.geometry import inverse
from prior_sg.services.ingest.core.clouds.files import ENDINGS, columns_of
from prior_sg.services.ingest.core.clouds.sweep import EDGE_NS, CloudError, Sweep, sweep_of
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import PoseError, rigid
from prior_sg.services.ingest.core.ros.transforms import Track
from prior_sg.services.ingest.sources import pose_lists
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    camera_of,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.clouds.swept import Drawing, Lidar, view_entries
from prior_sg.services.ingest.sources.own_files import COLORS, PICTURES, folder_of
from prior_sg.services.ingest.sources.tables import read_json, stamps_ns

NAME = "lidar"
CLOUDS, DESCRIBED = "lidar", "lidar.json"
LOOKS = f"{CLOUDS}/ with a cloud per sweep, {DESCRIBED} and a list of poses with stamps (lidar)"


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return path.is_dir() and bool(_files(path / CLOUDS, ENDINGS))


def load(path: Path, options: ReadOptions) -> Found:
    """A folder of clouds. Raises SourceError."""
    said = read_json(path / DESCRIBED) if (path / DESCRIBED).is_file() else {}
    if not isinstance(said, dict):
        raise SourceError(f"{path / DESCRIBED} is not an object with camera and camera_from_lidar")
    track, list_name = _track(path, options)
    body_from_lidar = _motion(path, said, "body_from_lidar")
    files, stamps = _by_stamp(path / CLOUDS, ENDINGS, options)

    def world_from_lidar(stamp_ns: int) -> np.ndarray:
        return track.at(stamp_ns, EDGE_NS) @ body_from_lidar

    lidar = Lidar(stamps, partial(_sweep, files, stamps), world_from_lidar)
    colors = folder_of(path, COLORS)
    notes: tuple[str, ...] = (f"the lidar moves as {list_name} says; quaternions are xyzw",)
    if colors is None:
        camera, entries, note = view_entries(lidar, options)
        notes = (*notes, note)
    else:
        if "camera" not in said or "camera_from_lidar" not in said:
            raise SourceError(
                f"{path} has pictures in {colors.name}/: put camera and camera_from_lidar into {DESCRIBED}"
            )
        camera_from_lidar = _motion(path, said, "camera_from_lidar")
        bent = camera_of(path / DESCRIBED, said["camera"])
        camera = Camera(bent.intrinsics)
        entries = _drawn(colors, lidar, bent, camera_from_lidar, options)
    return Found(
        NAME,
        path,
        camera,
        MILLIMETRE,
        entries,
        ground_truth=truth_beside(path),
        why=(f"{CLOUDS}/ holds clouds of points",),
        notes=notes,
    )


def _drawn(
    colors: Path, lidar: Lidar, camera: Camera, camera_from_lidar: np.ndarray, options: ReadOptions
) -> list[Entry]:
    """A frame for each picture that a sweep is near in time to. Raises SourceError."""
    files, stamps = _by_stamp(colors, PICTURES, options)

    def world_from_camera(stamp_ns: int) -> np.ndarray:
        return lidar.world_from_lidar(stamp_ns) @ inverse(camera_from_lidar)

    drawing = Drawing.of(lidar, camera, world_from_camera)
    entries = [
        Entry(
            i,
            options.told_ns(i, stamps[i]),
            partial(world_from_camera, stamps[i]),
            partial(_images, drawing, files[i], stamps[i], j),
        )
        for i, j in lidar.partners(stamps)
    ]
    if not entries:
        away_s = (lidar.stamps_ns[0] - stamps[0]) / 1e9
        raise SourceError(f"no picture in {colors} has a sweep near in time: these begin {away_s:+.3f} s after them")
    return entries


def _images(drawing: Drawing, file: Path, stamp_ns: int, position: int) -> Images:
    return drawing(read_bytes(file), stamp_ns, position)


def _sweep(files: list[Path], stamps: list[int], position: int) -> Sweep:
    """Raises FrameError."""
    file = files[position]
    try:
        return sweep_of(columns_of(read_bytes(file), file.suffix), stamps[position])
    except CloudError as error:
        raise FrameError(f"{file.name} cannot be used: {error}") from error


def _files(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in endings and file.name[0] != ".")


def _by_stamp(folder: Path, endings: tuple[str, ...], options: ReadOptions) -> tuple[list[Path], list[int]]:
    """Files whose names are stamps, and these, rising. Raises SourceError."""
    files = _files(folder, endings)
    if not files:
        raise SourceError(f"{folder} holds none of {', '.join(endings)}")
    stamps, _ = stamps_ns([file.stem for file in files], folder, "s", options.stamp_unit)
    known = sorted((stamp, file) for stamp, file in zip(stamps, files, strict=True) if stamp is not None)
    return [file for _, file in known], [stamp for stamp, _ in known]


def _track(path: Path, options: ReadOptions) -> tuple[Track, str]:
    """Where the body was over time, and the file that says so. Raises SourceError."""
    found = pose_lists.find(path)
    listed = None if found is None else pose_lists.read(found)
    if listed is None or not listed.numbers:
        raise SourceError(
            f"{path} has no list of poses with stamps: put poses.txt with rows of stamp tx ty tz qx qy qz qw into it"
        )
    stamps, _ = stamps_ns([repr(number) for number in listed.numbers], listed.path, "s", options.stamp_unit)
    return pose_lists.track_of(listed.path, stamps, listed.rows, options), listed.path.name


def _motion(path: Path, said: dict, name: str) -> np.ndarray:
    """A rigid motion of the description, none where it is left out. Raises SourceError."""
    try:
        return rigid(np.array(said.get(name, np.eye(4)), np.float64).reshape(4, 4))
    except (ValueError, TypeError, PoseError) as error:
        raise SourceError(f"{path / DESCRIBED}: {name} is not a motion of 4 x 4 numbers: {error}") from error
