"""The scenes of a run as they were, from what it left: a database of the store, or a recorded log."""

import contextlib
import threading
from pathlib import Path
from typing import Self

from prior_sg.deploy.api.kept import kept
from prior_sg.deploy.api.scene import Scene
from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import StoredRevision
from prior_sg.schemas.topics import OBJECT_DELTA, PLACE_DELTA, PRIOR, REGION_DELTA, TASK
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.record import read_log
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core import telling
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.database import Database
from prior_sg.services.scene_store.storage import is_url
from prior_sg.services.scene_store.storage.tables import LAST, StoreError

READ_OF_LOGS = (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA, TASK, PRIOR)


class History:
    """Every revision that is kept of every robot. Use as a context manager, or call `close`; any thread may ask."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self._asking = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the database."""
        self.database.close()

    @property
    def robots(self) -> list[str]:
        """The robots it holds scenes of, by name."""
        with self._asking:
            return self.database.robots()

    def revisions(self, robot: str) -> list[StoredRevision]:
        """The revisions that are kept of a robot, oldest first."""
        with self._asking:
            return self.database.history(robot, LAST)

    def prior(self, digest: str) -> Prior | None:
        """The prior that `Scene.message.prior_digest` names; None where it is not kept."""
        with self._asking:
            return self.database.prior(digest)

    def scene(self, robot: str, revision: int | None = None, stamp_ns: int | None = None) -> Scene:
        """The newest scene of a robot, that of one revision, or the newest at a time. Raises NotInSceneError."""
        with self._asking:
            graph = self.database.at(robot, revision, stamp_ns)
            found = telling.scene(core.Graph(robot) if graph is None else graph)
        return kept(Scene(found), revision, stamp_ns)


def open_history(path_or_url: str | Path) -> History:
    """What a run left: `scene.sqlite`, the address of a PostgreSQL database, or a recorded log (`.mcap`); what writes
    there may go on. Raises StoreError, LogError.
    """
    place = str(path_or_url)
    if place.endswith(".mcap"):
        return _of_log(place)
    if not is_url(place) and not Path(place).is_file():
        raise StoreError(f"{place} does not exist or is no file; name the scene.sqlite or log.mcap of a run")
    try:
        return History(Database(Config(path=place), read_only=True))
    except ValueError as error:
        raise StoreError(str(error)) from error


def _of_log(path: str) -> History:
    """A store in memory that has read the deltas of a log, in their order."""
    store = BY_NAME["scene_store"]
    runner = Runner(store, store.config(path=":memory:"), Identity("*", "history", 0))
    for logged in read_log(path, READ_OF_LOGS):
        with contextlib.suppress(DecodeError):  # garbage on a topic is recorded as well, and was no store's
            runner.feed(decode(logged.topic.type, logged.payload))
    return History(runner.state.database)
