"""Spans to whoever collects them, by OTLP over HTTP."""

import os
import threading
from collections.abc import Sequence
from functools import lru_cache

from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import Event, ReadableSpan
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import Link, SpanContext, SpanKind, Status, StatusCode, TraceFlags

from prior_sg.deploy.errors import UsageError, UserError
from prior_sg.deploy.watching.spans import Span, Traces
from prior_sg.schemas.status import Passage, ServiceStatus
from prior_sg.services.runtime.bus import TRACEPARENT

VARIABLES = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
SAMPLED = TraceFlags(TraceFlags.SAMPLED)
MOST_RESOURCES = 256
CLOSE_S = 3.0


class Export:
    """A tap of a follower: passages become spans, which a thread of their own sends; what a collector that is away
    cannot take is dropped beyond what the library's queue holds."""

    def __init__(self, endpoint: str) -> None:
        exporter = OTLPSpanExporter(endpoint=f"{endpoint.rstrip('/')}/v1/traces") if endpoint else OTLPSpanExporter()
        self._traces, self._processor = Traces(), BatchSpanProcessor(exporter)

    def __call__(self, passages: Sequence[tuple[ServiceStatus, Passage]]) -> None:
        """Send what is new; what was published is known before those who read it."""
        for status, passage in sorted(passages, key=lambda pair: pair[1].ended_ns):
            for span in self._traces.of(status, passage):
                self._processor.on_end(readable(span))

    def close(self) -> None:
        """Send what waits, but not for longer than `CLOSE_S`: a collector that is away ends nothing later."""
        closer = threading.Thread(target=self._processor.shutdown, daemon=True)
        closer.start()
        closer.join(CLOSE_S)


def endpoint_in_force(given: str) -> str:
    """The collector given, else "", where the environment names one. Raises UserError where neither does."""
    if given.startswith(("http://", "https://")):
        return given
    if given:
        raise UsageError(f"{given!r} is no collector of traces: give its address, such as http://localhost:4318")
    if not any(map(os.environ.get, VARIABLES)):
        raise UserError(f"no collector of traces is named: give --trace http://HOST:4318, or set {VARIABLES[1]}")
    return ""


def readable(span: Span) -> ReadableSpan:
    """As OpenTelemetry's library has it."""
    error = Status(StatusCode.ERROR, span.fault) if span.fault else Status(StatusCode.UNSET)
    return ReadableSpan(
        name=span.name,
        context=SpanContext(span.trace_id, span.span_id, is_remote=False, trace_flags=SAMPLED),
        parent=SpanContext(span.trace_id, span.parent_id, is_remote=True, trace_flags=SAMPLED)
        if span.parent_id
        else None,
        resource=_resource(span.service, span.instance),
        attributes=span.attributes,
        events=[Event(f"published {topic}", timestamp=span.end_ns) for topic in span.published],
        links=[_link(span.link)] if TRACEPARENT.fullmatch(span.link) else (),
        kind=SpanKind.CONSUMER if span.attributes else SpanKind.INTERNAL,
        status=error,
        start_time=span.start_ns,
        end_time=span.end_ns,
    )


def _link(traceparent: str) -> Link:
    _, trace, parent, flags = traceparent.split("-")
    return Link(SpanContext(int(trace, 16), int(parent, 16), is_remote=True, trace_flags=TraceFlags(int(flags, 16))))


@lru_cache(MOST_RESOURCES)
def _resource(service: str, instance: str) -> Resource:
    return Resource({"service.namespace": "prior-sg", "service.name": service, "service.instance.id": instance})
