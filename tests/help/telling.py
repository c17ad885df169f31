"""What processes tell of themselves, for tests of those who listen."""

from prior_sg.schemas.status import STEP_BOUNDS_S, Passage, PoolCount, ServiceStatus, TopicCount

SECOND_NS = 1_000_000_000


def status(**changes):
    fields = {"service": "segmenter", "instance": "segmenter-1", "robot": "ada", "pid": 7, "uptime_s": 1.0}
    fields |= {"backlog": 3, "busy_share": 0.5, "step_ms_p50": 1.0, "step_ms_p99": 2.0, "resident_mb": 100.0}
    return ServiceStatus(**(fields | {"waiting_for": [], "topics": []} | changes))


def everything():
    """A process that has something to say in every figure."""
    return status(
        service="ingest",
        instance="ingest-1",
        cpu_s=4.5,
        release="1.2.3",
        topics=[TopicCount(topic="KEYFRAME", published=5, missed=1, last_age_ms=20.0)],
        step_counts=[2] + [0] * (len(STEP_BOUNDS_S) - 1) + [1],
        step_sum_s=12.0,
        step_s=9.0,
        step_compiling_s=8.0,
        pools=[PoolCount(topic="ENCODE", waiting=4, running=2, oldest_wait_s=6.5, workers={"conse": 2})],
        figures={"revisions": 9, "file_bytes": 10, "disk_free_bytes": 11},
    )


def passage(topic, start_s, **changes):
    """Received at a second, begun a tenth of it later, ended after another tenth."""
    times = [int((start_s + part) * SECOND_NS) for part in (0, 0.1, 0.2)]
    fields = {"robot": "ada", "topic": topic, "received_ns": times[0], "began_ns": times[1], "ended_ns": times[2]}
    return Passage(**(fields | changes))


def journey(frame_id=4):
    """A keyframe's way from ingest to the store, as (status, passage)."""
    ingest, mapper, worker, segmenter, store = (
        status(service=name, instance=f"{name}-1")
        for name in ("ingest", "place_graph", "feature_pyramid", "segmenter", "scene_store")
    )
    of, stamp = {"frame_id": frame_id}, {"stamp_ns": 99}
    return [
        (ingest, passage("frame", 10, published={"KEYFRAME": -1, "ENCODE": -1}, **of, **stamp)),
        (mapper, passage("KEYFRAME", 10.3, writer="ingest/ingest-1/1", published={"PLACE_DELTA": 7}, **of, **stamp)),
        (worker, passage("ENCODE", 10.4, published={"PYRAMID": -1}, **of, **stamp)),
        (store, passage("PLACE_DELTA", 10.6, revision=7, writer="place_graph/place_graph-1/1", **of, **stamp)),
        (ingest, passage("JobDone", 10.7, worker="feature_pyramid-1", attempts=1, **of)),
        (segmenter, passage("PYRAMID", 10.8, writer="feature_pyramid/feature_pyramid-1/1", **of, **stamp)),
        (segmenter, passage("Tick", 11.5, published={"REGION_DELTA": 3})),
        (store, passage("REGION_DELTA", 11.8, revision=3, writer="segmenter/segmenter-1/1", stamp_ns=99)),
    ]
