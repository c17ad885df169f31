"""Spans of a keyframe: one trace, each below what made its input; sent to a collector that we did not write."""

import socket
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.watching.otlp import Export
from prior_sg.deploy.watching.spans import MOST_KNOWN, Traces, trace_id
from tests.help.telling import SECOND_NS, journey, passage, status

CONTEXT = f"00-{'ab' * 16}-{'cd' * 8}-01"


def spans_of(pairs):
    traces = Traces()
    return [span for process, one in pairs for span in traces.of(process, one)]


def test_a_keyframe_is_one_trace_in_which_each_step_is_below_what_made_its_input():
    spans = spans_of(journey())
    assert {span.trace_id for span in spans} == {int(trace_id("ada", 4, 99), 16)}
    outer = {span.name: span for span in spans if span.attributes}
    above = {name: next((o.name for o in spans if o.span_id == span.parent_id), "") for name, span in outer.items()}
    assert above == {
        "ingest frame": "",
        "place_graph KEYFRAME": "ingest frame",
        "feature_pyramid ENCODE": "ingest frame",
        "scene_store PLACE_DELTA": "place_graph KEYFRAME",
        "ingest JobDone": "ingest frame",
        "segmenter PYRAMID": "feature_pyramid ENCODE",
    }
    mapper = outer["place_graph KEYFRAME"]
    wait, step = (span for span in spans if span.parent_id == mapper.span_id and not span.attributes)
    assert (wait.name, wait.end_ns - wait.start_ns) == ("wait", SECOND_NS // 10)
    assert (step.name, step.start_ns, step.end_ns) == ("step", wait.end_ns, mapper.end_ns)
    assert len({span.span_id for span in spans}) == len(spans)


def test_regions_told_for_a_keyframe_are_stored_in_its_trace():
    segmenter, store = status(), status(service="scene_store", instance="scene_store-1")
    told = passage("PYRAMID", 1, frame_id=4, stamp_ns=99, published={"REGION_DELTA": 3})
    stored = passage("REGION_DELTA", 2, revision=3, writer="segmenter/segmenter-1/1")
    other = passage("REGION_DELTA", 2, revision=4, writer="segmenter/segmenter-1/1")
    spans = spans_of([(segmenter, told), (store, stored), (store, other)])
    assert [span.name for span in spans if span.attributes] == ["segmenter PYRAMID", "scene_store REGION_DELTA"]
    assert spans[3].parent_id == spans[0].span_id and spans[3].trace_id == spans[0].trace_id


def test_what_is_known_of_keyframes_is_bounded():
    traces = Traces()
    for number in range(MOST_KNOWN + 500):
        one = passage("frame", number, frame_id=number, stamp_ns=number + 1, published={"KEYFRAME": -1})
        list(traces.of(status(), one))
    assert max(len(traces._stamps), len(traces._made_by), len(traces._told)) <= MOST_KNOWN


@pytest.fixture
def collector():
    """What takes OTLP: its address, and the requests it got."""
    got = []

    class Taker(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["content-length"]))
            got.append((self.path, ExportTraceServiceRequest.FromString(body)))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *arguments):
            pass

    server = HTTPServer(("127.0.0.1", 0), Taker)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}", got
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_collector_gets_the_spans_with_links_and_faults(collector):
    address, got = collector
    bad = passage("KEYFRAME", 12, frame_id=5, stamp_ns=5, traceparent=CONTEXT, fault="it has no depth")
    damaged = passage("KEYFRAME", 13, frame_id=6, stamp_ns=6, traceparent="00-zz")
    export = Export(address)
    export([*journey(), (status(), bad), (status(), damaged)])
    export.close()
    assert {path for path, _ in got} == {"/v1/traces"}
    resources = [resource for _, request in got for resource in request.resource_spans]
    names = {a.key: a.value.string_value for resource in resources for a in resource.resource.attributes}
    assert names["service.namespace"] == "prior-sg" and "service.instance.id" in names
    spans = [span for resource in resources for scope in resource.scope_spans for span in scope.spans]
    assert len(spans) == len(spans_of(journey())) + 6
    (faulty,) = (span for span in spans if span.status.message == "it has no depth")
    assert [link.trace_id.hex() for link in faulty.links] == ["ab" * 16]
    published = {event.name for span in spans for event in span.events}
    assert {"published KEYFRAME", "published PYRAMID"} <= published


def test_a_collector_that_is_away_holds_nothing_up(monkeypatch):
    monkeypatch.setattr("prior_sg.deploy.watching.otlp.CLOSE_S", 0.1)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1")
    with socket.socket() as silent:  # takes connections and answers nothing
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        export = Export(f"http://127.0.0.1:{silent.getsockname()[1]}")
        for _ in range(100):
            export(journey())
        export.close()
        sending = [one for one in threading.enumerate() if "Otel" in one.name]
        assert sending, "the answer is not waited for"
    for thread in sending:
        thread.join(60)  # it would log into the next test


def test_traces_need_a_collector_and_metrics(endpoint, capsys, monkeypatch, tmp_path):
    monkeypatch.delenv("OTEL_EXPORTER_OTLP_ENDPOINT", raising=False)
    assert main(["metrics", "--connect", endpoint, "--port", "0", "--trace"]) == 1
    assert "no collector of traces is named" in capsys.readouterr().err
    assert main(["metrics", "--connect", endpoint, "--port", "0", "--trace", "localhost:4318"]) == 2
    assert "is no collector of traces" in capsys.readouterr().err
    assert main(["up", "--out", str(tmp_path), "--trace", "http://localhost:1"]) == 2
    assert "add --metrics" in capsys.readouterr().err
