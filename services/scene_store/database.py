"""The scene graphs of all robots as events in one database; each is one transaction, with the index over the present.

A graph is the nearest snapshot and the events after it; nothing else is the truth. A process killed at any moment
leaves the state before or after an event, never between.
"""

import contextlib
import gc
import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import zstandard

from prior_sg.schemas.codec import DecodeError, M, Message, decode, encode
from prior_sg.schemas.migrations import current
from prior_sg.schemas.names import fault_of_robot
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior, Task
from prior_sg.schemas.scene import StoredRevision
from prior_sg.services.scene_store.core import events, keeping
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.core.image import GraphImage, graph_of, image_of
from prior_sg.services.scene_store.storage import open_storage
from prior_sg.services.scene_store.storage.tables import (
    LAST,
    Found,
    Indexed,
    Point,
    Record,
    StoreError,
)
from prior_sg.services.scene_store.storage.writing import SNAPSHOT, compressed, index, record_of

log = logging.getLogger(__name__)


@dataclass
class Standing:
    """Where the history of one robot stands."""

    key: int
    sequence: int = 0  # of its last event
    snapshot: keeping.Mark = keeping.NO_MARK  # its last one
    snapshot_bytes: int = 0
    weight: int = 0  # of the events since


@dataclass
class Past:
    """A graph as it was, and the last event in it."""

    robot: str
    graph: core.Graph
    sequence: int


