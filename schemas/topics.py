"""The one table of keys: topics, queries and jobs. Nothing else in the system names a key.

Delivery is one word:

- `latest`: a slow reader skips to the newest sample; what it skipped is counted.
- `every`: nothing may be lost: publisher cache, history for late readers, recovery of missed samples. A reader that
  finds a gap in the revisions asks the writer for a snapshot.
- `job`: each message goes to one worker of a pool, at least once; results are idempotent.

So is priority, which counts where a link is slower than what is sent: `now` overtakes `soon`, which overtakes `data`,
which overtakes `bulk`. No topic of `every` is `bulk`: Zenoh counts its samples by messages of `data`, which must not
overtake them. What may be sent on a key is bounded as well, far above what any service writes.
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
KB, MB = 2**10, 2**20
LARGEST = 256 * MB  # bytes of any message; a larger one is not put together by routers and clients
BURST_S = 10.0  # for how long a writer may send twice what it may send for ever
Delivery = Literal["latest", "every", "job"]
Priority = Literal["now", "soon", "data", "bulk"]


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
    priority: Priority = "data"
    most_bytes: int = 64 * MB  # of one message
    most_hz: float = 300  # on one key, for ever
    beyond_hz: float = 0  # at most, over a thin link; 0 = all
    rises: tuple[str, ...] = ()  # fields that are higher in each message of a writer than in the one before

    @property
    def most_at_once(self) -> int:
        """Messages on one key that may come at once: what is kept for late readers, or what a link has held up."""
        return int(max(2 * self.cache, BURST_S * self.most_hz))

    def key_of(self, message: Message) -> str:
        """The key this message is published on. Raises ValueError where a field cannot be part of one."""
        fields = {"robot": getattr(message, "robot", ""), "question": getattr(message, "question", "")}
        if "{digest}" in self.key:
            fields["digest"] = message.digest()  # type: ignore[attr-defined]
        return self.key.format(**{name: key_part(text) for name, text in fields.items() if f"{{{name}}}" in self.key})

    def fault_of(self, key: str, message: Message) -> str:
        """Why this message has no business on the key it came on, as a sentence; empty when it belongs there."""
        return _fault_of(key, lambda: self.key_of(message))

    def budget_key(self, key: str) -> str:
        """What the rate of messages on a key counts for: the key, or the topic where keys tell no robots apart."""
        return key if "{robot}" in self.key else self.name

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
    priority: Priority = "soon"
    most_bytes: int = 256 * KB  # of a request
    most_reply_bytes: int = 64 * MB

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


DELTA = ("epoch", "revision")
KEYFRAME = Topic(
    "KEYFRAME", Keyframe, f"{ROOT}/{{robot}}/keyframe", "every", 2, recorded=True, cache=32,
    rises=("frame_id",),
)  # fmt: skip
POSE_UPDATE = Topic(
    "POSE_UPDATE", PoseUpdate, f"{ROOT}/{{robot}}/pose_update", "every", 0.01, recorded=True, cache=16,
    priority="soon", most_hz=30, rises=DELTA,
)  # fmt: skip
CAMERA_STATE = Topic(
    "CAMERA_STATE", CameraState, f"{ROOT}/{{robot}}/camera", "latest", 30, recorded=False,
    priority="now", most_bytes=16 * KB, most_hz=1000, beyond_hz=5,
)  # fmt: skip
INGEST_STATE = Topic(
    "INGEST_STATE", IngestState, f"{ROOT}/{{robot}}/ingest", "latest", 5, recorded=False,
    priority="now", most_bytes=MB, beyond_hz=2,
)  # fmt: skip
PLACE_DELTA = Topic(
    "PLACE_DELTA", PlaceDelta, f"{ROOT}/{{robot}}/places", "every", 2, recorded=True, cache=256, rises=DELTA
)
ENCODE = Topic("ENCODE", Keyframe, f"{ROOT}/jobs/encode", "job", 2, recorded=False, priority="bulk")
PYRAMID = Topic("PYRAMID", Pyramid, f"{ROOT}/{{robot}}/pyramid", "every", 2, recorded=True, cache=256)
DETECTIONS = Topic("DETECTIONS", Detections, f"{ROOT}/{{robot}}/detections", "every", 2, recorded=True, cache=256)
BACKFILL = Topic(
    "BACKFILL", Backfill, f"{ROOT}/{{robot}}/backfill", "every", 0.01, recorded=True, cache=4,
    priority="soon", most_bytes=4 * MB, most_hz=30,
)  # fmt: skip
TASK = Topic(
    "TASK", Task, f"{ROOT}/{{robot}}/task", "every", 0.01, recorded=True, cache=4,
    priority="soon", most_bytes=MB, most_hz=10, rises=("stamp_ns",),
)  # fmt: skip
PRIOR = Topic(
    "PRIOR", Prior, f"{ROOT}/fleet/prior/{{digest}}", "every", 0.01, recorded=True, cache=4,
    priority="soon", most_bytes=16 * MB, most_hz=30,
)  # fmt: skip
PRIOR_CLAIM = Topic(
    "PRIOR_CLAIM", PriorClaim, f"{ROOT}/fleet/prior_claim/{{question}}", "every", 0.1, recorded=True, cache=4,
    priority="soon", most_bytes=64 * KB, most_hz=30,
)  # fmt: skip
PRIOR_EVIDENCE = Topic(
    "PRIOR_EVIDENCE", PriorEvidence, f"{ROOT}/{{robot}}/prior_evidence", "every", 0.05, recorded=True, cache=4,
    most_bytes=16 * MB, most_hz=30,
)  # fmt: skip
PRIOR_REVISION = Topic(
    "PRIOR_REVISION", PriorRevision, f"{ROOT}/fleet/prior_revision", "every", 0.001, recorded=True, cache=1,
    priority="soon", most_bytes=16 * MB, most_hz=10,
)  # fmt: skip
REGION_DELTA = Topic(
    "REGION_DELTA", RegionDelta, f"{ROOT}/{{robot}}/regions", "every", 2, recorded=True, cache=256, rises=DELTA
)
OBJECT_DELTA = Topic(
    "OBJECT_DELTA", ObjectDelta, f"{ROOT}/{{robot}}/objects", "every", 1, recorded=True, cache=256, rises=DELTA
)
SCENE_REVISION = Topic(
    "SCENE_REVISION", SceneRevision, f"{ROOT}/{{robot}}/scene", "latest", 4, recorded=False,
    priority="now", most_bytes=MB, beyond_hz=2,
)  # fmt: skip
JOURNAL = Topic(
    "JOURNAL", Consumed, f"{ROOT}/{{robot}}/journal", "every", 20, recorded=True, cache=1024,
    most_bytes=LARGEST, most_hz=5000,
)  # fmt: skip

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


ARCHIVE = Query(
    "ARCHIVE", ArchiveRequest, ArchiveReply, f"{ROOT}/{{robot}}/ask/keyframes", "bulk", most_reply_bytes=LARGEST
)
PLACE_SNAPSHOT = Query("PLACE_SNAPSHOT", SnapshotRequest, PlaceDelta, f"{ROOT}/{{robot}}/ask/places", "data")
VOXEL_MAP = Query("VOXEL_MAP", MapRequest, VoxelMap, f"{ROOT}/{{robot}}/ask/voxels", "bulk", most_reply_bytes=LARGEST)
REGION_SNAPSHOT = Query("REGION_SNAPSHOT", SnapshotRequest, RegionDelta, f"{ROOT}/{{robot}}/ask/regions", "data")
OBJECT_SNAPSHOT = Query("OBJECT_SNAPSHOT", SnapshotRequest, ObjectDelta, f"{ROOT}/{{robot}}/ask/objects", "data")
POSTERIOR = Query("POSTERIOR", PosteriorRequest, PosteriorReply, f"{ROOT}/{{robot}}/ask/posterior")
TASK_IN_FORCE = Query("TASK_IN_FORCE", TaskRequest, TaskInForce, f"{ROOT}/{{robot}}/ask/task")
SCENE = Query("SCENE", SceneRequest, Scene, f"{ROOT}/{{robot}}/ask/scene", "data", most_reply_bytes=LARGEST)
HISTORY = Query("HISTORY", HistoryRequest, RevisionList, f"{ROOT}/{{robot}}/ask/history")
SCENE_QUERY = Query("SCENE_QUERY", SceneQuery, SceneAnswer, f"{ROOT}/{{robot}}/ask/query")
TEXT = Query("TEXT", TextRequest, TextEmbeddings, f"{ROOT}/encoder/{{space}}/text", most_bytes=4 * MB)
EPOCH = Query("EPOCH", EpochRequest, EpochKnown, f"{ROOT}/{{robot}}/ask/epoch/{{topic}}/{{keeper}}")
PRIORS = Query("PRIORS", PriorRequest, PriorList, f"{ROOT}/fleet/ask/prior")
EVIDENCE = Query("EVIDENCE", EvidenceRequest, Evidence, f"{ROOT}/{{robot}}/ask/evidence", "bulk")

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
YIELD = Query("YIELD", YieldRequest, Bequest, f"{ROOT}/{{robot}}/yield", most_reply_bytes=LARGEST)
SWAP = Query("SWAP", SwapRequest, Swapped, f"{ROOT}/fleet/swap", most_bytes=MB)


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
_CALLS: tuple[tuple[re.Pattern[str], Query | Topic], ...] = (
    *((re.compile(_FIELD.sub(".+", re.escape(q.key))), q) for q in QUERIES),
    *((re.compile(f"{_FIELD.sub('.+', re.escape(q.key))}/.+"), q) for q in (STATUS, YIELD, SWAP)),
    *((re.compile(f"{topic.key}/run/.+"), topic) for topic in TOPICS if topic.delivery == "job"),
)


def called_on(key: str) -> Query | Topic | None:
    """The question asked, or the job given, on this key or key expression; None = neither of the table."""
    return next((called for pattern, called in _CALLS if pattern.fullmatch(key)), None)


def called_with(key: str) -> tuple[type[Message] | None, type[Message] | None]:
    """Types of request and reply of a call on this key or key expression; None = not a message of the table."""
    match called_on(key):
        case Query() as query:
            return query.request, query.reply
        case Topic() as job:
            return job.type, None
        case _:
            return None, None


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
