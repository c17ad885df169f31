"""The scene graphs in one SQLite file: each delta is one transaction that also moves the writer's cursor.

A process killed at any moment leaves the state before or after a delta, never between: content and cursors agree.
"""

import json
import logging
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from prior_sg.schemas.codec import encode
from prior_sg.schemas.names import fault_of_robot
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.priors import Prior, Task
from prior_sg.schemas.regions import Region
from prior_sg.services.runtime.service import ServiceError
from prior_sg.services.scene_store.core import graph as core

log = logging.getLogger(__name__)
APPLICATION_ID = 0x70736753  # "psgS", in the header of the file
LAYOUT_VERSION = 5

LAYOUT = """
CREATE TABLE robots (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE origins (
    robot INTEGER PRIMARY KEY REFERENCES robots, x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL);
CREATE TABLE cursors (
    robot INTEGER NOT NULL REFERENCES robots, topic TEXT NOT NULL,
    epoch INTEGER NOT NULL, revision INTEGER NOT NULL, stamp_ns INTEGER NOT NULL,
    PRIMARY KEY (robot, topic)) WITHOUT ROWID;
CREATE TABLE places (
    robot INTEGER NOT NULL REFERENCES robots, id INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL, radius_m REAL NOT NULL, basis_points INTEGER NOT NULL,
    PRIMARY KEY (robot, id)) WITHOUT ROWID;
CREATE TABLE edges (
    robot INTEGER NOT NULL REFERENCES robots, a INTEGER NOT NULL, b INTEGER NOT NULL, clearance_m REAL NOT NULL,
    PRIMARY KEY (robot, a, b)) WITHOUT ROWID;
CREATE TABLE place_details (
    robot INTEGER NOT NULL REFERENCES robots, place INTEGER NOT NULL, kind TEXT NOT NULL, numbers BLOB NOT NULL,
    PRIMARY KEY (robot, place, kind)) WITHOUT ROWID;
CREATE TABLE cameras (
    robot INTEGER NOT NULL REFERENCES robots, frame_id INTEGER NOT NULL,
    epoch INTEGER NOT NULL, revision INTEGER NOT NULL, x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL,
    PRIMARY KEY (robot, frame_id)) WITHOUT ROWID;
CREATE TABLE alignments (
    robot INTEGER PRIMARY KEY REFERENCES robots, prior_digest TEXT NOT NULL, environment TEXT NOT NULL,
    task TEXT NOT NULL, space TEXT NOT NULL, labels TEXT NOT NULL, energy REAL NOT NULL);
CREATE TABLE regions (
    robot INTEGER NOT NULL REFERENCES robots, id INTEGER NOT NULL,
    label TEXT NOT NULL, place_count INTEGER NOT NULL, probability REAL NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL, area_m2 REAL NOT NULL, message BLOB,
    PRIMARY KEY (robot, id)) WITHOUT ROWID;
CREATE TABLE beliefs (
    robot INTEGER NOT NULL REFERENCES robots, place INTEGER NOT NULL,
    region INTEGER NOT NULL, posterior BLOB NOT NULL, unknown REAL NOT NULL, predicted INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (robot, place)) WITHOUT ROWID;
CREATE TABLE objects (
    robot INTEGER NOT NULL REFERENCES robots, id INTEGER NOT NULL, label TEXT NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL, message BLOB NOT NULL,
    PRIMARY KEY (robot, id)) WITHOUT ROWID;
CREATE TABLE tasks (
    robot INTEGER NOT NULL REFERENCES robots, stamp_ns INTEGER NOT NULL,
    environment TEXT NOT NULL, task TEXT NOT NULL, regions TEXT NOT NULL,
    PRIMARY KEY (robot, stamp_ns)) WITHOUT ROWID;
CREATE TABLE priors (
    digest TEXT PRIMARY KEY, environment TEXT NOT NULL, task TEXT NOT NULL, source TEXT NOT NULL,
    message BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE revisions (
    robot INTEGER NOT NULL REFERENCES robots, revision INTEGER NOT NULL, topic TEXT NOT NULL,
    stamp_ns INTEGER NOT NULL, places INTEGER NOT NULL, edges INTEGER NOT NULL, regions INTEGER NOT NULL,
    PRIMARY KEY (robot, revision)) WITHOUT ROWID;
"""

