"""What every source is, what a layout's loader finds, and the small readers all of them share."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.frames import BadFrame, Closure, Correction, RawFrame, Unused
from prior_sg.services.ingest.core.pixels import eight_bit, measured, stored
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.tables import SourceError, read_json

__all__ = ["FrameError", "Source", "SourceError"]

UP = (0.0, 0.0, 1.0)
CAMERA, REGIONS = "camera.json", "regions.json"
MILLIMETRE = 0.001
SATURATED = 65535.0  # the largest value of 16 bits: sensors and tools write it where they measured nothing


class FrameError(ValueError):
    """One frame cannot be used; the text is the reason."""


Event = RawFrame | BadFrame | Correction | Unused | Closure
Wanted = Callable[[int, np.ndarray], bool]  # whether the images of a frame are, by its index and world_from_camera


@dataclass(frozen=True)
class Source:
    """A sequence of posed RGB-D frames. Iterating it reads files; each iteration begins at the first frame."""

    layout: str  # its name in docs/sources.md
    path: Path
    intrinsics: Intrinsics
    total: int
    frames: Callable[[], Iterator[RawFrame | BadFrame]]
    ground_truth: dict[str, Any] | None = None  # content of regions.json
    corrections: Callable[[], Iterator[Correction]] = lambda: iter(())  # corrected poses, stamps not falling
    why: tuple[str, ...] = ()  # how the layout was recognised
    notes: tuple[str, ...] = ()  # everything that was changed or assumed on reading
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # where the frames' world has its zero in the source's
    convention: Convention | None = None  # how written poses were read; None = in a way no option changes
    depth_unit_m: float = MILLIMETRE  # metres per unit of depth as the files hold it
    world_from_source: np.ndarray | None = None  # 4 x 4, levelling and recentring; None = nothing was done
    live: "Callable[[], Iterator[Event]] | None" = None  # of a running robot: what comes from now on, images only of
    # frames that may become keyframes
    close: Callable[[], None] = lambda: None  # ends what runs; safe from any thread
    thinned: "Callable[[Wanted], Iterator[RawFrame | BadFrame]] | None" = None  # the same frames, but images, which
    # cost time, only of the wanted ones; the others' files are looked at and their images left empty
    sparing: "Callable[[], Iterator[RawFrame | BadFrame]] | None" = None  # the same frames, images only of those that
    # may become keyframes; None = images cost little

    def __iter__(self) -> Iterator[RawFrame | BadFrame]:
        return self.frames()

    def events(self, since: int = 0) -> "Iterator[Event]":
        """Frames, with each correction before the first frame of a later stamp, or at the end; of a source that is not
        live, those from the frame at the position `since` on."""
        if self.live is not None:
            yield from self.live()
            return
        corrections = self.corrections()
        waiting = next(corrections, None)
        for frame in self._frames_since(since):
            while waiting is not None and isinstance(frame, RawFrame) and waiting.stamp_ns < frame.stamp_ns:
                if frame.index >= since:
                    yield waiting
                waiting = next(corrections, None)
            if frame.index >= since:
                yield frame
        if waiting is not None:
            yield waiting
        yield from corrections

    def _frames_since(self, since: int) -> "Iterator[RawFrame | BadFrame]":
        """All frames, those before without images where that is cheaper."""
        if self.sparing is not None:
            return self.sparing()
        if self.thinned is None or since == 0:
            return self.frames()
        return self.thinned(lambda index, world_from_camera: index >= since)


@dataclass(frozen=True)
class Camera:
    """A camera as a source's files or its publisher describe it."""

    intrinsics: Intrinsics
    model: str = ""  # of the lens; empty = pinhole without coefficients, opencv with them
    distortion: tuple[float, ...] = ()
    published: bool = False  # a constant of the publisher's, whatever size the images have


@dataclass(frozen=True)
class Images:
    """The pictures of one frame as their files hold them; depth may be an array of metres (h, w) already."""

    color: bytes | None  # None = a sensor that sees no colour
    depth: bytes | np.ndarray
    mask: bytes = b""


