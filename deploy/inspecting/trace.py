"""What became of one keyframe: its way through the processes, and what is missing of it and why."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.terminal import Table, Terminal, line
from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.status import Consumed, Passage, ServiceStatus, StatusRequest
from prior_sg.schemas.topics import (
    DETECTIONS,
    ENCODE,
    JOURNAL,
    KEYFRAME,
    PLACE_DELTA,
    PYRAMID,
    REGION_DELTA,
)
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.record import Logged, read_log

BAR = 24  # characters
LEAST_WIDTH = 110
OF_A_LOG = (KEYFRAME, PLACE_DELTA, PYRAMID, DETECTIONS, REGION_DELTA, JOURNAL)


class Step(NamedTuple):
    """A passage and whose it is."""

    service: str
    instance: str
    passage: Passage


@dataclass(frozen=True)
class Story:
    """The steps of one keyframe in their order. `processes` are of the running system; none of a log."""

    robot: str
    frame_id: int
    steps: Sequence[Step] = ()
    processes: Sequence[ServiceStatus] = ()
    recorded: bool = False
    missing: Sequence[str] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        steps = [
            {"service": step.service, "instance": step.instance, **msgspec.to_builtins(step.passage)}
            for step in self.steps
        ]
        return {"robot": self.robot, "frame_id": self.frame_id, "steps": steps, "missing": list(self.missing)}


def from_system(client: BusClient, robot: str, frame_id: int) -> Story:
    """Asks every process what it remembers. Raises BusError, UserError."""
    processes, silent = client.statuses(StatusRequest(frame_id=frame_id))
    first_ns = min((p.received_ns for one in processes for p in one.passages if p.robot == robot), default=0)
    if first_ns:  # what became of the regions is told by revisions, not by keyframes
        processes, silent = client.statuses(StatusRequest(frame_id=frame_id, since_ns=first_ns))
    seen = [Step(one.service, one.instance, p) for one in processes for p in one.passages if p.robot == robot]
    steps = of_keyframe(seen, frame_id)
    if not steps:
        raise UserError(_unknown(robot, frame_id, processes))
    story = Story(robot, frame_id, steps, processes)
    return _with_gaps(story, [f"{instance} was not heard ({why})" for instance, why in silent.items()])


def from_log(path: Path, robot: str, frame_id: int) -> Story:
    """Puts together what a log holds. Raises LogError, UserError."""
    seen: list[Step] = []
    known: set[int] = set()
    for logged in read_log(path, OF_A_LOG):
        if logged.key.split("/")[1] == robot or logged.topic is JOURNAL:
            known.update(_number(logged, robot))
            seen.extend(_steps_of(logged, robot))
    steps = of_keyframe(_joined(seen), frame_id)
    if not steps:
        raise UserError(f"{path} holds no keyframe {frame_id} of {robot}; {_near(known, frame_id)}")
    return _with_gaps(Story(robot, frame_id, steps, recorded=True))


def of_keyframe(seen: Sequence[Step], frame_id: int) -> list[Step]:
    """The steps that concern a keyframe, in the order of their ends: those that name it; the first that tells regions
    after its pyramid was taken in; and the one that stores these."""
    steps = [step for step in seen if step.passage.frame_id == frame_id]
    taken = [step for step in steps if step.passage.topic == PYRAMID.name]
    told = None
    if taken:
        first = min(taken, key=lambda step: step.passage.ended_ns)
        later = [
            step
            for step in seen
            if step.instance == first.instance
            and REGION_DELTA.name in step.passage.published
            and step.passage.ended_ns >= first.passage.ended_ns
        ]
        told = min(later, key=lambda step: step.passage.ended_ns, default=None)
    if told is not None:
        steps += [told] if told not in steps else []
        revision = told.passage.published[REGION_DELTA.name]
        steps += [
            step
            for step in seen
            if step.passage.topic == REGION_DELTA.name
            and step.passage.revision == revision
            and f"/{told.instance}/" in step.passage.writer
        ]
    return sorted(steps, key=lambda step: (step.passage.ended_ns, step.passage.began_ns))


def _with_gaps(story: Story, silent: Sequence[str] = ()) -> Story:
    return Story(story.robot, story.frame_id, story.steps, story.processes, story.recorded, [*missing(story), *silent])


def missing(story: Story) -> Iterator[str]:
    """What should have become of a keyframe and has not, each with the reason as far as it is known."""
    topics = {(step.service, step.passage.topic) for step in story.steps}
    published = {topic for step in story.steps for topic in step.passage.published}
    for step in story.steps:
        if step.passage.fault:
            yield f"{step.instance} on {step.passage.topic}: {step.passage.fault}"
    if KEYFRAME.name not in published and not story.recorded:
        yield "ingest does not remember it: it has started again since, or it was longer ago than it remembers"
    if ("place_graph", KEYFRAME.name) not in topics:
        yield f"not mapped: {_wait(story, 'place_graph')}"
    if PYRAMID.name not in published:
        yield f"not encoded: {_why_not_encoded(story)}"
    elif ("segmenter", PYRAMID.name) not in topics:
        yield f"not segmented: {_wait(story, 'segmenter')}"
    elif REGION_DELTA.name not in published:
        yield "no regions were told since: the segmenter has no prior yet, or its next tick is to come"
    stores = [("the map", PLACE_DELTA), ("its regions", REGION_DELTA)]
    for what, topic in stores:
        if topic.name in published and ("scene_store", topic.name) not in topics:
            yield f"{what} not stored: {_wait(story, 'scene_store')}"


def _why_not_encoded(story: Story) -> str:
    ended = [step.passage for step in story.steps if step.passage.topic == "JobDone"]
    if any(one.fault for one in ended):
        return "the job was given up, see above"
    asked = any(ENCODE.name in step.passage.published for step in story.steps)
    selected = any(KEYFRAME.name in step.passage.published for step in story.steps)
    if selected and not asked and not story.recorded:
        return "it has no colour image"
    pools = [pool for one in story.processes for pool in one.pools if one.robot == story.robot]
    for pool in pools:
        if not sum(pool.workers.values()):
            return "no worker is there; `prior-sg up feature_pyramid --no-router`"
        if pool.waiting or pool.running:
            return f"{pool.waiting} keyframes wait for {sum(pool.workers.values())} workers, {pool.running} are there"
    return "skipped, given up or not begun: the log of ingest says which" if story.recorded else "its worker has died"


def _wait(story: Story, service: str) -> str:
    if story.recorded:
        return f"{service} had not finished with it when the log ended, or could not use it"
    there = [one for one in story.processes if one.service == service and one.robot in (story.robot, "*")]
    if not there:
        return f"no {service} is there; `prior-sg up {service} --no-router`"
    one = there[0]
    if one.backlog:
        return f"{one.backlog} inputs wait in {one.instance}, the oldest for {one.oldest_wait_s:.1f} s"
    return f"{one.instance} started later or has lost it; `prior-sg health` says what it missed"


def _unknown(robot: str, frame_id: int, processes: Sequence[ServiceStatus]) -> str:
    if not processes:
        return "no service is running; start them with `prior-sg up`, or give --log LOG"
    return (
        f"no process remembers keyframe {frame_id} of {robot}: it was never selected, or it is longer ago than they "
        "remember; give --log LOG where the stream was recorded"
    )


def _near(known: set[int], frame_id: int) -> str:
    if not known:
        return "it holds none of this robot; name another with --robot"
    nearest = sorted(sorted(known, key=lambda one: abs(one - frame_id))[:5])
    return f"the nearest are {', '.join(map(str, nearest))}"


def _number(logged: Logged, robot: str) -> Iterator[int]:
    if logged.topic is KEYFRAME:
        yield decode(KEYFRAME.type, logged.payload).frame_id  # type: ignore[attr-defined]


def _steps_of(logged: Logged, robot: str) -> Iterator[Step]:
    """What one message of a log tells: its writer has published it, or has finished with an input."""
    if logged.writer.count("/") < 2:
        return
    service, instance, _ = logged.writer.split("/", 2)
    try:
        message: Any = decode(logged.topic.type, logged.payload)
    except DecodeError:
        return
    if isinstance(message, Consumed):
        if message.frame_id >= 0 or message.topic == REGION_DELTA.name:
            of = message.key.split("/")[1] if message.key else robot
            passage = Passage(
                robot=of,
                topic=message.topic,
                frame_id=message.frame_id,
                revision=message.sequence if message.topic == REGION_DELTA.name else -1,
                ended_ns=max(logged.sent_ns, 0),
                writer=message.writer,
            )
            if of == robot:
                yield Step(service, instance, passage)
        return
    made_from = _made_from(logged.topic.name)
    yield Step(
        service,
        instance,
        Passage(
            robot=robot,
            topic=made_from,
            frame_id=getattr(message, "frame_id", -1),
            stamp_ns=message.stamp_ns,
            ended_ns=max(logged.sent_ns, 0),
            published={logged.topic.name: logged.sequence if logged.topic is REGION_DELTA else -1},
            fault=getattr(message, "event", ""),
        ),
    )


def _made_from(topic: str) -> str:
    return {"KEYFRAME": "frame", "PLACE_DELTA": KEYFRAME.name, "REGION_DELTA": "Tick"}.get(topic, ENCODE.name)


def _joined(seen: Sequence[Step]) -> list[Step]:
    """What a process has published for an input, and that it has finished with it, as one step."""
    found: dict[tuple[Any, ...], Step] = {}
    for step in seen:
        one = step.passage
        name = (step.instance, one.topic, one.frame_id, *((one.ended_ns,) if one.frame_id < 0 else ()))
        known = found.get(name)
        if known is None:
            found[name] = step
            continue
        both = msgspec.structs.replace(
            known.passage,
            stamp_ns=known.passage.stamp_ns or one.stamp_ns,
            ended_ns=max(known.passage.ended_ns, one.ended_ns),
            writer=known.passage.writer or one.writer,
            published=known.passage.published | one.published,
            fault=known.passage.fault or one.fault,
        )
        found[name] = known._replace(passage=both)
    return list(found.values())


def show(story: Story, console: Terminal) -> None:
    """A table, with a bar for each step where there is room, and what is missing."""
    begins = [one.received_ns or one.ended_ns for _, _, one in story.steps]
    first_ns, last_ns = min(begins), max(one.ended_ns for _, _, one in story.steps)
    wide = console.width >= LEAST_WIDTH + BAR
    table = Table(title=_title(story), title_justify="left", box=None, pad_edge=False)
    for name in ("after", "waited", "step"):
        table.add_column(name, justify="right", no_wrap=True)
    for name in ("process", "input", "what came of it", *(("",) if wide else ())):
        table.add_column(name, no_wrap=name != "what came of it")
    for step in story.steps:
        one = step.passage
        table.add_row(
            f"{((one.received_ns or one.ended_ns) - first_ns) / 1e9:.3f} s",
            _milliseconds(one.began_ns - one.received_ns, one.began_ns),
            _milliseconds(one.ended_ns - one.began_ns, one.began_ns),
            step.instance,
            one.topic,
            _outcome(one),
            *([_bar(one, first_ns, last_ns)] if wide else []),
        )
    console.print(table, width=max(console.width, LEAST_WIDTH), crop=False)  # a narrow terminal folds what it must
    for text in story.missing:
        console.print(line((text, "red")))


def _title(story: Story) -> str:
    return f"keyframe {story.frame_id} of {story.robot}"


def _milliseconds(duration_ns: int, known: int) -> str:
    return f"{max(duration_ns, 0) / 1e6:.1f} ms" if known else "-"


def _outcome(one: Passage) -> str:
    parts = [topic if revision < 0 else f"{topic} {revision}" for topic, revision in one.published.items()]
    if one.attempts:
        parts.append(f"{one.worker or 'nobody'}, {one.attempts} attempt{'s' * (one.attempts != 1)}")
    return "; ".join([*([", ".join(parts)] if parts else []), *([one.fault] if one.fault else [])]) or "-"


def _bar(one: Passage, first_ns: int, last_ns: int) -> str:
    """Dots while it waited, blocks while it was worked on."""
    place = _placed(first_ns, max(last_ns - first_ns, 1))
    received, began, ended = (
        place(one.received_ns or one.ended_ns),
        place(one.began_ns or one.ended_ns),
        place(one.ended_ns),
    )
    return " " * received + "·" * (began - received) + "█" * max(ended - began, 1)


def _placed(first_ns: int, span_ns: int) -> Callable[[int], int]:
    return lambda at_ns: round(BAR * (at_ns - first_ns) / span_ns)
