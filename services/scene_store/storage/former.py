"""Files of layouts without history (1 to 5): brought to the last of them, and read.

They held the present in a table for each kind of thing, and of the past only counts.
"""

import json
import logging
import sqlite3
from collections.abc import Iterator

import msgspec
import numpy as np

from prior_sg.schemas.names import fault_of_robot
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.priors import Task
from prior_sg.schemas.regions import Region
from prior_sg.services.scene_store.core import graph as core

log = logging.getLogger(__name__)
LAST = 5
TABLES = (
    *("origins", "cursors", "places", "edges", "place_details", "cameras", "alignments", "regions"),
    *("beliefs", "objects", "tasks", "revisions"),
)
GONE = tuple(f"DROP TABLE IF EXISTS {table}" for table in TABLES)

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


def upgrade(sql: sqlite3.Connection, version: int) -> None:
    """Bring a file of an even older layout to layout 5."""
    for newer in range(version + 1, LAST + 1):
        sql.executescript(f"BEGIN IMMEDIATE; {UPGRADES[newer]} PRAGMA user_version = {newer}; COMMIT;")


def graphs(sql: sqlite3.Connection) -> dict[int, core.Graph]:
    """What a file of layout 5 holds of each robot, by the robot's key."""
    found = {}
    for key, name in sql.execute("SELECT id, name FROM robots ORDER BY name").fetchall():
        if fault_of_robot(name):
            log.warning("what a robot left whose name cannot be used is dropped", extra={"robot": ascii(name)})
        else:
            found[key] = _graph(sql, name, key)
    return found


def _graph(sql: sqlite3.Connection, name: str, robot: int) -> core.Graph:
    graph = core.Graph(name)
    for topic, *cursor in _select(sql, "topic, epoch, revision, stamp_ns FROM cursors", robot):
        setattr(graph, f"{topic}_cursor", core.Cursor(*cursor))
    for place, x, y, z, *rest in _select(sql, "id, x_m, y_m, z_m, radius_m, basis_points FROM places", robot):
        graph.places[place] = core.Place((x, y, z), *rest)
    for place, kind, numbers in _select(sql, "place, kind, numbers FROM place_details", robot):
        getattr(graph, kind)[place] = np.frombuffer(numbers, "<f4")
    for a, b, clearance_m in _select(sql, "a, b, clearance_m FROM edges", robot):
        core.link(graph, (a, b), clearance_m)
    for frame, epoch, revision, *xyz in _select(sql, "frame_id, epoch, revision, x_m, y_m, z_m FROM cameras", robot):
        graph.sightings[frame] = core.Sighting(epoch, revision, tuple(xyz))
    for origin_m in _select(sql, "x_m, y_m, z_m FROM origins", robot):
        graph.origin_m = origin_m
    _regions(sql, graph, robot)
    for number, message in _select(sql, "id, message FROM objects", robot):
        graph.objects[number] = msgspec.msgpack.decode(message, type=SceneObject)
    for *fields, regions in _select(sql, "stamp_ns, environment, task, regions FROM tasks", robot, "stamp_ns"):
        stamp_ns, environment, task = fields
        names = json.loads(regions)
        core.set_task(graph, Task(robot=name, stamp_ns=stamp_ns, environment=environment, task=task, regions=names))
    for (newest,) in sql.execute("SELECT max(revision) FROM revisions WHERE robot = ?", (robot,)):
        graph.revision = -1 if newest is None else newest
    return graph


def _regions(sql: sqlite3.Connection, graph: core.Graph, robot: int) -> None:
    for digest, environment, task, space, labels, energy in _select(
        sql, "prior_digest, environment, task, space, labels, energy FROM alignments", robot
    ):
        graph.alignment = core.Alignment(digest, environment, task, space, tuple(json.loads(labels)), energy)
    for region, label, count, probability, x, y, z, area_m2, message in _select(
        sql, "id, label, place_count, probability, x_m, y_m, z_m, area_m2, message FROM regions", robot
    ):
        if message is not None:  # it holds everything; files of layout 1 have only the columns
            graph.regions[region] = msgspec.msgpack.decode(message, type=Region)
            continue
        known = {"label": label, "place_count": count, "probability": probability, "area_m2": area_m2}
        graph.regions[region] = Region(id=region, position_m=(x, y, z), **known)
    for place, region, posterior, unknown, predicted in _select(
        sql, "place, region, posterior, unknown, predicted FROM beliefs", robot
    ):
        graph.beliefs[place] = core.Belief(region, np.frombuffer(posterior, "<f2"), unknown, bool(predicted))


def _select(sql: sqlite3.Connection, what: str, robot: int, order: str = "1") -> Iterator[tuple]:
    return sql.execute(f"SELECT {what} WHERE robot = ? ORDER BY {order}", (robot,))
