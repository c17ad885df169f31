"""A few thousand damaged inputs for each decoder, and all that once were too much."""

import logging
import signal
import time

import pytest

from tests.fuzz import child
from tests.fuzz.decoders import DECODERS
from tests.fuzz.trial import CORPUS, Decoder, Tally, tried

IN_ALL = 8_000
WHOLE = sum(decoder.share for decoder in DECODERS)


@pytest.fixture(autouse=True)
def _quiet():
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("decoder", DECODERS, ids=lambda decoder: decoder.name)
def test_damaged_inputs_are_taken_or_refused(decoder):
    seeds = decoder.seeds()
    begun = Tally()
    assert all([begun.run(decoder, seed) for seed in seeds])
    tally = tried(decoder, max(200, int(IN_ALL * decoder.share / WHOLE)), 1)
    assert not tally.crashes
    assert tally.accepted > 0 < tally.refused


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("decoder", [decoder for decoder in DECODERS if decoder.corpus()], ids=lambda d: d.name)
def test_what_was_once_too_much_is_taken_or_refused(decoder):
    tally = Tally()
    for path in decoder.corpus():
        tally.run(decoder, path.read_bytes())
    assert tally.inputs and not tally.crashes


def test_every_folder_of_the_corpus_is_of_a_decoder():
    assert {path.name for path in CORPUS.iterdir()} <= {decoder.name for decoder in DECODERS}


def broken(data):
    if data == b"raises":
        raise KeyError("x")
    while data == b"hangs":
        time.monotonic()
    return bytearray(b"x") * (600 << 20 if data == b"grows" else 1)


@pytest.mark.parametrize(("data", "crashed"), [(b"fine", 0), (b"raises", 1), (b"grows", 1), (b"hangs", None)])
def test_what_is_too_much_is_seen(data, crashed, tmp_path, monkeypatch):
    monkeypatch.setattr(child, "HANG_S", 0.3 if crashed is None else 60.0)
    decoder = Decoder("broken", lambda: [b"first", data], broken)
    ledger = child.Ledger()
    pid = child.start(child.Watch(decoder, ledger, tmp_path), child.plainly, 2, 1)
    status = child.ended(pid, 60)
    tally, is_whole, last = ledger.read()
    assert last == data
    assert (is_whole, status) == ((False, -signal.SIGPROF) if crashed is None else (True, 0))
    assert crashed is None or tally.crashed == crashed == len(list(tmp_path.rglob("*.input")))
