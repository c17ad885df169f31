"""Frames of a running robot's RGB-D camera."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.core.ros.assembly import Posed
from prior_sg.services.ingest.core.ros.motions import Motions
from prior_sg.services.ingest.core.ros.topics import Chosen
from prior_sg.services.ingest.sources.base import Images
from prior_sg.services.ingest.sources.clouds.live import Shower, Shown
from prior_sg.services.ingest.sources.ros.pictures import Pictures
from prior_sg.services.ingest.sources.ros.reader import Reader


@dataclass(frozen=True)
class Rgbd:
    """Reads pairs of images."""

    reader: Reader
    choice: Chosen
    pictures: Pictures
    convention: Convention

    def begin(self, motions: Motions) -> Shower:
        """What makes frames of one stream; their poses are already known."""

        def shown(posed: Posed) -> Iterator[Shown]:
            images = partial(self._images, posed)
            yield Shown(posed.color.stamp_ns, posed.source_from_camera, self.convention.of_matrix, images)

        return shown

    def _images(self, posed: Posed) -> Images:
        color = self.reader.message(posed.color, self.choice.color)
        return self.pictures(color, self.reader.message(posed.depth, self.choice.depth))
