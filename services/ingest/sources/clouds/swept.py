"""Frames of a lidar: its sweeps drawn into a camera's images, or into views of its own where there is no camera."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.ingest.core.clouds.sweep import CloudError, Sweep, in_world
from prior_sg.services.ingest.core.clouds.views import VIEW, lidar_from_views, looked_at, seen
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pairing import associate
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.sources.base import Camera, Entry, FrameError, Images, SourceError, color_pixels
from prior_sg.services.ingest.sources.cameras import straight_maps
from prior_sg.services.opencv import cv2

Posed = Callable[[int], np.ndarray]  # world_from_sensor (4, 4) at a stamp, ns; raises PoseError
TRIED = 20  # sweeps that are looked at for the views that see something
VIEW_STEP_NS = 1_000_000  # between the stamps of the views of one sweep, which must rise
USUAL_PERIOD_NS = 100_000_000


@dataclass
class Lidar:
    """Sweeps by rising stamps, and where the sensor was."""

    stamps_ns: Sequence[int]
    read: Callable[[int], Sweep]  # by position; raises FrameError
    world_from_lidar: Posed
    _last: tuple[int, np.ndarray] = field(default=(-1, np.empty((0, 3))), repr=False)

    def points_world(self, position: int) -> np.ndarray:
        """Points (n, 3) of a sweep, where they were measured. Raises FrameError and PoseError."""
        if self._last[0] != position:
            try:
                points = in_world(self.read(position), self.stamps_ns[position], self.world_from_lidar)
            except CloudError as error:
                raise FrameError(f"its cloud cannot be used: {error}") from error
            self._last = position, points
        return self._last[1]

    def partners(self, stamps_ns: Sequence[int]) -> list[tuple[int, int]]:
        """Positions of pictures, by their stamps, and of the sweep that was under way then or next; each used once."""
        steps = np.diff(self.stamps_ns)
        within_ns = round(float(np.median(steps))) if len(steps) else USUAL_PERIOD_NS
        return sorted(associate(stamps_ns, self.stamps_ns, within_ns).items())


@dataclass(frozen=True)
class Drawing:
    """Draws sweeps into a camera's straightened pictures."""

    lidar: Lidar
    camera: Camera
    world_from_camera: Posed
    maps: tuple[np.ndarray, np.ndarray] | None

    @staticmethod
    def of(lidar: Lidar, camera: Camera, world_from_camera: Posed) -> "Drawing":
        """With what straightens the camera's lens."""
        return Drawing(lidar, camera, world_from_camera, straight_maps(camera))

    def __call__(self, file: bytes, stamp_ns: int, position: int) -> Images:
        """Colour of an image file, and depth of a sweep. Raises FrameError and PoseError."""
        picture, of = color_pixels(file), self.camera.intrinsics
        if picture.shape[:2] != (of.height_px, of.width_px):
            raise FrameError(
                f"the colour image has {picture.shape[1]} x {picture.shape[0]} pixels, its camera "
                f"{of.width_px} x {of.height_px}"
            )
        if self.maps is not None:
            picture = cv2.remap(picture, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            file = encoded(picture, ".png")
        points_world = self.lidar.points_world(position)
        points_camera = transform(inverse(self.world_from_camera(stamp_ns)), points_world)
        return Images(file, dense(points_camera, of, picture))


def view_entries(lidar: Lidar, options: ReadOptions) -> tuple[Camera, list[Entry], str]:
    """Frames without colour for a lidar without a camera, and a note on them. Raises SourceError."""
    poses = [_posed(lidar, stamp_ns) for stamp_ns in lidar.stamps_ns]
    chosen = looked_at(lidar.stamps_ns, poses)
    sweeps = (partial(lidar.read, position) for position in chosen[:TRIED])
    views = used_views(sweeps, f"{len(lidar.stamps_ns)} sweeps", "none has a pose")
    entries: list[Entry] = []
    for position in chosen:
        for number, lidar_from_view in enumerate(views):
            stamp_ns = options.told_ns(len(entries), lidar.stamps_ns[position] + number * VIEW_STEP_NS)
            pose = partial(_pose, lidar, position, lidar_from_view)
            entries.append(Entry(len(entries), stamp_ns, pose, partial(_images, lidar, position, lidar_from_view)))
    note = (
        f"there is no camera: {len(chosen)} of {len(poses)} sweeps are looked at in {len(views)} views of 90 degrees, "
        "and places have no appearance"
    )
    return Camera(VIEW), entries, note


def used_views(sweeps: Iterable[Callable[[], Sweep]], of: str, otherwise: str) -> list[np.ndarray]:
    """The views into which points fall, of the first sweep that has any; each raises FrameError or CloudError where it
    cannot be read. Raises SourceError, which says `of` what and, of none at all, `otherwise`.
    """
    reason = otherwise
    for read in sweeps:
        try:
            points_lidar = read().points_lidar
        except (FrameError, CloudError) as error:
            reason = str(error)
            continue
        if used := [view for view in lidar_from_views() if seen(points_lidar, view)]:
            return used
        reason = f"the first have {len(points_lidar)} points"
    raise SourceError(f"none of the {of} can be used: {reason}")


def _posed(lidar: Lidar, stamp_ns: int) -> np.ndarray | None:
    try:
        return lidar.world_from_lidar(stamp_ns)
    except PoseError:
        return None


def _pose(lidar: Lidar, position: int, lidar_from_view: np.ndarray) -> np.ndarray:
    return lidar.world_from_lidar(lidar.stamps_ns[position]) @ lidar_from_view


def _images(lidar: Lidar, position: int, lidar_from_view: np.ndarray) -> Images:
    world_from_view = _pose(lidar, position, lidar_from_view)
    points_view = transform(inverse(world_from_view), lidar.points_world(position))
    return Images(None, dense(points_view, VIEW, None))


def dense(points_camera: np.ndarray, camera: Intrinsics, picture: np.ndarray | None) -> np.ndarray:
    """Depth (h, w), metres, of points (n, 3); see `upsampled`."""
    from prior_sg.services.ingest.core.clouds.upsampling import upsampled  # takes numba and SciPy: lidars alone need it

    return upsampled(points_camera, camera, picture)
