"""The one table of keys: topics, queries and jobs. Nothing else in the system names a key.

Delivery is one word:

- `latest`: a slow reader skips to the newest sample; what it skipped is counted.
- `every`: nothing may be lost: publisher cache, history for late readers, recovery of missed samples. A reader that
  finds a gap in the revisions asks the writer for a snapshot.
- `job`: each message goes to one worker of a pool, at least once; results are idempotent.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from prior_sg.schemas.codec import Message, prepare
from prior_sg.schemas.features import Backfill, Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import ArchiveReply, ArchiveRequest, CameraState, IngestState, Keyframe, PoseUpdate
from prior_sg.schemas.names import key_part
from prior_sg.schemas.objects import Detections, ObjectDelta
from prior_sg.schemas.places import MapRequest, PlaceDelta, SnapshotRequest, VoxelMap
from prior_sg.schemas.priors import (
    Prior,
    PriorClaim,
    PriorEvidence,
    PriorList,
    PriorRequest,
    PriorRevision,
    Task,
    TaskInForce,
    TaskRequest,
)
from prior_sg.schemas.queries import SceneAnswer, SceneQuery
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest, RegionDelta
from prior_sg.schemas.scene import HistoryRequest, RevisionList, Scene, SceneRequest, SceneRevision
from prior_sg.schemas.status import Consumed, EpochKnown, EpochRequest, ServiceStatus, StatusRequest
from prior_sg.schemas.succession import Bequest, Evidence, EvidenceRequest, Swapped, SwapRequest, YieldRequest

prepare()  # every process imports this table before it opens a bus, whose threads then find all decoders built

ROOT = "psg"
WAITING = "0"  # in place of an epoch
FLEET = "fleet"  # in place of a robot
Delivery = Literal["latest", "every", "job"]


@dataclass(frozen=True)
class Topic:
    """One row of the table. `key` may hold {robot}, {digest} or {question}, taken from the message."""

    name: str
    type: type[Message]
    key: str
    delivery: Delivery
    rate_hz: float  # typical
    recorded: bool
    cache: int = 0  # samples a publisher keeps for late and lossy readers (`every`)

    def key_of(self, message: Message) -> str:
        """The key this message is published on. Raises ValueError where a field cannot be part of one."""
        fields = {"robot": getattr(message, "robot", ""), "question": getattr(message, "question", "")}
        if "{digest}" in self.key:
            fields["digest"] = message.digest()  # type: ignore[attr-defined]
        return self.key.format(**{name: key_part(text) for name, text in fields.items() if f"{{{name}}}" in self.key})

    def fault_of(self, key: str, message: Message) -> str:
        """Why this message has no business on the key it came on, as a sentence; empty when it belongs there."""
        return _fault_of(key, lambda: self.key_of(message))

    def pattern(self, robot: str) -> str:
        """The key expression that matches this topic of `robot` (`*` = of all robots)."""
        return self.key.format(robot=robot, digest="*", question="*")


@dataclass(frozen=True)
class Query:
    """A question with one answer. `key` may hold fields of the request, such as {robot} or {space}."""

    name: str
    request: type[Message]
    reply: type[Message]
    key: str

    def key_of(self, request: Message) -> str:
        """The key this request is asked on. Raises ValueError where a field cannot be part of one."""
        fields = {name: getattr(request, name) for name in request.__struct_fields__ if f"{{{name}}}" in self.key}
        return self.key.format(**{name: "/".join(map(key_part, text.split("/"))) for name, text in fields.items()})

    def fault_of(self, key: str, request: Message) -> str:
        """Why this request has no business on the key it came on, as a sentence; empty when it belongs there."""
        return _fault_of(key, lambda: self.key_of(request))


def _fault_of(key: str, own_key: Callable[[], str]) -> str:
    try:
        own = own_key()
    except ValueError as error:
        return str(error)
    return "" if key == own else f"it came on {key} and says it belongs on {own}"


KEYFRAME = Topic("KEYFRAME", Keyframe, f"{ROOT}/{{robot}}/keyframe", "every", 2, recorded=True, cache=32)
POSE_UPDATE = Topic("POSE_UPDATE", PoseUpdate, f"{ROOT}/{{robot}}/pose_update", "every", 0.01, recorded=True, cache=16)
CAMERA_STATE = Topic("CAMERA_STATE", CameraState, f"{ROOT}/{{robot}}/camera", "latest", 30, recorded=False)
INGEST_STATE = Topic("INGEST_STATE", IngestState, f"{ROOT}/{{robot}}/ingest", "latest", 5, recorded=False)
PLACE_DELTA = Topic("PLACE_DELTA", PlaceDelta, f"{ROOT}/{{robot}}/places", "every", 2, recorded=True, cache=256)
ENCODE = Topic("ENCODE", Keyframe, f"{ROOT}/jobs/encode", "job", 2, recorded=False)
PYRAMID = Topic("PYRAMID", Pyramid, f"{ROOT}/{{robot}}/pyramid", "every", 2, recorded=True, cache=256)
DETECTIONS = Topic("DETECTIONS", Detections, f"{ROOT}/{{robot}}/detections", "every", 2, recorded=True, cache=256)
BACKFILL = Topic("BACKFILL", Backfill, f"{ROOT}/{{robot}}/backfill", "every", 0.01, recorded=True, cache=4)
TASK = Topic("TASK", Task, f"{ROOT}/{{robot}}/task", "every", 0.01, recorded=True, cache=4)
PRIOR = Topic("PRIOR", Prior, f"{ROOT}/fleet/prior/{{digest}}", "every", 0.01, recorded=True, cache=4)
PRIOR_CLAIM = Topic(
    "PRIOR_CLAIM", PriorClaim, f"{ROOT}/fleet/prior_claim/{{question}}", "every", 0.1, recorded=True, cache=4
)
PRIOR_EVIDENCE = Topic(
    "PRIOR_EVIDENCE", PriorEvidence, f"{ROOT}/{{robot}}/prior_evidence", "every", 0.05, recorded=True, cache=4
)
PRIOR_REVISION = Topic(
    "PRIOR_REVISION", PriorRevision, f"{ROOT}/fleet/prior_revision", "every", 0.001, recorded=True, cache=1
)
REGION_DELTA = Topic("REGION_DELTA", RegionDelta, f"{ROOT}/{{robot}}/regions", "every", 2, recorded=True, cache=256)
OBJECT_DELTA = Topic("OBJECT_DELTA", ObjectDelta, f"{ROOT}/{{robot}}/objects", "every", 1, recorded=True, cache=256)
SCENE_REVISION = Topic("SCENE_REVISION", SceneRevision, f"{ROOT}/{{robot}}/scene", "latest", 4, recorded=False)
JOURNAL = Topic("JOURNAL", Consumed, f"{ROOT}/{{robot}}/journal", "every", 20, recorded=True, cache=1024)

TOPICS = (
    KEYFRAME,
    POSE_UPDATE,
    CAMERA_STATE,
    INGEST_STATE,
    PLACE_DELTA,
    ENCODE,
    PYRAMID,
    DETECTIONS,
    BACKFILL,
    TASK,
    PRIOR,
    PRIOR_CLAIM,
    PRIOR_EVIDENCE,
    PRIOR_REVISION,
    REGION_DELTA,
    OBJECT_DELTA,
    SCENE_REVISION,
    JOURNAL,
)

DELTAS = tuple(topic for topic in TOPICS if {"epoch", "revision", "snapshot"} <= {*topic.type.__struct_fields__})

_TOPIC_OF = {topic.type: topic for topic in TOPICS if topic.delivery != "job"}


def topic_of(message_type: type[Message]) -> Topic | None:
    """The topic on which messages of this type are published; None of those that are only asked, answered or fed."""
    return _TOPIC_OF.get(message_type)


ARCHIVE = Query("ARCHIVE", ArchiveRequest, ArchiveReply, f"{ROOT}/{{robot}}/ask/keyframes")
PLACE_SNAPSHOT = Query("PLACE_SNAPSHOT", SnapshotRequest, PlaceDelta, f"{ROOT}/{{robot}}/ask/places")
VOXEL_MAP = Query("VOXEL_MAP", MapRequest, VoxelMap, f"{ROOT}/{{robot}}/ask/voxels")
REGION_SNAPSHOT = Query("REGION_SNAPSHOT", SnapshotRequest, RegionDelta, f"{ROOT}/{{robot}}/ask/regions")
OBJECT_SNAPSHOT = Query("OBJECT_SNAPSHOT", SnapshotRequest, ObjectDelta, f"{ROOT}/{{robot}}/ask/objects")
POSTERIOR = Query("POSTERIOR", PosteriorRequest, PosteriorReply, f"{ROOT}/{{robot}}/ask/posterior")
TASK_IN_FORCE = Query("TASK_IN_FORCE", TaskRequest, TaskInForce, f"{ROOT}/{{robot}}/ask/task")
SCENE = Query("SCENE", SceneRequest, Scene, f"{ROOT}/{{robot}}/ask/scene")
HISTORY = Query("HISTORY", HistoryRequest, RevisionList, f"{ROOT}/{{robot}}/ask/history")
SCENE_QUERY = Query("SCENE_QUERY", SceneQuery, SceneAnswer, f"{ROOT}/{{robot}}/ask/query")
TEXT = Query("TEXT", TextRequest, TextEmbeddings, f"{ROOT}/encoder/{{space}}/text")
EPOCH = Query("EPOCH", EpochRequest, EpochKnown, f"{ROOT}/{{robot}}/ask/epoch/{{topic}}/{{keeper}}")
PRIORS = Query("PRIORS", PriorRequest, PriorList, f"{ROOT}/fleet/ask/prior")
EVIDENCE = Query("EVIDENCE", EvidenceRequest, Evidence, f"{ROOT}/{{robot}}/ask/evidence")

QUERIES = (
    ARCHIVE,
    PLACE_SNAPSHOT,
    VOXEL_MAP,
    REGION_SNAPSHOT,
    OBJECT_SNAPSHOT,
    POSTERIOR,
    TASK_IN_FORCE,
    SCENE,
    HISTORY,
    SCENE_QUERY,
    TEXT,
    EPOCH,
    PRIORS,
    EVIDENCE,
)

STATUS = Query("STATUS", StatusRequest, ServiceStatus, f"{ROOT}/status")
YIELD = Query("YIELD", YieldRequest, Bequest, f"{ROOT}/{{robot}}/yield")
SWAP = Query("SWAP", SwapRequest, Swapped, f"{ROOT}/fleet/swap")


def alive_key(service: str, instance: str) -> str:
    """Liveliness token of one process."""
    return f"{ROOT}/alive/{service}/{instance}"


def lease_key(robot: str, service: str, epoch: str, instance: str) -> str:
    """Liveliness token of a process that is in charge of a robot's service, or, with `WAITING` as epoch, would be."""
    return f"{ROOT}/{robot}/lease/{service}/{epoch}/{instance}"


