"""What changes a robot's graph, as events that can be applied again in their order (pure)."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Task
from prior_sg.schemas.regions import RegionDelta
from prior_sg.services.scene_store.core import graph as core

Kind = Literal["place", "region", "object", "camera", "task"]  # the first three are deltas: each is a revision
DELTAS: tuple[Kind, ...] = ("place", "region", "object")


class Applied(NamedTuple):
    """How an event of one kind is read and applied."""

    message: type[Message]
    apply: Callable[[core.Graph, Message], object]


def _apply_places(graph: core.Graph, delta: PlaceDelta) -> None:
    core.note_cameras(graph, delta)
    core.apply_places(graph, delta)


APPLY: dict[Kind, Applied] = {
    "place": Applied(PlaceDelta, _apply_places),  # type: ignore[arg-type]
    "region": Applied(RegionDelta, core.apply_regions),  # type: ignore[arg-type]
    "object": Applied(ObjectDelta, core.apply_objects),  # type: ignore[arg-type]
    "camera": Applied(PlaceDelta, core.note_cameras),  # type: ignore[arg-type]
    "task": Applied(Task, core.set_task),  # type: ignore[arg-type]
}
_KINDS: dict[type, Kind] = {PlaceDelta: "place", RegionDelta: "region", ObjectDelta: "object", Task: "task"}


def kind_of(message: Message) -> Kind:
    """Which kind of event a message is."""
    return _KINDS[type(message)]


def cameras_of(delta: PlaceDelta) -> PlaceDelta:
    """What a place delta says of cameras and nothing else: all that one which is not applied leaves behind."""
    told = ("robot", "epoch", "revision", "stamp_ns", "frame_id", "camera_m", "past_frame_ids", "past_cameras_m")
    ids, pairs, lengths = np.zeros(0, np.int64), np.zeros((0, 2), np.int64), np.zeros(0, np.float32)
    return PlaceDelta(
        place_ids=ids,
        positions_m=np.zeros((0, 3), np.float32),
        radii_m=lengths,
        basis_points=np.zeros(0, np.int16),
        removed_ids=ids,
        merged_ids=pairs,
        edges=pairs,
        clearances_m=lengths,
        removed_edges=pairs,
        **{name: value for name, value in msgspec.structs.asdict(delta).items() if name in told},
    )