UPGRADES = {  # statements that bring a file of the version before to this one
    2: "ALTER TABLE regions ADD COLUMN message BLOB;"
    "ALTER TABLE beliefs ADD COLUMN predicted INTEGER NOT NULL DEFAULT 0;",
    3: """CREATE TABLE place_details (
    robot INTEGER NOT NULL REFERENCES robots, place INTEGER NOT NULL, kind TEXT NOT NULL, numbers BLOB NOT NULL,
    PRIMARY KEY (robot, place, kind)) WITHOUT ROWID;
""",
    4: """CREATE TABLE objects (
    robot INTEGER NOT NULL REFERENCES robots, id INTEGER NOT NULL, label TEXT NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL, message BLOB NOT NULL,
    PRIMARY KEY (robot, id)) WITHOUT ROWID;
""",
    5: """CREATE TABLE IF NOT EXISTS origins (
    robot INTEGER PRIMARY KEY REFERENCES robots, x_m REAL NOT NULL, y_m REAL NOT NULL, z_m REAL NOT NULL);
""",
}


class StoreError(ServiceError):
    """The database cannot be used; the message says what to do."""


class StoredRevision(NamedTuple):
    """One step of a robot's history: what a delta left behind."""

    revision: int
    topic: str
    stamp_ns: int
    places: int
    edges: int
    regions: int


