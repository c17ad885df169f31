"""Passages of keyframes as spans of traces (pure).

The trace of a keyframe is named by a digest of its robot, number and stamp, so that nothing has to travel with it:
every span can be made from what a process tells of itself. A context that came with a sample becomes a link.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field

from prior_sg.schemas.status import Passage, ServiceStatus
from prior_sg.schemas.topics import KEYFRAME

MOST_KNOWN = 4096  # keyframes, and what was published for them
ROOT = "keyframe"
Keyframe = tuple[str, int]  # robot and number


@dataclass(frozen=True)
class Span:
    """One span, in numbers of W3C's Trace Context; times are wall times of the process's host."""

    trace_id: int
    span_id: int
    parent_id: int  # 0 = the root
    name: str
    service: str
    instance: str
    start_ns: int
    end_ns: int
    attributes: dict[str, str | int] = field(default_factory=dict)
    published: tuple[str, ...] = ()
    fault: str = ""
    link: str = ""  # a traceparent


@dataclass
class Traces:
    """Makes spans of passages; knows what was published by which span, to name the parents."""

    _stamps: dict[Keyframe, int] = field(default_factory=dict)
    _made_by: dict[tuple[Keyframe, str, str], int] = field(default_factory=dict)  # keyframe, topic, instance: span
    _told: dict[tuple[str, str, str, int], Keyframe] = field(default_factory=dict)  # instance, robot, topic, revision

    def of(self, status: ServiceStatus, passage: Passage) -> Iterator[Span]:
        """The span of a passage, and in it those of waiting and of the step; none of what belongs to no keyframe."""
        writer = passage.writer.split("/")[1] if passage.writer.count("/") > 1 else ""
        told = self._told.get((writer, passage.robot, passage.topic, passage.revision))
        keyframe = (passage.robot, passage.frame_id) if passage.frame_id >= 0 else told
        if keyframe is None:
            return
        is_root = KEYFRAME.name in passage.published
        if passage.stamp_ns and passage.frame_id >= 0 and (is_root or keyframe not in self._stamps):
            _keep(self._stamps, keyframe, passage.stamp_ns)
        trace = f"{keyframe[0]}/{keyframe[1]}/{self._stamps.get(keyframe, 0)}"
        root = _digest(f"{trace}/{ROOT}", 8)
        own = root if is_root else _digest(f"{trace}/{status.instance}/{passage.topic}/{passage.began_ns}", 8)
        parent = self._made_by.get((keyframe, passage.topic, writer), root)
        for topic, revision in passage.published.items():
            _keep(self._made_by, (keyframe, topic, status.instance), own)
            _keep(self._made_by, (keyframe, topic, ""), own)  # jobs do not name their writer
            _keep(self._told, (status.instance, passage.robot, topic, revision), keyframe)
        common = (_digest(trace, 16), own, status.service, status.instance)
        yield Span(
            trace_id=common[0],
            span_id=own,
            parent_id=0 if is_root else parent,
            name=f"{status.service} {passage.topic}",
            service=status.service,
            instance=status.instance,
            start_ns=passage.received_ns,
            end_ns=passage.ended_ns,
            attributes=_attributes(keyframe, passage),
            published=tuple(passage.published),
            fault=passage.fault,
            link=passage.traceparent,
        )
        yield _part("wait", common, passage.received_ns, passage.began_ns)
        yield _part("step", common, passage.began_ns, passage.ended_ns)


def trace_id(robot: str, frame_id: int, stamp_ns: int) -> str:
    """The trace of a keyframe, as 32 hexadecimal digits."""
    return f"{_digest(f'{robot}/{frame_id}/{stamp_ns}', 16):032x}"


def _part(name: str, common: tuple[int, int, str, str], start_ns: int, end_ns: int) -> Span:
    trace, parent, service, instance = common
    return Span(trace, _digest(f"{parent}/{name}", 8), parent, name, service, instance, start_ns, max(start_ns, end_ns))


def _attributes(keyframe: Keyframe, passage: Passage) -> dict[str, str | int]:
    found: dict[str, str | int] = {
        "prior_sg.robot": keyframe[0],
        "prior_sg.frame_id": keyframe[1],
        "messaging.destination.name": passage.topic,
    }
    others = {"prior_sg.revision": passage.revision, "prior_sg.sent_ns": passage.sent_ns or -1}
    found |= {name: value for name, value in others.items() if value >= 0}
    return found | (
        {"prior_sg.worker": passage.worker, "prior_sg.attempts": passage.attempts} if passage.worker else {}
    )


def _digest(text: str, size: int) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=size).digest(), "big") or 1


def _keep(known: dict, name: object, value: object) -> None:
    known.pop(name, None)
    known[name] = value
    if len(known) > MOST_KNOWN:
        del known[next(iter(known))]
