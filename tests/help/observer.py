"""Counts what reaches a host of a robot's topics, until it is ended: observer.py ENDPOINT ROBOT FILE"""

import json
import signal
import statistics
import sys
import threading
import time
from pathlib import Path

from prior_sg.schemas.topics import TOPICS
from prior_sg.services.runtime.zenoh_bus import ZenohBus


def main():
    endpoint, robot, file = sys.argv[1:]
    seen = {topic.name: [] for topic in TOPICS}  # (bytes, age in ms) of each message
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    bus = ZenohBus(endpoint)

    def see(sample):
        seen[sample.topic.name].append((len(sample.payload), (time.time_ns() - sample.sent_ns) / 1e6))

    for topic in TOPICS:
        if topic.delivery != "job" and "{robot}" in topic.key:
            bus.subscribe(topic, topic.pattern(robot), see, lambda *_: None)
    ended.wait()
    bus.close()
    told = {
        name: {
            "messages": len(rows),
            "bytes": sum(size for size, _ in rows),
            "ms_p50": round(statistics.median(age for _, age in rows), 1),
            "ms_max": round(max(age for _, age in rows), 1),
        }
        for name, rows in seen.items()
        if rows
    }
    Path(file).write_text(json.dumps(told))


if __name__ == "__main__":
    main()