@dataclass(frozen=True)
class Entry:
    """One frame before it is read: `pose` gives source_from_camera; all raise FrameError."""

    frame_id: int
    stamp_ns: int
    pose: Callable[[], np.ndarray]
    images: Callable[[], Images]
    glance: Callable[[], Images] | None = None  # images as far as they cost little; None = they do


@dataclass(frozen=True)
class Found:
    """What a layout's loader found, before the normalising step."""

    layout: str
    path: Path
    camera: Camera
    depth_scale_m: float
    entries: Sequence[Entry]
    up: tuple[float, float, float] = UP  # in the source's world
    depth_invalid: tuple[float, ...] = (SATURATED,)
    ground_truth: dict[str, Any] | None = None
    corrections: Sequence[Correction] = ()  # in the source's world
    convention: Convention | None = None  # how written poses are read; None = in a way no option changes
    why: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    depthless: bool = False  # images are colour alone, in which depth is to be seen
    costly: bool = False  # images take long, so that only those are made that are needed
    assumed_hz: float = 0.0  # frames per second where the layout has no stamps and nobody told; 0 = stamps are real
    name: str = ""  # of the camera, where the robot has several
    beside: "tuple[Found, ...]" = ()  # its other cameras, in the same world and with real stamps


def truth_beside(path: Path) -> dict[str, Any] | None:
    """Content of a regions.json in the folder. Raises SourceError."""
    return read_json(path / REGIONS) if (path / REGIONS).is_file() else None


def shifted_truth(truth: Any, origin_m: Sequence[float]) -> Any:
    """Regions of a ground truth in the recentred world; what is not ours is handed on as it is."""
    if not any(origin_m) or not isinstance(truth, dict):
        return truth
    x_m, y_m, z_m = origin_m
    try:
        regions = [
            {**region, "polygon_m": [[x - x_m, y - y_m] for x, y in region["polygon_m"]]} for region in truth["regions"]
        ]
        floors = [
            {**floor, "z_min_m": floor["z_min_m"] - z_m, "z_max_m": floor["z_max_m"] - z_m} for floor in truth["floors"]
        ]
    except (TypeError, KeyError, ValueError, AttributeError):
        return truth
    return {**truth, "regions": regions, "floors": floors}


