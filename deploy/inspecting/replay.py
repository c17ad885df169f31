"""Feeds a recorded log to one service again, in the order it consumed its inputs, and compares what comes out."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.schemas.codec import DecodeError, Message, decode, encode
from prior_sg.schemas.migrations import journalled
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.status import Consumed, Started, Tick
from prior_sg.schemas.succession import Succession, TakesOver
from prior_sg.schemas.topics import JOURNAL, KEYFRAME, QUERIES, TOPICS, Topic
from prior_sg.services.refusals import InputRefused
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime import config
from prior_sg.services.runtime.record import LogError, Logged, read_log
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity, Service

logger = logging.getLogger(__name__)
TOPIC_BY_NAME = {topic.name: topic for topic in TOPICS}
QUERY_BY_NAME = {query.name: query for query in QUERIES}
FED_BY_NAME = {kind.__name__: kind for kind in (Tick, Succession, TakesOver)}  # inputs that a host makes


@dataclass
class Life:
    """One instance of a service, from its start to its end, as its journal tells."""

    service: str
    instance: str
    started: Started
    inputs: list[Consumed] = field(default_factory=list)
    ended_cleanly: bool = False


@dataclass
class Comparison:
    """Replayed outputs of one life against the recorded ones."""

    instance: str
    inputs: int
    outputs: int
    recorded: int
    differences: list[str]


def lives(journal: list[Consumed], service: str) -> list[Life]:
    """The lives of one service's instances in a journal, in order of start."""
    found: dict[str, Life] = {}
    for entry in sorted((e for e in journal if e.service == service), key=lambda e: (e.instance, e.order)):
        if entry.topic == "START":
            found[entry.instance] = Life(service, entry.instance, _start(entry))
        elif entry.instance not in found:  # its start was not recorded: it cannot be replayed
            continue
        elif entry.topic == "STOP":
            found[entry.instance].ended_cleanly = True
        else:
            found[entry.instance].inputs.append(entry)
    return sorted(found.values(), key=lambda life: life.started.epoch)


def _start(entry: Consumed) -> Started:
    try:
        return decode(Started, entry.inline)
    except DecodeError as error:
        raise LogError(f"the journal of {entry.instance} does not tell how it was started: {error}") from error


class Log:
    """A log in memory, indexed for replay of one service."""

    def __init__(self, path: Path, service: Service) -> None:
        wanted = {*service.reads, *service.writes, JOURNAL} | ({KEYFRAME} if service.job else set())
        self.service = service
        self.messages: dict[tuple[str, str, int], Logged] = {}
        self.order: list[Logged] = []
        self.frames: dict[int, Logged] = {}
        journal: list[Consumed] = []
        for logged in read_log(path, wanted):
            if logged.topic is JOURNAL:
                journal.append(logged.message())
                continue
            self.messages[logged.key, logged.writer, logged.sequence] = logged
            self.order.append(logged)
            if logged.topic is KEYFRAME:
                self.frames[logged.message().frame_id] = logged
        self.lives = lives(journal, service.name)
        self._versions = {life.instance: life.started.versions for life in self.lives}

    def input(self, entry: Consumed) -> Message:
        """The message a journal entry means. Raises LogError when the log does not hold it, or this program cannot read
        it."""
        try:
            return self._input(entry)
        except DecodeError as error:
            raise LogError(f"the journal of {entry.instance} cannot be replayed: {error}") from error

    def _input(self, entry: Consumed) -> Message:
        versions = self._versions.get(entry.instance, {})
        if entry.topic in FED_BY_NAME:
            return journalled(FED_BY_NAME[entry.topic], entry.inline, versions)
        errands = {errand.name: errand for errand in self.service.errands}
        if question := QUERY_BY_NAME.get(entry.topic) or errands.get(entry.topic):
            return journalled(question.reply, entry.inline, versions)
        topic = TOPIC_BY_NAME.get(entry.topic)
        if topic is None:
            raise LogError(f"the journal of {entry.instance} names {entry.topic!r}, which this program does not know")
        if topic.delivery == "job":
            logged = self.frames.get(entry.frame_id)
        elif not entry.writer:
            return journalled(topic.type, entry.inline, versions)
        else:
            logged = self.messages.get((entry.key, entry.writer, entry.sequence))
        if logged is None:
            raise LogError(f"the log lacks {entry.topic} {entry.sequence} of {entry.writer}, which was consumed")
        return logged.message()

    def recorded(self, life: Life) -> dict[str, list[Message]]:
        """What this life published, by topic, in order."""
        writer = f"{life.service}/{life.instance}/{life.started.epoch}"
        outputs: dict[str, list[Message]] = {}
        for logged in self.order:
            if logged.writer == writer:
                outputs.setdefault(logged.topic.name, []).append(logged.message())
        return outputs


def recorded_config(log: Log, life: Life) -> Any:
    """The config of one life, as a replay takes it; what has changed since in the settings is logged. Raises LogError
    when a value no longer fits."""
    try:
        cfg, notes = config.recorded(log.service.config, life.service, life.started.config)
    except config.ConfigError as error:
        raise LogError(f"the journal of {life.instance} cannot be replayed: {error}") from error
    for note in notes:
        logger.warning("%s", note)
    return log.service.replay_config(cfg)


