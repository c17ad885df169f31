"""Which services there are and who is in charge of what, without loading them: each takes packages that a process which
runs another does without. `registry` loads all."""

from importlib import import_module
from typing import Any

from prior_sg.schemas.topics import OBJECT_DELTA, PLACE_DELTA, REGION_DELTA
from prior_sg.services.runtime.service import Service

NAMES = ("ingest", "place_graph", "feature_pyramid", "prior_gateway", "segmenter", "scene_store")

# Services of which each robot has one writer at a time, by the topics whose deltas their readers follow.
LEASED: dict[str, str] = {
    PLACE_DELTA.name: "place_graph",
    REGION_DELTA.name: "segmenter",
    OBJECT_DELTA.name: "segmenter",
}

# Whose numbers bound those of a topic: the bridge to Hydra, which has the lease of the places, writes objects as well.
WRITERS: dict[str, tuple[str, ...]] = {name: (service,) for name, service in LEASED.items()} | {
    OBJECT_DELTA.name: ("segmenter", "place_graph")
}

# Services that follow deltas, and answer how far their epochs have come.
KEEPERS = ("segmenter", "scene_store")


def declared(name: str) -> Service[Any, Any]:
    """The declaration of one service, which loads what it needs."""
    found: Service[Any, Any] = import_module(f"prior_sg.services.{name}.service").SERVICE
    return found