def read_bytes(path: Path) -> bytes:
    """A file's content. Raises FrameError."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise FrameError(f"{path.name} cannot be read: {error.strerror}") from error


def color_pixels(data: bytes) -> np.ndarray:
    """Colour (h, w) or (h, w, 3) of 8 bits of an image file. Raises FrameError."""
    try:
        return eight_bit(data)
    except ImageError as error:
        raise FrameError(f"the colour image is damaged: {error}") from error


def depth_pixels(data: bytes) -> np.ndarray:
    """Numbers of a depth image as they are stored. Raises FrameError."""
    try:
        return stored(data)
    except ImageError as error:
        raise FrameError(f"the depth image is damaged: {error}") from error


def camera_of(path: Path, camera: Any) -> Camera:
    """The camera of a JSON object with width, height, fx, fy, cx, cy, and `model` and `distortion` where it has them.

    `path` is for the reader of an error. Raises SourceError.
    """
    if not isinstance(camera, dict):
        raise SourceError(f"{path} is not a camera: it must be an object with {', '.join(CAMERA_KEYS)}")
    missing = [name for name in CAMERA_KEYS if camera.get(name) is None]
    if missing:
        held = ", ".join(str(name)[:20] for name in list(camera)[:12]) or "nothing"
        raise SourceError(f"{path} is not a camera: it lacks {', '.join(missing)}; it holds {held}")
    try:
        size, numbers = CAMERA_KEYS[:2], CAMERA_KEYS[2:]
        intrinsics = Intrinsics(*(int(camera[name]) for name in size), *(float(camera[name]) for name in numbers))
    except (TypeError, ValueError, OverflowError) as error:
        raise SourceError(f"{path} is not a camera: {error}") from error
    return Camera(intrinsics, *lens_of(path, camera))


CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
LENS_NAMES = {
    "pinhole": ("pinhole", "simple_pinhole", "none", "ideal"),
    "opencv": (
        "opencv", "full_opencv", "plumb_bob", "radtan", "radial_tangential", "brown", "brown_conrady",
        "rational_polynomial", "rational", "perspective",
    ),
    "fisheye": ("fisheye", "opencv_fisheye", "equidistant", "kannala_brandt", "kannala_brandt4", "kb4"),
}  # fmt: skip
LENS_KEYS = {"opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "fisheye": ("k1", "k2", "k3", "k4")}


def lens_of(path: Path, camera: dict[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients of a camera's lens, of a list, of named numbers, or of none. Raises SourceError."""
    said = next((camera[k] for k in ("model", "camera_model", "distortion_model") if camera.get(k)), "")
    word = re.sub(r"[\s-]+", "_", str(said).strip().lower())
    model = next((name for name, words in LENS_NAMES.items() if word in words), "")
    if word and not model:
        known = ", ".join(LENS_NAMES)
        raise SourceError(f"{path} names the lens {str(said)[:40]!r}, which is not known: give --camera-model {known}")
    values = next((camera[k] for k in ("distortion", "distortion_coefficients", "dist_coeffs") if k in camera), None)
    try:
        if values is None or isinstance(values, dict):
            named = {str(k).lower(): v for k, v in (camera if values is None else values).items()}
            keys = LENS_KEYS[model if model in LENS_KEYS else "opencv"]
            last = max((i for i, key in enumerate(keys) if named.get(key)), default=-1)
            count = next((n for n in (0, 4, 5, 8) if n > last), 8)
            values = [named.get(key) or 0.0 for key in keys[:count]]
        return model, tuple(float(value) for value in np.ravel(values).tolist())
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path} has a distortion that is not a list of numbers: {error}") from error


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder by number, the first group of a regular expression that matches the whole name.

    Endings may be in capital letters; hidden files are somebody else's.
    """
    files = [file for file in folder.iterdir() if not file.name.startswith(".")] if folder.is_dir() else []
    matches = ((re.fullmatch(pattern, file.name, re.IGNORECASE), file) for file in files)
    return dict(sorted((int(match[1]), file) for match, file in matches if match))


def file_of(files: dict[int, Path], number: int, kind: str) -> bytes:
    """Content of the file with this number. Raises FrameError."""
    if number not in files:
        raise FrameError(f"it has no {kind} file")
    return read_bytes(files[number])


def images_of(colors: dict[int, Path], depths: dict[int, Path], number: int) -> Images:
    """The pictures with this number. Raises FrameError."""
    return Images(file_of(colors, number, "colour"), file_of(depths, number, "depth"))


def first_size(files: Sequence[Path], where: Path) -> tuple[int, int]:
    """Width and height, pixels, of the first image, of those looked for in `where`, that can be read.

    Raises SourceError.
    """
    for file in files:
        try:
            width_px, height_px, _ = measured(read_bytes(file))
            return width_px, height_px
        except (FrameError, ImageError):
            continue
    if not files:
        raise SourceError(f"{where} holds no images of the layout's names")
    raise SourceError(f"no image in {files[0].parent} can be read")


def levelling(world_up: Sequence[float], floor_m: float) -> np.ndarray | None:
    """world_from_source: the smallest rotation that turns `world_up` into z, and a shift that puts the floor at zero.

    None when nothing is to be done, so that poses pass unchanged to the last bit. Raises SourceError.
    """
    up = np.asarray(world_up, float)
    length = float(np.linalg.norm(up)) if up.shape == (3,) else 0.0
    if not (math.isfinite(length) and length > 0 and math.isfinite(floor_m)):
        raise SourceError(f"world_up must be three numbers, not all zero, such as 0 -1 0; got {list(world_up)}")
    if tuple(up) == UP and floor_m == 0.0:
        return None
    x, y, z = up / length
    world_from_source = np.eye(4)
    if z < -1 + 1e-12:
        world_from_source[:3, :3] = np.diag((1.0, -1.0, -1.0))  # upside down: every horizontal axis serves; x is taken
    else:
        cross = np.array(((0, 0, -x), (0, 0, -y), (x, y, 0)))  # Rodrigues' formula for the axis up x z
        world_from_source[:3, :3] = np.eye(3) + cross + cross @ cross / (1 + z)
    world_from_source[2, 3] = -floor_m
    return world_from_source
