"""Rows of the tables made from messages and graphs: one event or snapshot, and the index that follows."""

from typing import Any

import zstandard

from prior_sg.schemas.codec import Message, encode, schema_name
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region
from prior_sg.services.scene_store.core import events
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core.image import image_of
from prior_sg.services.scene_store.storage.tables import Indexed, Record, Storage, without_nul, words_of

COMPRESSION = 1  # of zstandard: the fastest already halves an event
SNAPSHOT = "snapshot"


def begin(storage: Storage, robot: int, graph: core.Graph) -> None:
    """The history of a robot begins with a graph: its snapshot and its index; within a transaction."""
    image = image_of(graph)
    storage.add("snapshots", robot, record_of(graph, image, compressed(image), sequence=0, session=0, kind=SNAPSHOT))
    for kind in events.DELTAS:
        index(storage, robot, graph, kind, core.Changes(replaced=True))  # type: ignore[arg-type]


def compressed(message: Message) -> bytes:
    """A message as a payload holds it."""
    return zstandard.compress(encode(message), COMPRESSION)


def record_of(graph: core.Graph, message: Message, payload: bytes, *, sequence: int, session: int, kind: str) -> Record:
    """The row of one message, beside what the graph is after it."""
    return Record(
        sequence=sequence,
        revision=graph.revision,
        session=session,
        kind=kind,
        stamp_ns=core.stamp_ns(graph),
        places=len(graph.places),
        edges=len(graph.edges),
        regions=len(graph.regions),
        objects=len(graph.objects),
        schema=schema_name(type(message)),
        payload=payload,
    )


def index(storage: Storage, robot: int, graph: core.Graph, kind: Indexed, changes: core.Changes) -> None:
    """Bring the index over one kind of thing to what a delta of it left; within a transaction."""
    all_entries: dict[Indexed, dict[int, Any]] = {
        "place": graph.places,
        "region": graph.regions,
        "object": graph.objects,
    }
    all_touched = {"place": changes.places, "region": changes.regions, "object": changes.objects}
    entries, touched = all_entries[kind], all_touched[kind]
    if changes.replaced:
        touched = storage.indexed(robot, kind) | entries.keys()
    storage.drop_index(robot, kind, sorted(touched - entries.keys()))
    kept = sorted(touched & entries.keys())
    storage.put_index(robot, kind, [(number, *_row(entries[number])) for number in kept])


def _row(entry: core.Place | Region | SceneObject) -> tuple[Any, ...]:
    """The columns of one entry, as in INDEX."""
    if isinstance(entry, core.Place):
        return (*entry.position_m, entry.radius_m)
    named = (without_nul(entry.label), words_of(entry.label), *entry.position_m)
    if isinstance(entry, SceneObject):
        return (*named, *entry.min_m, *entry.max_m)
    return (*named, entry.place_count, entry.area_m2, entry.probability)