def replay_life(log: Log, life: Life) -> Iterator[tuple[Topic, Message]]:
    """The outputs of one life, made again from its recorded inputs and config."""
    with revived(log, life) as runner:
        for entry in life.inputs:
            yield from _fed(runner, log.input(entry))


def revived(log: Log, life: Life) -> Runner:
    """The service as it was when this life began; the caller closes it. Replies come from the log, as inputs."""
    identity = Identity(life.started.robot, life.instance, life.started.epoch)
    return Runner(log.service, recorded_config(log, life), identity, wire=True)


def final(log: Log, life: Life) -> Runner:
    """The service after the recorded inputs of one life; the caller closes it."""
    runner = revived(log, life)
    for entry in life.inputs:
        _fed(runner, log.input(entry))
    return runner


def _fed(runner: Runner, message: Message) -> list[tuple[Topic, Message]]:
    """As a host steps: an input that was refused changed nothing."""
    try:
        return list(runner.feed(message))
    except InputRefused:
        return []


def compare(log: Log, life: Life) -> Comparison:
    """Replay one life and compare, message by message and field by field."""
    replayed: dict[str, list[Message]] = {}
    for topic, message in replay_life(log, life):
        if topic.recorded:
            replayed.setdefault(topic.name, []).append(message)
    recorded = log.recorded(life)
    differences: list[str] = []
    tolerance = log.service.replay_tolerance
    for name in sorted(replayed.keys() | recorded.keys()):
        new, old = replayed.get(name, []), recorded.get(name, [])
        # A process killed in mid-step may have published outputs of an input that never reached its journal.
        if len(new) != len(old) and (life.ended_cleanly or len(new) > len(old)):
            differences.append(f"{name}: {len(old)} recorded, {len(new)} replayed")
        for index, (before, after) in enumerate(zip(old, new, strict=False)):
            found = message_differences(_unsigned(before), _unsigned(after), tolerance)
            differences += [f"{name}[{index}].{text}" for text in found]
    return Comparison(
        life.instance,
        len(life.inputs),
        sum(map(len, replayed.values())),
        sum(map(len, recorded.values())),
        differences,
    )


def _unsigned(message: Message) -> Message:
    """As the service made it: a host signs what it publishes."""
    return message.unsigned() if isinstance(message, Prior) else message


def message_differences(before: Message, after: Message, tolerance: float = 0.0) -> list[str]:
    """Fields in which two messages differ, floats beyond the tolerance."""
    if encode(before) == encode(after):
        return []
    return list(_differences("", before, after, tolerance))


def _differences(path: str, before: Any, after: Any, tolerance: float) -> Iterator[str]:
    if isinstance(before, msgspec.Struct) and type(before) is type(after):
        for name in before.__struct_fields__:
            yield from _differences(
                f"{path}.{name}" if path else name, getattr(before, name), getattr(after, name), tolerance
            )
    elif isinstance(before, np.ndarray):
        if before.shape != after.shape:
            yield f"{path}: shape {before.shape} became {after.shape}"
        elif before.dtype != after.dtype:
            yield f"{path}: {before.dtype} became {after.dtype}"
        elif before.dtype.kind != "f":
            if not np.array_equal(before, after):
                yield f"{path}: {np.count_nonzero(before != after)} entries differ"
        elif not np.allclose(before, after, rtol=tolerance, atol=tolerance):
            worst = np.abs(np.asarray(before, float) - np.asarray(after, float)).max()
            yield f"{path}: differs by up to {worst:.3g}"
    elif isinstance(before, (list, tuple)):
        if len(before) != len(after):
            yield f"{path}: {len(before)} items became {len(after)}"
            return
        for index, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from _differences(f"{path}[{index}]", one, other, tolerance)
    elif isinstance(before, float) and isinstance(after, float):
        if not math.isclose(before, after, rel_tol=tolerance, abs_tol=tolerance):
            yield f"{path}: {before!r} became {after!r}"
    elif before != after:
        yield f"{path}: {before!r} became {after!r}"


def undisturbed(log: Log) -> Runner:
    """A fresh service that has read everything recorded on its topics, in the order of the log.

    The caller closes it. What a service that was never interrupted would hold.
    """
    service = log.service
    runner = Runner(service, service.replay_config(service.config()), Identity("*", "undisturbed", 0))
    for logged in log.order:
        if logged.topic in service.reads:
            runner.feed(logged.message())
    return runner


def open_log(path: Path, service: str) -> Log:
    """Read what a replay of the service needs. Raises LogError when the log holds nothing of it."""
    if BY_NAME[service].drive is not None:
        raise LogError(f"{service} reads its source, not the bus: there is nothing to replay")
    log = Log(path, BY_NAME[service])
    if not log.lives:
        raise LogError(f"{path} holds no journal of {service}; was it running while the log was recorded?")
    return log
