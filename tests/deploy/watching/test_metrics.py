"""What Prometheus is told, and what dashboard, alarms and their table make of it."""

import contextlib
import json
import math
import re
import time

import httpx
import yaml
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from prior_sg.deploy.inspecting import health
from prior_sg.deploy.inspecting.health import Found, Remark
from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.deploy.watching import metrics
from prior_sg.deploy.watching.follower import Follower, Picture
from prior_sg.deploy.watching.latency import MOST_ROBOTS, Latencies
from prior_sg.deploy.watching.metrics import Collector
from prior_sg.schemas.codec import encode
from prior_sg.schemas.status import Loss, TopicCount
from prior_sg.schemas.topics import WAITING, alive_key, lease_key, status_key
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.host.lease import standing
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.deploy.serving.test_process import free_port
from tests.help.paths import ROOT
from tests.help.telling import everything, journey, passage, status

NAME = re.compile(r"\bprior_sg_\w+")
ALERTS = ROOT / "deploy/prometheus/alerts.yml"


def told(found, latencies=None, at_s=0.0):
    """Text of the metrics of a picture, and its samples by name and labels, these in the order of their names."""

    class Still:
        picture = Picture(found, at_s)

    registry = CollectorRegistry()
    registry.register(Collector(Still(), latencies or Latencies()))
    text = generate_latest(registry).decode()
    samples = [one for family in text_string_to_metric_families(text) for one in family.samples]
    keys = [(one.name, tuple(sorted(one.labels.items()))) for one in samples]
    assert len(set(keys)) == len(keys), "Prometheus refuses a scrape with a sample that repeats"
    return text, {(one.name, *(value for _, value in sorted(one.labels.items()))): one.value for one in samples}


def standings():
    return [standing(lease_key("ada", "segmenter", *one)) for one in ((str(2 * 10**9), "segmenter-1"), (WAITING, "b"))]


def test_every_figure_of_a_status_is_told():
    latencies = Latencies()
    latencies.follow(passage for _, passage in journey())
    loss = Loss(what="frames refused", reason="dark", count=3, example="e")
    found = Found(
        [everything(), status(losses=[loss])], [{"service": "x", "instance": "x-1", "error": ""}], standings()
    )
    _, values = told(found, latencies)
    of = ("ingest-1", "ada", "ingest")
    assert values["prior_sg_jobs_waiting", *of, "ENCODE"] == 4
    assert values["prior_sg_jobs_wait_seconds", *of, "ENCODE"] == 6.5
    assert values["prior_sg_workers", *of, "conse", "ENCODE"] == 2
    assert values["prior_sg_process_resident_memory_bytes", *of] == 100e6
    assert values["prior_sg_process_cpu_seconds_total", *of] == 4.5
    assert values["prior_sg_backlog_inputs", *of] == 3
    assert values["prior_sg_messages_published_total", *of, "KEYFRAME"] == 5
    assert values["prior_sg_messages_missed_total", *of, "KEYFRAME"] == 1
    assert values["prior_sg_message_age_seconds", *of, "KEYFRAME"] == 0.02
    assert values["prior_sg_step_duration_seconds_bucket", "0.001", *of] == 2
    assert values["prior_sg_step_duration_seconds_count", *of] == 3
    assert values["prior_sg_step_duration_seconds_sum", *of] == 12
    assert values["prior_sg_step_running_seconds", *of] == 9 and values["prior_sg_step_compiling_seconds", *of] == 8
    assert values["prior_sg_losses_total", "segmenter-1", "dark", "ada", "segmenter", "frames refused"] == 3
    assert values["prior_sg_store_file_bytes", *of] == 10
    assert values["prior_sg_process_answers", "x-1", "x"] == 0
    assert values["prior_sg_process_answers", "ingest-1", "ingest"] == 1
    assert values["prior_sg_in_charge_processes", "ada", "segmenter"] == 1
    assert values["prior_sg_in_charge_waiting_processes", "ada", "segmenter"] == 1
    assert values["prior_sg_in_charge_epoch_timestamp_seconds", "segmenter-1", "ada", "segmenter"] == 2
    # published at 10.2, regions at 11.7
    assert values["prior_sg_keyframe_to_region_seconds_sum", "ada"] == 1.5
    assert values["prior_sg_keyframe_to_region_seconds_bucket", "1.0", "ada"] == 0
    assert values["prior_sg_keyframe_to_region_seconds_bucket", "3.0", "ada"] == 1


def test_strangers_make_no_more_labels_than_the_limits():
    topics = [TopicCount(topic=f"T{number}") for number in range(1000)]
    losses = [Loss(what="w" * 500, reason=f"\n{number}", count=1, example="") for number in range(1000)]
    many = [status(instance=f"i{number:04}", topics=topics, losses=losses) for number in range(1000)]
    _, values = told(Found([*many, *many]))
    assert len({key[1] for key in values if key[0] == "prior_sg_backlog_inputs"}) == metrics.MOST_PROCESSES
    assert values["prior_sg_processes_left_out",] == 2000 - metrics.MOST_PROCESSES
    assert len([1 for key in values if key[:2] == ("prior_sg_losses_total", "i0000")]) <= 32
    assert not [key for key in values if "T1" in key] and max(len(part) for key in values for part in key) <= 100
    latencies = Latencies()
    for number in range(1000):
        robot = {"robot": f"r{number}"}
        latencies.follow([passage("frame", 1, frame_id=1, published={"KEYFRAME": -1}, **robot)])
        latencies.follow([passage("PYRAMID", 2, frame_id=1, published={"REGION_DELTA": 1}, **robot)])
    assert len(latencies.by_robot) == MOST_ROBOTS


