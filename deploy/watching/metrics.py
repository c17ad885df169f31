"""A picture of a running system in the form of Prometheus.

What a label can be is bounded: by the processes that answered, of which at most `MOST_PROCESSES` are told, and in each
by the topics that exist and by `MOST_REASONS` reasons of losses. What is left out is counted.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate
from typing import Protocol

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.utils import floatToGoString

from prior_sg.deploy.inspecting.health import Found
from prior_sg.deploy.watching.follower import Picture
from prior_sg.deploy.watching.latency import Histogram, Latencies
from prior_sg.schemas.names import shown
from prior_sg.schemas.status import STEP_BOUNDS_S, ServiceStatus
from prior_sg.schemas.topics import QUERIES, STATUS, TOPICS
from prior_sg.services.losses import MOST_REASONS

MOST_PROCESSES = 256
MOST_ROLES = 256  # of who is in charge
MOST_SPACES = 16  # of embedding, in one pool
LONGEST_LABEL = 100  # characters
PREFIX = "prior_sg_"
OF_PROCESS = ("service", "process", "robot")
NAMES = {one.name for one in (*TOPICS, *QUERIES, STATUS)}
GAUGES = (  # name, what it is, and what of a status it says
    ("process_uptime_seconds", "Since the process began", lambda one: one.uptime_s),
    ("process_resident_memory_bytes", "Resident memory", lambda one: one.resident_mb * 1e6),
    ("process_busy_ratio", "Share of the last seconds spent computing", lambda one: one.busy_share),
    ("backlog_inputs", "Inputs that wait", lambda one: one.backlog),
    ("backlog_oldest_seconds", "How long the input that waits longest has been waiting", lambda one: one.oldest_wait_s),
    ("step_running_seconds", "How long the process has been at the input it is at", lambda one: one.step_s),
    ("step_compiling_seconds", "For how long of that it compiled inner loops", lambda one: one.step_compiling_s),
    ("unanswered_questions", "Questions of the process that nobody has answered yet", lambda one: len(one.waiting_for)),
)
COUNTS = (
    ("messages_received", "Samples that arrived", "received"),
    ("messages_consumed", "Messages the process has finished with", "consumed"),
    ("messages_published", "Messages the process has published", "published"),
    ("messages_malformed", "Messages that could not be read or did not belong where they came", "malformed"),
    ("messages_skipped", "Samples that a newer one replaced before they were read", "skipped"),
    ("messages_duplicate", "Samples that had been seen before", "duplicate"),
    ("messages_missed", "Samples known to exist that never arrived", "missed"),
)
FIGURES = (  # of the store
    ("revisions", "store_revisions", "Revisions of all scenes"),
    ("file_bytes", "store_file_bytes", "Size of the scene database and its log"),
    ("disk_free_bytes", "store_disk_free_bytes", "Free on the disk of the scene database"),
)


def families(picture: Picture, latencies: Latencies, now_s: float) -> Iterator[Metric]:
    """All metrics; `now_s` is of the clock of `picture`."""
    found = picture.found
    told, left_out = found.processes[:MOST_PROCESSES], max(len(found.processes) - MOST_PROCESSES, 0)
    age_s = now_s - picture.at_s if picture.at_s is not None else float("inf")
    yield _gauge("picture_age_seconds", "Since the system was last asked with success", (), [((), age_s)])
    failures = [((), float(picture.failures))]
    yield _counter("picture_failures", "Times the system could not be asked", (), failures)
    yield _gauge("processes_left_out", "Processes beyond what is told", (), [((), left_out)])
    yield from _of_processes(told)
    yield from _of_topics(told)
    yield from _of_jobs(told)
    yield from _of_roles(found)
    robots = ((_label(robot),) for robot in latencies.by_robot)
    rows = list(zip(robots, list(latencies.by_robot.values()), strict=True))
    text = "From the publication of a keyframe to the first regions that take it in"
    yield _histogram("keyframe_to_region_seconds", text, ("robot",), rows)


class HasPicture(Protocol):
    """What a collector reads: a follower."""

    picture: Picture


class Collector:
    """What a registry of prometheus_client asks at each scrape."""

    def __init__(self, follower: HasPicture, latencies: Latencies) -> None:
        self._follower, self._latencies = follower, latencies

    def collect(self) -> Iterable[Metric]:
        """All metrics."""
        return families(self._follower.picture, self._latencies, time.monotonic())


def _of_processes(told: Sequence[ServiceStatus]) -> Iterator[Metric]:
    info = [((*_process(one), _label(one.release)), 1.0) for one in told]
    yield _gauge("process_info", "Processes that answered, and their release", (*OF_PROCESS, "release"), info)
    for name, text, value in GAUGES:
        yield _gauge(name, text, OF_PROCESS, [(_process(one), float(value(one))) for one in told])
    cpu = [(_process(one), one.cpu_s) for one in told]
    yield _counter("process_cpu_seconds", "Processor time", OF_PROCESS, cpu)
    steps = [
        (_process(one), Histogram(STEP_BOUNDS_S, one.step_counts, one.step_sum_s))
        for one in told
        if len(one.step_counts) == len(STEP_BOUNDS_S) + 1
    ]
    yield _histogram("step_duration_seconds", "Time of a step with one input", OF_PROCESS, steps)
    for figure, name, text in FIGURES:
        yield _gauge(
            name, text, OF_PROCESS, [(_process(one), one.figures[figure]) for one in told if figure in one.figures]
        )


def _of_topics(told: Sequence[ServiceStatus]) -> Iterator[Metric]:
    labels = (*OF_PROCESS, "topic")
    topics = [((*_process(one), count.topic), count) for one in told for count in one.topics if count.topic in NAMES]
    for name, text, field in COUNTS:
        yield _counter(name, text, labels, [(of, float(getattr(count, field))) for of, count in topics])
    ages = [(of, count.last_age_ms / 1e3) for of, count in topics if count.last_age_ms >= 0]
    yield _gauge("message_age_seconds", "Age of the newest message when it was read", labels, ages)
    losses = {
        (*_process(one), _label(loss.what), _label(loss.reason)): float(loss.count)
        for one in told
        for loss in one.losses[:MOST_REASONS]
    }
    yield _counter("losses", "What could not be used, by reason", (*OF_PROCESS, "what", "reason"), losses.items())


def _of_jobs(told: Sequence[ServiceStatus]) -> Iterator[Metric]:
    labels = (*OF_PROCESS, "topic")
    pools = [((*_process(one), pool.topic), pool) for one in told for pool in one.pools if pool.topic in NAMES]
    waiting = [(of, float(pool.waiting)) for of, pool in pools]
    yield _gauge("jobs_waiting", "Jobs that wait for a worker", labels, waiting)
    running = [(of, float(pool.running)) for of, pool in pools]
    yield _gauge("jobs_running", "Jobs that workers have", labels, running)
    text = "How long the job that waits longest has been waiting"
    yield _gauge("jobs_wait_seconds", text, labels, [(of, pool.oldest_wait_s) for of, pool in pools])
    workers = {
        (*of, _label(space)): float(number)
        for of, pool in pools
        for space, number in list(pool.workers.items())[:MOST_SPACES]
    }
    yield _gauge("workers", "Workers alive, by embedding space", (*labels, "space"), workers.items())


def _of_roles(found: Found) -> Iterator[Metric]:
    heard = [((_label(one.service), _label(one.instance)), 1.0) for one in found.processes[:MOST_PROCESSES]]
    silent = [((_label(one["service"]), _label(one["instance"])), 0.0) for one in found.silent[:MOST_PROCESSES]]
    text = "Whether a process that exists answers: 0 = it hangs, was stopped or is cut off"
    yield _gauge("process_answers", text, ("service", "process"), dict(heard + silent).items())
    holders = list(found.holders().items())[:MOST_ROLES]
    number = [((_label(service), _label(robot)), float(len(several))) for (robot, service), several in holders]
    yield _gauge("in_charge_processes", "Processes in charge of a robot's service", ("service", "robot"), number)
    epochs = [
        ((_label(service), _label(one.instance), _label(robot)), one.epoch / 1e9)
        for (robot, service), several in holders
        for one in sorted(several)[:MOST_SPACES]
    ]
    text = "Epoch of who is in charge; about when it came to be"
    yield _gauge("in_charge_epoch_timestamp_seconds", text, OF_PROCESS, epochs)
    waiting: dict[tuple[str, ...], float] = {}
    for one in found.standings:
        if one.holder is None and len(waiting) < MOST_ROLES:
            role = (_label(one.service), _label(one.robot))
            waiting[role] = waiting.get(role, 0.0) + 1.0
    text = "Processes that wait for the end of the one in charge"
    yield _gauge("in_charge_waiting_processes", text, ("service", "robot"), waiting.items())


def _process(one: ServiceStatus) -> tuple[str, ...]:
    return _label(one.service), _label(one.instance), _label(one.robot)


def _label(text: str) -> str:
    return shown(text)[:LONGEST_LABEL]


Rows = Iterable[tuple[tuple[str, ...], float]]  # labels and value; of several with the same labels the last is told


def _gauge(name: str, text: str, labels: Sequence[str], rows: Rows) -> Metric:
    family = GaugeMetricFamily(PREFIX + name, f"{text}.", labels=labels)
    for values, value in dict(rows).items():
        family.add_metric(values, value)
    return family


def _counter(name: str, text: str, labels: Sequence[str], rows: Rows) -> Metric:
    family = CounterMetricFamily(PREFIX + name, f"{text}.", labels=labels)
    for values, value in dict(rows).items():
        family.add_metric(values, value)
    return family


def _histogram(
    name: str, text: str, labels: Sequence[str], rows: Iterable[tuple[tuple[str, ...], Histogram]]
) -> Metric:
    family = HistogramMetricFamily(PREFIX + name, f"{text}.", labels=labels)
    for values, one in dict(rows).items():
        bounds = [*map(floatToGoString, one.bounds_s), "+Inf"]
        family.add_metric(values, list(zip(bounds, accumulate(one.counts), strict=True)), one.sum_s)
    return family
