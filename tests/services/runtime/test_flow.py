"""Back-pressure: who is waited for, and for how long."""

import asyncio
import itertools
import math

from prior_sg.schemas.codec import encode
from prior_sg.schemas.status import Consumed, Started
from prior_sg.schemas.succession import Succession, TakesOver
from prior_sg.schemas.topics import JOURNAL
from prior_sg.services.runtime.bus import Answer, Sample
from prior_sg.services.runtime.host.asks import answer_to
from prior_sg.services.runtime.host.door import Door
from prior_sg.services.runtime.host.flow import STANDBY_S, STUCK_S, Progress
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.host.readers import Readers


def progress_at(clock):
    return Progress(lambda: clock[0])


def test_a_reader_counts_once_it_is_alive_and_no_longer_when_it_is_gone():
    progress = progress_at([0.0])
    progress.reader("claimed", ["T"])
    assert progress.lag("T") == math.inf
    progress.reader("real", ["T"])
    progress.alive("real", True)
    progress.published("T", 4)
    progress.consumed("real", "T", 3)
    assert progress.lag("T") == 1
    progress.alive("real", False)
    assert progress.lag("T") == math.inf


def test_a_reader_that_only_claims_to_exist_is_not_waited_for_without_bound(caplog):
    clock = [0.0]
    progress = progress_at(clock)
    for name in ("real", "claimed"):
        progress.reader(name, ["T"])
        progress.alive(name, True)
    for number in range(6):
        progress.published("T", number)
        clock[0] += STUCK_S / 4
        progress.consumed("real", "T", number)
        assert progress.lag("T") == (number + 1 if number < 4 else 0)
    assert "waited for no longer" in caplog.text and len(caplog.records) == 1
    progress.consumed("claimed", "T", 3)  # it was only slow
    assert progress.lag("T") == 2


def test_a_reader_that_had_nothing_to_do_is_not_stuck():
    clock = [0.0]
    progress = progress_at(clock)
    progress.reader("a", ["T"])
    progress.alive("a", True)
    progress.published("T", 0)
    progress.consumed("a", "T", 0)
    clock[0] += 10 * STUCK_S
    progress.published("T", 1)
    assert progress.lag("T") == 1


def test_one_that_stands_by_slows_the_stream_down_and_does_not_stop_it():
    clock = [0.0]
    progress = progress_at(clock)
    for name in ("serves", "heir"):
        progress.reader(name, ["T"])
        progress.alive(name, True)
    progress.stands_by("heir", True)
    progress.published("T", 40)
    progress.consumed("serves", "T", 40)
    assert progress.lag("T") == 41  # a moment's pause for the heir, which has seen nothing
    clock[0] += STANDBY_S
    assert progress.lag("T") == 0
    progress.consumed("heir", "T", 38)
    progress.stands_by("heir", False)
    assert progress.lag("T") == 2  # in charge, it is waited for as any other
    progress.stands_by("heir", True)
    progress.alive("serves", False)
    assert progress.lag("T") == math.inf  # nobody else serves


class Heard:
    """A bus on which a test speaks."""

    def subscribe(self, topic, pattern, on_sample, on_miss):
        self.says = on_sample

    def watch(self, pattern, on_change):
        self.alive = on_change


def test_the_journal_tells_who_stands_by():
    async def main():
        clock, heard = [0.0], Heard()
        progress, inbox = progress_at(clock), Inbox(wake=lambda: None)
        readers = Readers(inbox, Door(inbox), progress, asyncio.get_running_loop(), writer="ingest/i/1")
        readers.follow(heard, "r")
        orders = itertools.count()

        def journals(topic, told):
            order, key = next(orders), JOURNAL.key.format(robot="r")
            entry = Consumed(robot="r", service="s", instance="heir", order=order, topic=topic, inline=encode(told))
            heard.says(Sample(JOURNAL, key, encode(entry), "s/heir/2", order, 0))

        heard.alive("psg/alive/s/heir", True)
        journals("START", Started(robot="r", service="s", instance="heir", epoch=2, config=b"{}", reads=["T"]))
        progress.published("T", 7)
        clock[0] += STANDBY_S
        assert progress.lag("T") == 8
        journals("Succession", Succession(predecessor="former"))
        assert progress.lag("T") == math.inf  # not waited for, and no other is there
        journals("TakesOver", TakesOver())
        assert progress.lag("T") == 8
        journals("Succession", Succession())  # the former is gone: nobody serves meanwhile
        assert progress.lag("T") == 8

    asyncio.run(main())


class Slow:
    """A bus that answers when the test says so."""

    def call(self, key, request, timeout_s, on_answer):
        self.answer = on_answer


def test_an_answer_that_nobody_waits_for_any_more_is_let_go():
    async def main():
        faults, bus = [], Slow()
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: faults.append(context))
        asking = asyncio.create_task(answer_to(bus, "k", b"", 1.0))
        while not hasattr(bus, "answer"):
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.01)
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        bus.answer(Answer(b"late", ""))
        await asyncio.sleep(0.01)
        assert not faults

    asyncio.run(main())
