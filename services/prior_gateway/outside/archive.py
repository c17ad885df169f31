"""Priors and evidence on disk: a folder per task, a file per question; written whole or not at all."""

import asyncio
import hashlib
import logging
import os
import re
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import TypeVar

import msgspec

from prior_sg.schemas.codec import DecodeError, Message, decode, encode
from prior_sg.schemas.priors import Keep, Kept, Prior, PriorEvidence, Recall, Recalled
from prior_sg.services.folders import expanded
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside.signing import Signer
from prior_sg.services.runtime.service import Identity

log = logging.getLogger(__name__)
PREFERRED = "preferred"
M = TypeVar("M", bound=Message)


class Entry(Message, frozen=True, kw_only=True):
    """One file of the archive."""

    stamp_ns: int
    prior: Prior
    root: Prior | None = None  # what a revised prior was before any revision
    verdict: str = ""


def task_digest(environment: str, task: str, regions: list[str]) -> str:
    """Name of a task's folder."""
    return hashlib.blake2b(msgspec.msgpack.encode((environment, task, regions)), digest_size=12).hexdigest()


def file_name(question: str) -> str:
    """Name of the file that answers a question; whatever a question holds, it is a plain one, and never `PREFERRED`."""
    if re.fullmatch(r"[0-9a-f]{32}", question):
        return question
    return hashlib.blake2b(question.encode(), digest_size=16).hexdigest()


class PriorShelf:
    """The archive's folder. Without a path nothing is kept or found; damaged files are told in the log and skipped."""

    def __init__(self, path: str, kept_maps: int = 256) -> None:
        self.root = expanded(path) if path else None
        if self.root is not None and self.root.parts[:1] == ("~",):
            log.warning("this user has no home: priors are not kept; set prior_gateway.archive to a folder")
            self.root = None
        self._kept_maps = kept_maps

    def folder(self, environment: str, task: str, regions: list[str]) -> Path | None:
        """Where everything of one task lies."""
        return self.root / task_digest(environment, task, regions) if self.root else None

    def put(self, prior: Prior, name: str, root: Prior | None = None, verdict: str = "") -> bool:
        """Keep a prior as the answer to a question, or as the preferred one of its task; whether it is kept."""
        folder = self.folder(prior.environment, prior.task, prior.vocabulary)
        entry = Entry(stamp_ns=time.time_ns(), prior=prior, root=root, verdict=verdict)
        return folder is not None and _write(folder / f"{name}.prior", encode(entry))

    def put_evidence(self, evidence: PriorEvidence) -> None:
        """Keep the newest evidence of one map."""
        if folder := self.folder(evidence.environment, evidence.task, evidence.vocabulary):
            name = hashlib.blake2b(f"{evidence.robot}/{evidence.epoch}".encode(), digest_size=8).hexdigest()
            _write(folder / f"{name}.evidence", encode(evidence))
            for old in sorted(folder.glob("*.evidence"), key=_age)[: -self._kept_maps]:
                old.unlink(missing_ok=True)

    def recall(self, request: Recall) -> Recalled:
        """Everything known of a task."""
        folder = self.folder(request.environment, request.task, request.regions)
        entries = {path.stem: entry for path, entry in self._entries(folder)}
        exact, preferred = entries.pop(file_name(request.question), None), entries.pop(PREFERRED, None)
        newest = max(entries.values(), key=lambda entry: entry.stamp_ns, default=None)
        return Recalled(
            question=request.question,
            preferred=preferred.prior if preferred else None,
            exact=exact.prior if exact else None,
            newest=newest.prior if newest else None,
            root=preferred.root if preferred else None,
            evidence=list(self.evidence(folder)),
        )

    def all(self) -> Iterator[tuple[str, Entry]]:
        """Every kept prior with the name of its file, newest first."""
        folders = sorted(self.root.iterdir()) if self.root and self.root.is_dir() else []
        found = [(path.stem, entry) for folder in folders if folder.is_dir() for path, entry in self._entries(folder)]
        yield from sorted(found, key=lambda pair: -pair[1].stamp_ns)

    def evidence(self, folder: Path | None) -> Iterator[PriorEvidence]:
        """The evidence of one task."""
        for path in sorted(folder.glob("*.evidence")) if folder else []:
            if (seen := _read(path, PriorEvidence)) is not None:
                yield seen

    def _entries(self, folder: Path | None) -> Iterator[tuple[Path, Entry]]:
        for path in sorted(folder.glob("*.prior")) if folder else []:
            if (entry := _read(path, Entry)) is not None:
                yield path, entry


def _read(path: Path, kind: type[M]) -> M | None:
    try:
        return decode(kind, path.read_bytes())
    except (OSError, DecodeError) as error:
        log.warning(
            "a file of the prior archive cannot be read: left out", extra={"path": str(path), "why": str(error)}
        )
        return None


def _age(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _write(path: Path, content: bytes) -> bool:
    """Whether it is written; why not is told in the log."""
    beside = path.with_suffix(f".{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(content)
        beside.replace(path)
    except OSError as error:
        log.warning("the prior archive cannot be written", extra={"path": str(path), "why": str(error)})
        return False
    return True


def open_recall(cfg: Config, identity: Identity) -> Callable[[Recall], Awaitable[Recalled]]:
    """The errand that looks into the archive."""
    shelf = PriorShelf(cfg.archive)

    async def recall(request: Recall) -> Recalled:
        return await asyncio.to_thread(shelf.recall, request)

    return recall


def open_keep(cfg: Config, identity: Identity) -> Callable[[Keep], Awaitable[Kept]]:
    """The errand that keeps, dates and signs. Raises ServiceError for unusable keys."""
    shelf = PriorShelf(cfg.archive, cfg.learning.kept_maps)
    signer = Signer(cfg)

    def keep_now(request: Keep) -> Kept:
        if request.evidence is not None:
            shelf.put_evidence(request.evidence)
        if (prior := request.prior) is None:
            return Kept()
        if request.own:
            prior = signer.sign(_dated(prior, identity.instance))
        trusted, verdict = signer.check(prior)
        if signer.required and not (trusted or request.own):
            log.warning("a prior from elsewhere is not trusted: left out", extra={"why": verdict})
            return Kept(question=request.question, verdict=verdict)
        shelf.put(prior, PREFERRED if request.preferred else file_name(request.question), request.root, verdict)
        return Kept(prior=prior, question=request.question, verdict=verdict)

    async def keep(request: Keep) -> Kept:
        return await asyncio.to_thread(keep_now, request)

    return keep


def _dated(prior: Prior, instance: str) -> Prior:
    made = msgspec.structs.replace(prior.provenance, made_by=instance, made_ns=time.time_ns())
    return msgspec.structs.replace(prior, provenance=made)
