"""Clouds of a running robot as depth: in the pictures of a camera, or in views of the lidar's own.

As of recordings (clouds/ros.py), with what tf says once it reaches the end of a sweep.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from prior_sg.services.geometry import inverse, transform
from prior_sg.services.ingest.core.clouds.views import VIEW, looked_at
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.core.ros.assembly import Posed, Rules, Shot
from prior_sg.services.ingest.core.ros.images import color_file
from prior_sg.services.ingest.core.ros.motions import Motions
from prior_sg.services.ingest.core.ros.topics import Chosen
from prior_sg.services.ingest.sources.base import Camera, Images
from prior_sg.services.ingest.sources.cameras import straight_maps
from prior_sg.services.ingest.sources.clouds.swept import USUAL_PERIOD_NS, VIEW_STEP_NS, Drawing, Lidar, dense
from prior_sg.services.ingest.sources.ros.reader import Reader


@dataclass(frozen=True)
class Shown:
    """A frame before its pictures are read: `images` and `placed` raise UNUSABLE."""

    stamp_ns: int
    source_from_sensor: np.ndarray  # (4, 4), as tf says
    placed: Callable[[np.ndarray], np.ndarray]  # the same to source_from_camera, of the frame
    images: Callable[[], Images]


Shower = Callable[[Posed], Iterator[Shown]]  # the frames that a pair of messages gives


def period_ns(stamps_ns: Sequence[int]) -> int:
    """Between two sweeps, as those of a recording are paired."""
    steps = np.diff(sorted(stamps_ns))
    return round(float(np.median(steps))) if len(steps) else USUAL_PERIOD_NS


@dataclass(frozen=True)
class Drawn:
    """Sweeps in the pictures of a camera."""

    reader: Reader
    choice: Chosen
    rules: Rules
    convention: Convention
    camera: Camera

    def begin(self, motions: Motions) -> Shower:
        """What makes frames of one stream."""
        maps = straight_maps(self.camera)

        def world_from_camera(stamp_ns: int) -> np.ndarray:
            return self.convention.of_matrix(motions.at(self.rules.way, stamp_ns, self.rules.pose_within_ns))

        def shown(posed: Posed) -> Iterator[Shown]:
            lidar = lidar_of(self.reader, self.choice, self.rules, motions, posed.depth)
            drawing = Drawing(lidar, self.camera, world_from_camera, maps)
            images = partial(self._images, drawing, posed.color)
            yield Shown(posed.color.stamp_ns, posed.source_from_camera, self.convention.of_matrix, images)

        return shown

    def _images(self, drawing: Drawing, color: Shot) -> Images:
        return drawing(color_file(self.reader.message(color, self.choice.color)), color.stamp_ns, 0)


@dataclass(frozen=True)
class Around:
    """Sweeps of a lidar without a camera, in views around it."""

    reader: Reader
    choice: Chosen
    rules: Rules
    views: Sequence[np.ndarray]

    def begin(self, motions: Motions) -> Shower:
        """What makes frames of one stream: of the sweeps between which the lidar has moved, turned or waited enough."""
        last: list[Posed] = []

        def shown(posed: Posed) -> Iterator[Shown]:
            pair = [*last, posed]
            if looked_at([one.color.stamp_ns for one in pair], [one.source_from_camera for one in pair])[-1] != len(
                last
            ):
                return
            last[:] = [posed]
            lidar = lidar_of(self.reader, self.choice, self.rules, motions, posed.depth)
            for number, lidar_from_view in enumerate(self.views):
                stamp_ns, world_from_lidar = posed.color.stamp_ns + number * VIEW_STEP_NS, posed.source_from_camera
                images = partial(_view, lidar, world_from_lidar @ lidar_from_view)
                yield Shown(stamp_ns, world_from_lidar, partial(_seen_from, lidar_from_view), images)

        return shown


def lidar_of(reader: Reader, choice: Chosen, rules: Rules, motions: Motions, cloud: Shot) -> Lidar:
    """One sweep, and where its lidar was meanwhile."""
    way = rules.cloud_way or rules.way

    def world_from_lidar(stamp_ns: int) -> np.ndarray:
        return motions.at(way, stamp_ns, rules.pose_within_ns)

    return Lidar([cloud.stamp_ns], lambda _: reader.sweep(cloud, choice.depth), world_from_lidar)


def _seen_from(lidar_from_view: np.ndarray, world_from_lidar: np.ndarray) -> np.ndarray:
    return world_from_lidar @ lidar_from_view


def _view(lidar: Lidar, world_from_view: np.ndarray) -> Images:
    return Images(None, dense(transform(inverse(world_from_view), lidar.points_world(0)), VIEW, None))