def test_a_system_that_cannot_be_asked_is_told_by_the_age_of_the_picture():
    _, values = told(Found(), at_s=None)
    assert math.isinf(values["prior_sg_picture_age_seconds",])


def exported():
    latencies = Latencies()
    latencies.follow(passage for _, passage in journey())
    loss = Loss(what="w", reason="r", count=1, example="")
    text, _ = told(Found([everything(), status(losses=[loss])], [], standings()), latencies)
    labels = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels.setdefault(sample.name, set()).update(sample.labels)
    return labels


def queries():
    board = json.loads((ROOT / "deploy/grafana/prior-sg.json").read_text())
    for panel in board["panels"]:
        for target in panel.get("targets", ()):
            yield panel["title"], target["expr"], target["legendFormat"]
    for rule in rules():
        yield rule["alert"], rule["expr"], ""


def rules():
    return yaml.safe_load(ALERTS.read_text())["groups"][0]["rules"]


def test_every_query_of_dashboard_and_alarms_is_about_what_is_exported():
    labels = exported()
    for title, expression, legend in queries():
        names = NAME.findall(expression)
        assert names and set(names) <= set(labels), title
        known = set().union(*(labels[name] for name in names))
        asked = {word for by in re.findall(r"(?:by|on) \(([\w, ]+)\)", expression) for word in by.split(", ")}
        asked |= {word for inside in re.findall(r"{([^}]*)}", expression) for word in re.findall(r"(\w+)=", inside)}
        assert asked | set(re.findall(r"{{(\w+)}}", legend)) <= known, title


def test_the_table_of_alarms_is_that_of_the_rules_and_of_health():
    text = (ROOT / "docs/operations.md").read_text().partition("\n## Alarms\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(PriorSg\w+)` \| (\w+) \| .+ \| (.+) \|$", text, re.MULTILINE)
    assert rows == [(one["alert"], one["labels"]["severity"], one["annotations"]["description"]) for one in rules()]
    source = (ROOT / "deploy/inspecting/health.py").read_text()
    named = set(re.findall(r'"(PriorSg\w+)"', source))
    assert len(named) >= 9 and named <= {one["alert"] for one in rules()}
    assert Remark("", True).alarm == ""


def test_limits_of_health_are_those_of_the_alarms():
    expressions = {one["alert"]: one["expr"] for one in rules()}
    for alarm, limit in (
        ("PriorSgStepHangs", health.LONG_STEP_S),
        ("PriorSgBehind", health.LONG_WAIT_S),
        ("PriorSgJobsWait", health.LONG_WAIT_S),
        ("PriorSgDiskFull", health.LEAST_FREE_B),
    ):
        assert float(re.search(r"[<>] ([\de.]+)", expressions[alarm])[1]) == limit, alarm


def test_metrics_of_a_running_system_come_over_http(endpoint, tmp_path):
    with BusClient(ZenohBus(endpoint)) as service:
        told = encode(everything())
        service.bus.serve(status_key("ingest", "ingest-1"), lambda request: request.reply(told))
        service.bus.announce(alive_key("ingest", "ingest-1"))
        supervisor, port = Supervisor(endpoint, "ada", tmp_path / "logs"), free_port()
        arguments = ["--host", "127.0.0.1", "--port", str(port)]
        supervisor.start_door("metrics", "prior_sg.deploy.watching.process", arguments)
        try:
            end_s, text = time.monotonic() + 60, ""
            while 'prior_sg_jobs_waiting{process="ingest-1"' not in text:
                assert time.monotonic() < end_s and supervisor.check() == [], supervisor.children[0].last_words()
                time.sleep(0.2)
                with contextlib.suppress(httpx.ConnectError):
                    text = httpx.get(f"http://127.0.0.1:{port}/metrics", timeout=10).text
            alien = httpx.get(f"http://127.0.0.1:{port}/metrics", headers={"host": "evil.example"}, timeout=10)
            assert alien.status_code == 421
        finally:
            supervisor.stop()


def test_a_follower_tells_each_passage_once_and_outlives_nonsense(endpoint, monkeypatch):
    monkeypatch.setattr("prior_sg.deploy.watching.follower.PERIOD_S", 0.05)
    seen, answers = [], []
    now_ns = time.time_ns()
    passages = [passage("KEYFRAME", now_ns / 1e9 + number, frame_id=number) for number in range(1, 4)]

    def answer(request):
        answers.append(1)
        if len(answers) == 2:
            request.reply(b"nonsense")
        else:
            request.reply(encode(status(passages=passages, clock_ns=now_ns)))

    with BusClient(ZenohBus(endpoint)) as service, BusClient(ZenohBus(endpoint)) as asker:
        service.bus.serve(status_key("segmenter", "segmenter-1"), answer)
        service.bus.announce(alive_key("segmenter", "segmenter-1"))

        def tap(fresh):
            seen.extend(one.frame_id for _, one in fresh)
            if len(answers) == 1:
                raise ValueError("a tap that fails")

        follower = Follower(asker, taps=[tap])
        end_s = time.monotonic() + 30
        while len(answers) < 5 and time.monotonic() < end_s:
            time.sleep(0.05)
        follower.close()
    assert len(answers) >= 5 and follower.picture.failures == 1
    assert seen == [1, 2, 3]
