"""Decoders that several threads ask for at the same moment: built by one, before anybody decodes with them."""

import os
import subprocess
import sys

from tests.help.paths import ROOT

HAMMER = """
import faulthandler, sys, threading, time
from prior_sg.schemas import codec

faulthandler.enable()
sys.setswitchinterval(1e-6)
SOURCE = '''
import msgspec
from prior_sg.schemas.codec import Message
class Inner(msgspec.Struct):
    a: int = 0
    b: str = ""
    c: list[float] = []
class Outer(Message, kw_only=True):
    x: Inner
    y: list[Inner]
    z: dict[str, Inner]
class Other(Message, kw_only=True):
    outer: Outer
    inner: Inner
'''
OUTER = {"x": {"a": 1}, "y": [{"a": 2}], "z": {"q": {"a": 3}}}
PAYLOADS = {"Outer": codec.encode_plain(OUTER), "Other": codec.encode_plain({"outer": OUTER, "inner": {"a": 4}})}
end_s, rounds, faults = time.monotonic() + float(sys.argv[1]), 0, []
while time.monotonic() < end_s or rounds < 20:
    names = {}
    exec(SOURCE, names)
    gate = threading.Barrier(6)

    def work(name):
        gate.wait()
        try:
            codec.decode(names[name], PAYLOADS[name])
        except Exception as error:
            faults.append(repr(error))

    threads = [threading.Thread(target=work, args=(name,)) for name in ("Outer", "Other") * 3]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    rounds += 1
print(rounds, faults[:3])
sys.exit(bool(faults))
"""

FIRST_USE = """
import threading
import prior_sg.schemas.topics
from prior_sg.schemas import codec

built = set(codec._decoders)
missing = [kind.__name__ for kind in codec.message_types() if kind not in built]
assert not missing, missing
assert threading.active_count() == 1
"""


def run(source, *arguments):
    return subprocess.run(
        [sys.executable, "-c", source, *arguments],
        check=False, capture_output=True, text=True, timeout=60, env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
    )  # fmt: skip


def test_threads_that_want_a_new_decoder_at_once_do_not_crash():
    for _ in range(3):
        ended = run(HAMMER, "1.0")
        assert ended.returncode == 0, f"{ended.returncode}: {ended.stdout}{ended.stderr[-2000:]}"


def test_the_topic_table_brings_every_decoder_before_any_thread():
    ended = run(FIRST_USE)
    assert ended.returncode == 0, ended.stderr
