"""The only list of services."""

from typing import Any

from prior_sg.schemas.topics import DELTAS, OBJECT_DELTA, POSE_UPDATE, PRIOR_REVISION, TASK, Topic
from prior_sg.services.feature_pyramid.service import SERVICE as FEATURE_PYRAMID
from prior_sg.services.ingest.service import SERVICE as INGEST
from prior_sg.services.place_graph.service import SERVICE as PLACE_GRAPH
from prior_sg.services.prior_gateway.service import SERVICE as PRIOR_GATEWAY
from prior_sg.services.runtime.service import Service
from prior_sg.services.scene_store.service import SERVICE as SCENE_STORE
from prior_sg.services.segmenter.service import SERVICE as SEGMENTER

SERVICES: tuple[Service[Any, Any], ...] = (INGEST, PLACE_GRAPH, FEATURE_PYRAMID, PRIOR_GATEWAY, SEGMENTER, SCENE_STORE)

# Topics that people and their programs write or read, through the command line.
OPERATOR_WRITES: tuple[Topic, ...] = (TASK, POSE_UPDATE, PRIOR_REVISION)

# Services of which each robot has one writer at a time, by the topics whose deltas their readers follow.
LEASED: dict[str, str] = {
    topic.name: service.name
    for service in SERVICES
    if service.scope == "robot"
    for topic in service.writes
    if topic in DELTAS
}

# Whose numbers bound those of a topic: the bridge to Hydra, which has the lease of the places, writes objects as well.
WRITERS: dict[str, tuple[str, ...]] = {name: (service,) for name, service in LEASED.items()} | {
    OBJECT_DELTA.name: (SEGMENTER.name, PLACE_GRAPH.name)
}

BY_NAME: dict[str, Service[Any, Any]] = {service.name: service for service in SERVICES}
