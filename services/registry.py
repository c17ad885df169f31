"""All services."""

from typing import Any

from prior_sg.schemas.topics import POSE_UPDATE, PRIOR_REVISION, TASK, Topic
from prior_sg.services.roles import NAMES, declared
from prior_sg.services.runtime.service import Service

SERVICES: tuple[Service[Any, Any], ...] = tuple(map(declared, NAMES))
BY_NAME: dict[str, Service[Any, Any]] = dict(zip(NAMES, SERVICES, strict=True))

# Topics that people and their programs write or read, through the command line.
OPERATOR_WRITES: tuple[Topic, ...] = (TASK, POSE_UPDATE, PRIOR_REVISION)
