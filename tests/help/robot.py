"""A robot of ROS 2 that plays a recording's messages on a Zenoh router, as rmw_zenoh would send them."""

import struct
import threading
import time
from contextlib import contextmanager

from prior_sg.services.ingest.sources.ros.reader import robot_types
from prior_sg.services.runtime.ros.session import RosSession
from prior_sg.services.runtime.ros.wire import SUBSCRIPTION, Channel, Quality

BEFORE_S, ROUND_S = 50_000, 20  # how far before the recording a rehearsal's stamps lie, and its rounds from each other


def shifted(data, topic, seconds):
    """A message with another stamp; of transforms the first one's."""
    changed, place = bytearray(data), 8 if topic.startswith("/tf") else 4
    struct.pack_into("<i", changed, place, struct.unpack_from("<i", changed, place)[0] + seconds)
    return bytes(changed)


class Robot:
    """Plays messages (topic, time of arrival, message) in their order."""

    def __init__(self, endpoint, maker, domain):
        self.session = RosSession(endpoint, "robot", domain)
        self.sent = [
            (topic, bytes(maker.store.serialize_cdr(message, message.__msgtype__)))
            for topic, _, message in sorted(maker.messages, key=lambda entry: entry[1])
        ]
        self.publishers, self.heard = {}, []
        types = robot_types()
        for topic, _, message in maker.messages:
            if topic not in self.publishers:
                quality = Quality(10, latched=topic == "/tf_static")
                channel = Channel(topic, message.__msgtype__, types.hash(message.__msgtype__), quality)
                self.publishers[topic] = self.session.publisher(channel)
        self.session.watch(self._seen)

    def _seen(self, entity, alive):
        if entity.kind == SUBSCRIPTION and alive:
            self.heard.append((entity.session, entity.channel.name))

    def play(self, pause_s=0.002, seconds=0, statics=True):
        """All messages once, with stamps moved by some seconds."""
        for topic, data in self.sent:
            if statics or topic != "/tf_static":
                self.publishers[topic].publish(shifted(data, topic, seconds) if seconds else data)
                time.sleep(pause_s)

    @contextmanager
    def rehearsing(self):
        """Plays again and again, long before the recording's stamps, while a reader has a look."""
        done = threading.Event()

        def rehearse():
            for number in range(1_000):
                if done.is_set():
                    return
                self.play(seconds=number * ROUND_S - BEFORE_S, statics=number == 0)

        thread = threading.Thread(target=rehearse, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def wait_for_reader(self, topics, timeout_s=30.0):
        """Until somebody new listens to all of these topics."""
        before, end_s = {session for session, _ in self.heard}, time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            readers = {session for session, _ in self.heard} - before
            if any({(reader, topic) for topic in topics} <= set(self.heard) for reader in readers):
                time.sleep(0.1)  # for its subscriptions to reach this session
                return
            time.sleep(0.01)
        raise AssertionError(f"nobody listens to {topics}")

    def close(self):
        self.session.close()
