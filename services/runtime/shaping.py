"""What a router keeps off its links: messages that are too large anywhere, and over a thin link what can wait or is not
needed beyond. All of it follows from the table of keys.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from prior_sg.schemas.topics import KEYFRAME, QUERIES, TOPICS, worker_keys
from prior_sg.services.runtime.bus import HEADER, LONGEST_WRITER

BEYOND = ("tls",)  # links to other hosts
WAITS_S = 0.25  # how long what is urgent may wait behind what the system has taken already
LEAST_BUFFER = 8192  # bytes
BLOCKED_MS = 30_000  # for which what is bulky may be held up by what overtakes it before the link counts as broken


def size_filters() -> list[dict[str, Any]]:
    """Zenoh's `low_pass_filter`: what the table allows of each message and answer, on its way into the router."""
    limits: list[tuple[tuple[str, ...], str, int]] = [
        (("query",), f"{worker_keys(t, '*')[0]}/*", t.most_bytes) for t in TOPICS if t.delivery == "job"
    ]
    limits += [(("put", "reply"), t.pattern("*"), t.most_bytes) for t in TOPICS if t.delivery != "job"]
    for query in QUERIES:
        key = query.key.format(**{name: "**" if name == "space" else "*" for name in query.request.__struct_fields__})
        limits += [(("query",), key, query.most_bytes), (("reply",), key, query.most_reply_bytes)]
    return [
        {
            "flows": ["ingress"],
            "messages": list(messages),
            "key_exprs": [key],
            "size_limit": most_bytes + HEADER.size + LONGEST_WRITER,
        }
        for messages, key, most_bytes in limits
    ]


def thinned(settings: dict[str, Any], bps: float, robots: Sequence[str]) -> dict[str, Any]:
    """Settings of a router whose links to other hosts carry `bps` bits per second. A short buffer of the system lets
    what is urgent overtake what is bulky, which waits in Zenoh's queues, by priority. States of the moment are passed
    on less often. Keyframes stay on the host where they are made: workers get them as jobs, one each.
    """
    link = settings["transport"]["link"]
    tls = link["tls"] | {"so_sndbuf": max(int(bps / 8 * WAITS_S), LEAST_BUFFER)}
    tx = link["tx"] | {"queue": {"congestion_control": {"block": {"wait_before_close": BLOCKED_MS * 1000}}}}
    return settings | {
        "transport": settings["transport"] | {"link": link | {"tls": tls, "tx": tx}},
        "downsampling": _seldom(robots),
        "low_pass_filter": [*settings["low_pass_filter"], _kept_here()],
    }


def _seldom(robots: Iterable[str]) -> list[dict[str, Any]]:
    """Zenoh's `downsampling`. It counts by rule, not by key: so a rule for each robot."""
    rules = [
        {"key_expr": topic.pattern(robot), "freq": topic.beyond_hz}
        for topic in TOPICS
        if topic.beyond_hz
        for robot in robots
    ]
    return [{"flows": ["egress"], "link_protocols": list(BEYOND), "messages": ["put"], "rules": rules}] if rules else []


def _kept_here() -> dict[str, Any]:
    return {
        "flows": ["egress"],
        "link_protocols": list(BEYOND),
        "messages": ["put", "reply"],
        "key_exprs": [KEYFRAME.pattern("*"), f"{KEYFRAME.pattern('*')}/@adv/**"],  # and what counts its samples
        "size_limit": 0,
    }
