"""Frames of pictures alone: a network sees depth in each, and neighbouring pictures with their poses give the scale.

Pictures are made straight first, where their lens bends them, so that the network and the poses speak of one camera.
Around a frame, before and after it, those are followed into that the camera reached by moving a little.
"""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol

import msgspec
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.headers import JPEG_MAGIC
from prior_sg.services.ingest.core.mono import parallax
from prior_sg.services.ingest.core.mono.scale import METRIC, ScaleError, Scaling
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import rigid
from prior_sg.services.ingest.sources.base import Camera, Entry, Found, FrameError, Images, SourceError, color_pixels
from prior_sg.services.ingest.sources.cameras import Sizes, camera_of_images, straight_maps
from prior_sg.services.ingest.sources.depth_models import Seer
from prior_sg.services.ingest.sources.normaliser import UNUSABLE
from prior_sg.services.opencv import cv2

MOVED_M = (0.06, 0.18)  # how far the camera went to the pictures that are looked at, on either side
TOO_FAR_M, TURNED_DEG = 0.6, 25.0  # beyond, too little is in both pictures
REACH = 90  # frames
REMEMBERED = 48  # grey pictures
TRIED = 16  # pictures that are looked at for their size
LACKS_MODEL = (
    "{path} has no depth: give --depth-model FILE.onnx, a network that sees depth in one picture (docs/sources.md)"
)


class Sees(Protocol):
    """What sees depth in one picture: a `Seer`, whose `kind` says what it gives."""

    kind: str

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """(h, w) of a picture (h, w) or (h, w, 3). Raises FrameError."""


def with_depth(found: Found, options: ReadOptions) -> tuple[Found, ReadOptions]:
    """The same frames with depth, and the options that still count. Raises SourceError and ExtraMissing."""
    if not options.depth_model:
        raise SourceError(LACKS_MODEL.format(path=found.path))
    seer, notes = Seer(options), list[str]()
    size = _size(found)
    camera = camera_of_images(found, options, Sizes(size, size), notes)
    film = Film(found.entries, camera, seer)
    entries = [
        replace(entry, images=partial(film.images, index), glance=entry.images)
        for index, entry in enumerate(found.entries)
    ]
    gives = "depth" if seer.kind == METRIC else "inverse depth"
    scaled = "its scale is that" if seer.kind == METRIC else "scale and shift are those"
    notes.append(f"depth is seen by {seer.path.name} ({gives}); {scaled} of points followed between posed pictures")
    straight = Camera(camera.intrinsics, published=camera.published)
    told = msgspec.structs.replace(options, intrinsics=[], camera_model="", distortion=[])
    return replace(found, camera=straight, entries=entries, costly=True, notes=(*found.notes, *notes)), told


def _size(found: Found) -> tuple[int, int]:
    """Width and height of the first picture that can be read. Raises SourceError."""
    said = "it holds none"
    for entry in found.entries[:TRIED]:
        try:
            height, width = color_pixels(entry.images().color or b"").shape[:2]
            return width, height
        except UNUSABLE as error:
            said = str(error)
    raise SourceError(f"none of the pictures of {found.path} can be read: {said}")


class Film:
    """The pictures of a source, in order, each looked at with those around it."""

    def __init__(self, entries: Sequence[Entry], camera: Camera, seer: Sees) -> None:
        self._entries, self._camera, self._seer = entries, camera.intrinsics, seer
        self._maps = straight_maps(camera)
        self._scaling = Scaling(seer.kind)
        self._poses: dict[int, np.ndarray | None] = {}
        self._greys: OrderedDict[int, np.ndarray] = OrderedDict()

    def images(self, index: int) -> Images:
        """The picture, straight, and depth in metres. Raises UNUSABLE."""
        pose, entry = self._pose(index), self._entries[index]
        images = entry.images()
        color = self._straight(color_pixels(images.color or b""))
        if pose is None:
            raise FrameError("it has no pose by which the scale of its depth could be told")
        measured = self._measured(index, pose)
        at = np.rint(measured.points_px).astype(int)
        try:
            self._scaling.check(entry.stamp_ns, measured.inverse_depth, measured.sigma)
            output = self._seer(color)
            fit = self._scaling.take(entry.stamp_ns, output[at[:, 1], at[:, 0]], measured.inverse_depth, measured.sigma)
        except ScaleError as error:
            raise FrameError(str(error)) from error
        file = images.color or b""
        if self._maps is not None:
            file = encoded(color, ".jpg" if file.startswith(JPEG_MAGIC) else ".png")
        return Images(file, fit.depth_m(output, self._seer.kind), images.mask)

    def _measured(self, index: int, pose: np.ndarray) -> parallax.Measured:
        """Points of a picture whose depth those around it tell."""
        grey, views = self._grey(index), []
        points_px = parallax.corners(grey)
        for other in self._around(index, pose):
            try:
                picture = self._grey(other)
            except UNUSABLE:
                continue
            other_from_picture = inverse(self._poses[other]) @ pose  # type: ignore[arg-type]
            usual = self._scaling.usual
            views.append(parallax.look(grey, picture, points_px, other_from_picture, self._camera, usual))
        return parallax.measure(points_px, views, self._camera)

    def _around(self, index: int, pose: np.ndarray) -> Iterator[int]:
        """Pictures on either side from where the camera had moved as far as MOVED_M."""
        for side in (range(index - 1, max(-1, index - REACH - 1), -1), range(index + 1, index + REACH + 1)):
            wanted = list(MOVED_M)
            for other in side:
                if not wanted or other >= len(self._entries):
                    break
                there = self._pose(other)
                if there is None:
                    continue
                moved_m = float(np.linalg.norm(there[:3, 3] - pose[:3, 3]))
                if moved_m > TOO_FAR_M:
                    break
                if moved_m >= wanted[0] and np.degrees(rotation_angle_rad(inverse(there) @ pose)) < TURNED_DEG:
                    wanted = [more_m for more_m in wanted if more_m > moved_m]
                    yield other

    def _pose(self, index: int) -> np.ndarray | None:
        """source_from_camera; None where a frame has none."""
        if index not in self._poses:
            try:
                self._poses[index] = rigid(self._entries[index].pose())
            except UNUSABLE:
                self._poses[index] = None
        return self._poses[index]

    def _grey(self, index: int) -> np.ndarray:
        """A straight picture without its colour. Raises UNUSABLE."""
        if index in self._greys:
            self._greys.move_to_end(index)
            return self._greys[index]
        color = self._straight(color_pixels(self._entries[index].images().color or b""))
        grey = color if color.ndim == 2 else cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
        self._greys[index] = grey
        if len(self._greys) > REMEMBERED:
            self._greys.popitem(last=False)
        return grey

    def _straight(self, picture: np.ndarray) -> np.ndarray:
        """Raises FrameError for a picture of another size than the camera's."""
        of: Intrinsics = self._camera
        if picture.shape[:2] != (of.height_px, of.width_px):
            raise FrameError(
                f"the colour image has {picture.shape[1]} x {picture.shape[0]} pixels, the camera {of.width_px} x "
                f"{of.height_px}"
            )
        if self._maps is None:
            return picture
        return cv2.remap(picture, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
