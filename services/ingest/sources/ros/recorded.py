"""What of a recording of ROS is read when it is opened."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.topics import (
    FIXED_TRANSFORMS,
    TF_TYPES,
    Chosen,
    Topic,
)
from prior_sg.services.ingest.core.ros.transforms import Stamped, TransformTree, transforms_of
from prior_sg.services.ingest.sources.base import FrameError, SourceError
from prior_sg.services.ingest.sources.ros.bag import Bag, Index
from prior_sg.services.ingest.sources.ros.foreign import ForeignBag
from prior_sg.services.ingest.sources.ros.pictures import Rig


class Recorded:
    """What is read of a recording when it is opened: one pass over the stamps of images and over all transforms.

    Raises SourceError.
    """

    def __init__(
        self,
        bag: Bag | ForeignBag,
        options: ReadOptions,
        topics: Sequence[Topic],
        choice: Chosen,
        posing: Sequence[Topic],
    ) -> None:
        self.bag, self.options, self.choice = bag, options, choice
        self.within_ns = round(options.sync_tolerance_s * 1e9)
        self.colors, self.depths = Index(), Index()
        self.posing = [topic for topic in posing if topic.type not in TF_TYPES]
        self.poses: dict[str, list[Stamped]] = {topic.name: [] for topic in self.posing}
        self.infos: dict[str, Any] = {}
        self._tf = {topic.name: topic.taken_for == FIXED_TRANSFORMS for topic in topics if topic.type in TF_TYPES}
        self._transforms: dict[bool, list[Stamped]] = {True: [], False: []}
        self._unread: dict[str, int] = {}
        infos = [info.name for info in (choice.color_info, choice.depth_info) if info is not None]
        wanted = [*dict.fromkeys((choice.color.name, choice.depth.name, *infos, *self._tf, *self.poses))]
        self._missing = {topic.name: topic.count for topic in topics if topic.name in wanted}
        for name, received_ns, data in bag.messages(wanted):
            self._missing[name] = self._missing.get(name, 0) - 1
            try:
                self._take(name, received_ns, data)
            except FrameError:
                self._unread[name] = self._unread.get(name, 0) + 1
        self.tree = TransformTree(self._transforms[False], self._transforms[True])
        self.colors, self.depths = _sorted(self.colors), _sorted(self.depths)
        for name, index in ((choice.color.name, self.colors), (choice.depth.name, self.depths)):
            if index.stamps_ns and not any(index.stamps_ns):
                raise SourceError(f"{bag.path}: the headers of {name} have no stamps; give --clock received")

    def messages(self, color: int, depth: int) -> tuple[Any, Any]:
        """The two images of a frame, by their places. Raises FrameError."""
        return (
            self.bag.message(self.choice.color.name, self.colors, color),
            self.bag.message(self.choice.depth.name, self.depths, depth),
        )

    def rig(self) -> Rig:
        """What its pictures need."""
        stamps_ns = self.colors.stamps_ns or [0]
        middle_ns = stamps_ns[len(stamps_ns) // 2]
        return Rig(self.bag.path, self.choice, self.options, self.infos, self.tree, middle_ns, self.within_ns)

    def lost(self) -> list[str]:
        """Notes on messages that could not be read, or that the recording tells of and does not hold."""
        return [
            *(f"{count} messages of {name} cannot be read: they are left out" for name, count in self._unread.items()),
            *(
                f"{count} messages of {name} are missing, though its index counts them: a part is damaged"
                for name, count in self._missing.items()
                if count > 0
            ),
        ]

    def _take(self, name: str, received_ns: int, data: bytes) -> None:
        for topic, index in ((self.choice.color, self.colors), (self.choice.depth, self.depths)):
            if topic.name == name:
                header_ns = self.bag.stamp_ns(name, data)
                index.stamps_ns.append(received_ns if self.options.clock == "received" else header_ns)
                index.received_ns.append(received_ns)
                index.headers_ns.append(header_ns)
                return
        if name in self._tf:
            self._transforms[self._tf[name]].extend(self._stamped(name, received_ns, data))
        elif name in self.poses:
            self.poses[name].extend(self._stamped(name, received_ns, data))
        elif name not in self.infos:
            self.infos[name] = self.bag.decode(name, data)

    def _stamped(self, name: str, received_ns: int, data: bytes) -> list[Stamped]:
        found = list(transforms_of(self.bag.decode(name, data)))
        return [replace(one, stamp_ns=received_ns) for one in found] if self.options.clock == "received" else found


def _sorted(index: Index) -> Index:
    """By stamp; of images with one stamp the first."""
    first = {stamp: i for i, stamp in reversed(list(enumerate(index.stamps_ns)))}
    order = [first[stamp] for stamp in sorted(first)]
    return Index(*([values[i] for i in order] for values in (index.stamps_ns, index.received_ns, index.headers_ns)))
