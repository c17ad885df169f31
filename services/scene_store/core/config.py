"""Settings of the store."""

import re
from typing import Literal

import msgspec

_PASSWORD = re.compile(r"^postgres(?:ql)?://(?:[^/@?]*:[^/@?]+@|.*[?&](?:ssl)?password=.)")


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Where the scene graphs are kept, and how durably."""

    path: str = "out/scene.sqlite"  # file, created when missing, or postgresql://…; :memory: keeps nothing
    synchronous: Literal["full", "normal"] = "full"  # full survives a power cut, normal a killed process
    busy_timeout_ms: int = 5000  # wait this long for another process that holds the file
    checkpoint_pages: int = 4000  # pages in the write-ahead log before a commit folds it into the file
    history: Literal["all", "last", "sampled"] = "all"  # of older revisions keep all, none, or one every so often
    history_last: int = 1000  # revisions that are always kept, the newest
    history_every_s: float = 60.0  # what `sampled` keeps of those before: one each such time

    def __post_init__(self) -> None:
        if _PASSWORD.search(self.path):  # settings are logged and recorded
            raise ValueError("path holds a password; leave it out and put it into PGPASSWORD or ~/.pgpass")
        if self.checkpoint_pages < 1:
            raise ValueError("checkpoint_pages must be at least 1")