def roll_key(service: str, instance: str, pid: str) -> str:
    """Liveliness token of who started a process, for as long as that process exists."""
    return f"{ROOT}/alive/roll/{service}/{instance}/{pid}"


def status_key(service: str, instance: str) -> str:
    """Where one process answers STATUS."""
    return f"{STATUS.key}/{service}/{instance}"


def yield_key(robot: str, service: str, instance: str) -> str:
    """Where one process is asked to yield; `fleet` as robot, where it serves that."""
    return f"{YIELD.key.format(robot=robot)}/{service}/{instance}"


def swap_key(service: str, instance: str) -> str:
    """Where who started a process is asked to exchange it."""
    return f"{SWAP.key}/{service}/{instance}"


_FIELD = re.compile(r"\\{\w+\\}")  # as `re.escape` leaves it
_CALLS: tuple[tuple[re.Pattern[str], type[Message], type[Message] | None], ...] = (
    *((re.compile(_FIELD.sub(".+", re.escape(q.key))), q.request, q.reply) for q in QUERIES),
    *((re.compile(f"{_FIELD.sub('.+', re.escape(q.key))}/.+"), q.request, q.reply) for q in (STATUS, YIELD, SWAP)),
    *((re.compile(f"{topic.key}/run/.+"), topic.type, None) for topic in TOPICS if topic.delivery == "job"),
)


def called_with(key: str) -> tuple[type[Message] | None, type[Message] | None]:
    """Types of request and reply of a call on this key or key expression; None = not a message of the table."""
    return next(((request, reply) for pattern, request, reply in _CALLS if pattern.fullmatch(key)), (None, None))


def worker_keys(job: Topic, worker: str, group: str = "") -> tuple[str, str]:
    """The queryable and the liveliness token of one worker of a job's pool; `*` as worker gives the patterns.

    A worker answers on `queryable/*`, whose last part is the robot that gives the job (`job_key`). The token also names
    the worker's group: workers of one group do the same work, each job goes to one of each group.
    """
    return f"{job.key}/run/{worker}", "/".join((f"{job.key}/live/{worker}", *([group] if group else [])))


def job_key(job: Topic, worker: str, robot: str) -> str:
    """Where a robot (`*` = any) gives a job to a worker."""
    return f"{worker_keys(job, worker)[0]}/{robot}"


def fault_of_job(job: Topic, key: str, message: Message) -> str:
    """Why this job has no business on the key it came on, as a sentence; empty when it belongs there."""
    robot = getattr(message, "robot", "")
    return "" if key.rpartition("/")[2] == robot else f"it came on {key} and is of the robot {robot!r}"