class Database:
    """One open scene database; `session` is the life of the store that writes. Raises StoreError, ExtraMissing."""

    def __init__(self, cfg: Config, session: int = 0, *, read_only: bool = False) -> None:
        self._cfg, self._session = cfg, session
        self.storage = open_storage(cfg, read_only=read_only)
        self._standings: dict[str, Standing] = {}
        self._past: Past | None = None

    def robots(self) -> list[str]:
        """Every robot that something is kept of, by name."""
        return sorted(name for name in self.storage.robots() if not fault_of_robot(name))

    def graphs(self) -> dict[str, core.Graph]:
        """Every robot's graph as of the last commit, by robot."""
        keys = self.storage.robots()
        usable = {name: key for name, key in keys.items() if not fault_of_robot(name)}
        if odd := keys.keys() - usable.keys():
            log.warning("robots whose names cannot be used are left out", extra={"robots": sorted(map(ascii, odd))})
        return {name: self._present(name, key) for name, key in usable.items()}

    def _present(self, robot: str, key: int) -> core.Graph:
        standing = self._standings[robot] = Standing(key)
        past = Past(robot, core.Graph(robot), 0)
        if marks := self.storage.marks(key):
            standing.snapshot = marks[-1]
            past, standing.snapshot_bytes = self._from_snapshot(robot, key, marks[-1].revision)
        standing.weight = self._replay(past, key, LAST)
        standing.sequence = past.sequence
        return past.graph

    def put(self, graph: core.Graph, changes: core.Changes, delta: Message) -> None:
        """Make one applied delta durable, and a snapshot when it is overdue."""
        kind = events.kind_of(delta)
        self._add(graph, kind, delta, changes)
        standing = self._standings[graph.robot]
        if keeping.due(standing.weight, standing.snapshot_bytes, waited=True):
            self._keep_snapshot(standing, graph)

    def put_cameras(self, graph: core.Graph, delta: PlaceDelta) -> None:
        """Keep the camera centres of a delta that itself is not applied."""
        self._add(graph, "camera", events.cameras_of(delta))

    def put_task(self, graph: core.Graph, task: Task) -> None:
        """Keep a task of a robot."""
        self._add(graph, "task", task)

    def put_prior(self, prior: Prior) -> None:
        """Keep a prior under its digest."""
        told = (prior.environment, prior.task, prior.provenance.source)
        self.storage.put_prior(prior.digest(), told, encode(prior))

    def prior(self, digest: str) -> Prior | None:
        """The prior of a digest; None where it is not kept, or not in a form that this version reads."""
        message = self.storage.prior(digest)
        if message is not None:
            with contextlib.suppress(DecodeError):
                return decode(Prior, message)
        return None

    def rest(self, graphs: Iterable[core.Graph]) -> None:
        """Between deltas: take the snapshots that are due, thin out old history, tidy up."""
        for graph in graphs:
            standing = self._standings.get(graph.robot)
            if standing is None or graph.revision <= standing.snapshot.revision:
                continue
            timely = keeping.sampled(self._cfg, standing.snapshot.stamp_ns, core.stamp_ns(graph))
            if timely or keeping.due(standing.weight, standing.snapshot_bytes, waited=False):
                self._keep_snapshot(standing, graph)
        self.storage.checkpoint()

    def at(self, robot: str, revision: int | None = None, stamp_ns: int | None = None) -> core.Graph | None:
        """A robot's graph as it was at the newest revision that is kept and beyond neither limit; it belongs to this
        object until the next call. None when there is no such revision.
        """
        key = self.storage.robots().get(robot)
        if key is None:
            return None
        wanted = self.storage.revision_at(key, *(LAST if limit is None else limit for limit in (revision, stamp_ns)))
        if wanted is None:
            return None
        self._past = self._nearest_past(robot, key, wanted)
        self._replay(self._past, key, wanted)
        return self._past.graph

    def _nearest_past(self, robot: str, key: int, revision: int) -> Past:
        """The last graph that was asked for or the last snapshot, whichever needs fewer events."""
        before = [mark.sequence for mark in self.storage.marks(key) if mark.revision <= revision]
        snapshot, past = max(before, default=0), self._past
        if past and past.robot == robot and past.sequence >= snapshot and past.graph.revision <= revision:
            return past
        return self._from_snapshot(robot, key, revision)[0] if before else Past(robot, core.Graph(robot), 0)

    def _from_snapshot(self, robot: str, key: int, revision: int) -> tuple[Past, int]:
        """The graph of the last snapshot that is not beyond a revision, and the bytes of that snapshot."""
        record = self.storage.snapshot(key, revision)
        if record is None:
            raise StoreError(f"{self.storage.location}: its history is being thinned out; ask again")
        with _many_made():
            graph = graph_of(self._read(GraphImage, record))
        return Past(robot, graph, record.sequence), len(record.payload)

    def _replay(self, past: Past, key: int, revision: int) -> int:
        """Apply the events that follow, up to a revision; what they weigh."""
        weight = 0
        for record in self.storage.events(key, past.sequence, revision):
            if record.sequence != past.sequence + 1:
                raise StoreError(f"{self.storage.location}: events of {past.robot} are missing; ask again")
            applied = events.APPLY.get(record.kind)  # type: ignore[call-overload]
            if applied is None:
                raise StoreError(f"{self.storage.location} holds an event of unknown kind; choose another path.")
            applied.apply(past.graph, self._read(applied.message, record))
            past.sequence = record.sequence
            weight += keeping.EVENT_WEIGHT + len(record.payload)
        return weight

    def _read(self, kind: type[M], record: Record) -> M:
        try:
            return decode(kind, current(kind, zstandard.decompress(record.payload), record.schema))
        except (DecodeError, zstandard.ZstdError) as error:
            raise StoreError(
                f"{self.storage.location} holds an event that cannot be read ({error}); choose another path."
            ) from error

    def forget(self) -> None:
        """Let go of the graph that was asked for last, from which later ones are reached faster."""
        self._past = None

    def history(self, robot: str, limit: int = 1000, before: int | None = None) -> list[StoredRevision]:
        """The newest revisions of a robot that are kept, of those below `before`, oldest first."""
        key = self.storage.robots().get(robot)
        return [] if key is None else self.storage.revisions(key, limit, LAST if before is None else before)

    def nearest(self, robot: str, kind: Indexed, point_m: Point, count: int) -> list[Found]:
        """Places or objects of the present by the distance of their centres from a point, closest first."""
        return self.storage.nearest(self.storage.robots().get(robot, -1), kind, point_m, count)

    def overlapping(self, robot: str, kind: Indexed, min_m: Point, max_m: Point) -> list[Found]:
        """Places or objects of the present whose boxes overlap one, by id; a place's box is that of its sphere."""
        return self.storage.overlapping(self.storage.robots().get(robot, -1), kind, min_m, max_m)

    def labelled(self, robot: str, kind: Indexed, text: str) -> list[Found]:
        """Regions or objects of the present whose label has words that begin with each of these, by label and id."""
        return self.storage.labelled(self.storage.robots().get(robot, -1), kind, text)

    def close(self) -> None:
        """Let go of the database."""
        self.storage.close()

    def _add(self, graph: core.Graph, kind: events.Kind, message: Message, changes: core.Changes | None = None) -> None:
        known = self._standings.get(graph.robot)
        payload = compressed(message)
        with self.storage.transaction():
            standing = known or Standing(self.storage.robot_key(graph.robot))
            record = record_of(
                graph, message, payload, sequence=standing.sequence + 1, session=self._session, kind=kind
            )
            self.storage.add("events", standing.key, record)
            if changes is not None:
                index(self.storage, standing.key, graph, kind, changes)  # type: ignore[arg-type]
        standing.sequence += 1
        standing.weight += keeping.EVENT_WEIGHT + len(payload)
        self._standings[graph.robot] = standing

    def _keep_snapshot(self, standing: Standing, graph: core.Graph) -> None:
        """A snapshot of the present, and what it makes superfluous goes."""
        image = image_of(graph)
        payload = compressed(image)
        record = record_of(graph, image, payload, sequence=standing.sequence, session=self._session, kind=SNAPSHOT)
        mark = keeping.Mark(record.sequence, record.revision, record.session, record.stamp_ns)
        with self.storage.transaction():
            self.storage.add("snapshots", standing.key, record)
            if gone := keeping.thinned(self._cfg, self.storage.marks(standing.key), graph.revision):
                self.storage.thin(standing.key, gone)
        standing.snapshot, standing.snapshot_bytes, standing.weight = mark, len(payload), 0


@contextlib.contextmanager
def _many_made() -> Iterator[None]:
    """No search for garbage: among so many new objects that all stay it takes three times as long as making them."""
    searching = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if searching:
            gc.enable()