class Database:
    """One open scene database. Raises StoreError when the file is not one, is damaged or cannot be written."""

    def __init__(self, cfg: core.Config) -> None:
        self._path = cfg.path
        self._robots: dict[str, int] = {}
        try:
            if cfg.path != ":memory:":
                Path(cfg.path).parent.mkdir(parents=True, exist_ok=True)
            self._sql = sqlite3.connect(cfg.path, isolation_level=None, check_same_thread=False)
            self._open(cfg)
        except (sqlite3.Error, OSError) as error:
            raise StoreError(
                f"{cfg.path} cannot be used as a scene database ({error}); {self._remedy(error)}"
            ) from error

    def _remedy(self, error: Exception) -> str:
        if isinstance(error, sqlite3.OperationalError | OSError):
            return "free the file or choose another path."
        return "move the file away or choose another path."

    def _open(self, cfg: core.Config) -> None:
        run = self._sql.execute
        run(f"PRAGMA busy_timeout = {cfg.busy_timeout_ms}")
        kind, version = (run(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
        empty = run("SELECT count(*) FROM sqlite_schema").fetchone()[0] == 0
        if not empty and (kind != APPLICATION_ID or not 1 <= version <= LAYOUT_VERSION):
            found = (
                f"layout {version}, this program needs {LAYOUT_VERSION}" if kind == APPLICATION_ID else "other content"
            )
            raise sqlite3.DatabaseError(f"it holds {found}")
        run("PRAGMA journal_mode = WAL")
        run(f"PRAGMA synchronous = {cfg.synchronous}")
        run(f"PRAGMA wal_autocheckpoint = {cfg.checkpoint_pages}")
        run("PRAGMA foreign_keys = ON")
        if empty:
            self._sql.executescript(
                f"BEGIN IMMEDIATE; {LAYOUT} PRAGMA application_id = {APPLICATION_ID};"
                f"PRAGMA user_version = {LAYOUT_VERSION}; COMMIT;"
            )
        for newer in range(version + 1, LAYOUT_VERSION + 1) if not empty else ():
            self._sql.executescript(f"BEGIN IMMEDIATE; {UPGRADES[newer]} PRAGMA user_version = {newer}; COMMIT;")
        fault = run("PRAGMA quick_check(1)").fetchone()[0]
        if fault != "ok":
            raise sqlite3.DatabaseError(f"it is damaged: {' '.join(fault.split())}")
        self._robots = dict(run("SELECT name, id FROM robots"))

    def graphs(self) -> dict[str, core.Graph]:
        """Every robot's graph as of the last commit, by robot."""
        usable = {name: robot for name, robot in sorted(self._robots.items()) if not fault_of_robot(name)}
        if odd := self._robots.keys() - usable.keys():
            log.warning("robots whose names cannot be used are left out", extra={"robots": sorted(map(ascii, odd))})
        return {name: self._graph(name, robot) for name, robot in usable.items()}

    def _graph(self, name: str, robot: int) -> core.Graph:
        graph = core.Graph(name)
        for topic, *cursor in self._select("topic, epoch, revision, stamp_ns FROM cursors", robot):
            setattr(graph, f"{topic}_cursor", core.Cursor(*cursor))
        for place, x, y, z, *rest in self._select("id, x_m, y_m, z_m, radius_m, basis_points FROM places", robot):
            graph.places[place] = core.Place((x, y, z), *rest)
        for place, kind, numbers in self._select("place, kind, numbers FROM place_details", robot):
            getattr(graph, kind)[place] = np.frombuffer(numbers, "<f4")
        for a, b, clearance_m in self._select("a, b, clearance_m FROM edges", robot):
            core.link(graph, (a, b), clearance_m)
        for frame, epoch, revision, *xyz in self._select(
            "frame_id, epoch, revision, x_m, y_m, z_m FROM cameras", robot
        ):
            graph.sightings[frame] = core.Sighting(epoch, revision, tuple(xyz))
        for origin_m in self._select("x_m, y_m, z_m FROM origins", robot):
            graph.origin_m = origin_m
        self._load_regions(graph, robot)
        for number, message in self._select("id, message FROM objects", robot):
            graph.objects[number] = msgspec.msgpack.decode(message, type=SceneObject)
        for *fields, regions in self._select("stamp_ns, environment, task, regions FROM tasks", robot, "stamp_ns"):
            stamp_ns, environment, task = fields
            core.set_task(
                graph,
                Task(robot=name, stamp_ns=stamp_ns, environment=environment, task=task, regions=json.loads(regions)),
            )
        graph.revision = self._sql.execute(
            "SELECT coalesce(max(revision), -1) FROM revisions WHERE robot = ?", (robot,)
        ).fetchone()[0]
        return graph

    def _load_regions(self, graph: core.Graph, robot: int) -> None:
        for digest, environment, task, space, labels, energy in self._select(
            "prior_digest, environment, task, space, labels, energy FROM alignments", robot
        ):
            graph.alignment = core.Alignment(digest, environment, task, space, tuple(json.loads(labels)), energy)
        for region, label, count, probability, x, y, z, area_m2, message in self._select(
            "id, label, place_count, probability, x_m, y_m, z_m, area_m2, message FROM regions", robot
        ):
            graph.regions[region] = Region(
                id=region,
                label=label,
                place_count=count,
                probability=probability,
                position_m=(x, y, z),
                area_m2=area_m2,
            )
            if message is not None:  # it holds everything; the columns are for whoever reads the file with SQL
                graph.regions[region] = msgspec.msgpack.decode(message, type=Region)
        for place, region, posterior, unknown, predicted in self._select(
            "place, region, posterior, unknown, predicted FROM beliefs", robot
        ):
            graph.beliefs[place] = core.Belief(region, np.frombuffer(posterior, "<f2"), unknown, bool(predicted))

    def _select(self, what: str, robot: int, order: str = "1") -> Iterator[tuple]:
        return self._sql.execute(f"SELECT {what} WHERE robot = ? ORDER BY {order}", (robot,))

    def history(self, robot: str, limit: int = 100) -> list[StoredRevision]:
        """The newest revisions of a robot, newest first."""
        rows = self._sql.execute(
            "SELECT revision, topic, stamp_ns, places, edges, regions FROM revisions WHERE robot = ?"
            " ORDER BY revision DESC LIMIT ?",
            (self._robots.get(robot, -1), limit),
        )
        return [StoredRevision(*row) for row in rows]

    def put_places(self, graph: core.Graph, changes: core.Changes, cameras: dict[int, core.Sighting]) -> None:
        """Make one applied place delta durable."""
        with self._transaction(graph.robot) as robot:
            if changes.replaced:
                self._sql.execute("DELETE FROM places WHERE robot = ?", (robot,))
                self._sql.execute("DELETE FROM edges WHERE robot = ?", (robot,))
                self._sql.execute("DELETE FROM place_details WHERE robot = ?", (robot,))
                self._sql.execute(
                    "DELETE FROM cameras WHERE robot = ? AND epoch < ?", (robot, graph.place_cursor.epoch)
                )
            gone_edges = sorted(changes.edges - graph.edges.keys())
            gone_places = sorted(changes.places - graph.places.keys())
            self._sql.executemany(
                "DELETE FROM edges WHERE robot = ? AND a = ? AND b = ?", [(robot, *edge) for edge in gone_edges]
            )
            self._delete("places", "id", robot, gone_places)
            kept = ((place, graph.places[place]) for place in sorted(changes.places & graph.places.keys()))
            self._put("places", ((robot, place, *at.position_m, at.radius_m, at.basis_points) for place, at in kept))
            self._put_details(robot, graph, changes)
            edges = sorted(changes.edges & graph.edges.keys())
            self._put("edges", ((robot, *edge, graph.edges[edge]) for edge in edges))
            self._put("origins", [(robot, *graph.origin_m)])
            self._put_cameras(robot, cameras)
            self._put_cursor(robot, "place", graph.place_cursor, graph)

    def _put_details(self, robot: int, graph: core.Graph, changes: core.Changes) -> None:
        self._delete("place_details", "place", robot, sorted(changes.places))
        for kind in ("frontiers", "surfaces"):
            numbers = getattr(graph, kind)
            rows = (
                (robot, p, kind, numbers[p].astype("<f4").tobytes()) for p in sorted(changes.places & numbers.keys())
            )
            self._put("place_details", rows)

    def put_regions(self, graph: core.Graph, changes: core.Changes) -> None:
        """Make one applied region delta durable."""
        with self._transaction(graph.robot) as robot:
            if changes.replaced:
                self._sql.execute("DELETE FROM regions WHERE robot = ?", (robot,))
                self._sql.execute("DELETE FROM beliefs WHERE robot = ?", (robot,))
            self._delete("regions", "id", robot, sorted(changes.regions - graph.regions.keys()))
            self._delete("beliefs", "place", robot, sorted(changes.beliefs - graph.beliefs.keys()))
            aligned = graph.alignment
            self._put("alignments", [(robot, *aligned[:4], json.dumps(aligned.labels), aligned.energy)])
            regions = (graph.regions[region] for region in sorted(changes.regions & graph.regions.keys()))
            self._put(
                "regions",
                (
                    (
                        *(robot, r.id, r.label, r.place_count, r.probability, *r.position_m, r.area_m2),
                        msgspec.msgpack.encode(r),
                    )
                    for r in regions
                ),
            )
            beliefs = ((place, graph.beliefs[place]) for place in sorted(changes.beliefs & graph.beliefs.keys()))
            self._put(
                "beliefs",
                ((robot, p, b.region, b.posterior.astype("<f2").tobytes(), b.unknown, b.predicted) for p, b in beliefs),
            )
            self._put_cursor(robot, "region", graph.region_cursor, graph)

    def put_objects(self, graph: core.Graph, changes: core.Changes) -> None:
        """Make one applied object delta durable."""
        with self._transaction(graph.robot) as robot:
            if changes.replaced:
                self._sql.execute("DELETE FROM objects WHERE robot = ?", (robot,))
            self._delete("objects", "id", robot, sorted(changes.objects - graph.objects.keys()))
            kept = (graph.objects[number] for number in sorted(changes.objects & graph.objects.keys()))
            self._put("objects", ((robot, o.id, o.label, *o.position_m, msgspec.msgpack.encode(o)) for o in kept))
            self._put_cursor(robot, "object", graph.object_cursor, graph)

    def put_cameras(self, robot: str, cameras: dict[int, core.Sighting]) -> None:
        """Keep camera centres of a delta that itself is not applied."""
        with self._transaction(robot) as key:
            self._put_cameras(key, cameras)

    def put_task(self, task: Task) -> None:
        """Keep a task of a robot."""
        with self._transaction(task.robot) as robot:
            self._put("tasks", [(robot, task.stamp_ns, task.environment, task.task, json.dumps(task.regions))])

    def put_prior(self, prior: Prior) -> None:
        """Keep a prior under its digest."""
        row = (prior.digest(), prior.environment, prior.task, prior.provenance.source, encode(prior))
        with self._transaction() as _:
            self._put("priors", [row])

    def checkpoint(self) -> None:
        """Fold what the write-ahead log holds into the file, without waiting for readers."""
        self._sql.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()

    def close(self) -> None:
        """Close the file; the last connection removes the write-ahead log."""
        self._sql.close()

    @contextmanager
    def _transaction(self, robot: str = "") -> Iterator[int]:
        """One atomic change; yields the robot's key. Nothing of it remains when the body raises."""
        try:
            self._sql.execute("BEGIN IMMEDIATE")
            try:
                yield self._robot_key(robot) if robot else 0
                self._sql.execute("COMMIT")
            except BaseException:
                self._robots.pop(robot, None)
                self._sql.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            raise StoreError(
                f"{self._path} cannot be written ({error}); free the disk or the file, then restart."
            ) from error

    def _robot_key(self, robot: str) -> int:
        if robot not in self._robots:
            self._sql.execute("INSERT OR IGNORE INTO robots (name) VALUES (?)", (robot,))
            found = self._sql.execute("SELECT id FROM robots WHERE name = ?", (robot,))
            self._robots[robot] = found.fetchone()[0]
        return self._robots[robot]

    def _put(self, table: str, rows: Iterable[tuple[Any, ...]]) -> None:
        rows = list(rows)
        if rows:
            self._sql.executemany(f"INSERT OR REPLACE INTO {table} VALUES ({', '.join('?' * len(rows[0]))})", rows)

    def _delete(self, table: str, column: str, robot: int, keys: list[int]) -> None:
        rows = [(robot, key) for key in keys]
        self._sql.executemany(f"DELETE FROM {table} WHERE robot = ? AND {column} = ?", rows)

    def _put_cameras(self, robot: int, cameras: dict[int, core.Sighting]) -> None:
        self._put("cameras", ((robot, frame, s.epoch, s.revision, *s.camera_m) for frame, s in cameras.items()))

    def _put_cursor(self, robot: int, topic: str, cursor: core.Cursor, graph: core.Graph) -> None:
        self._put("cursors", [(robot, topic, cursor.epoch, cursor.revision, cursor.stamp_ns)])
        counts = (len(graph.places), len(graph.edges), len(graph.regions))
        self._put("revisions", [(robot, graph.revision, topic, cursor.stamp_ns, *counts)])
