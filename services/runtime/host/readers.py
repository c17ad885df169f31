"""How far those who read what a source writes are: heard from their journals, and from who is alive."""

import asyncio
from functools import partial

from prior_sg.schemas.status import Consumed, Started
from prior_sg.schemas.succession import Succession, TakesOver
from prior_sg.schemas.topics import JOURNAL, alive_key
from prior_sg.services.runtime.bus import Bus, Sample
from prior_sg.services.runtime.host.door import Door
from prior_sg.services.runtime.host.flow import Progress
from prior_sg.services.runtime.host.inbox import Inbox


class Readers:
    """Of one host. `writer` is the name it writes by."""

    def __init__(
        self, inbox: Inbox, door: Door, progress: Progress, loop: asyncio.AbstractEventLoop, *, writer: str
    ) -> None:
        self._inbox, self._door, self._progress, self._loop, self._writer = inbox, door, progress, loop, writer

    def follow(self, bus: Bus, robot: str) -> None:
        """Listen from now on."""
        bus.subscribe(JOURNAL, JOURNAL.pattern(robot), self._saw_consumed, lambda topic, number: None)
        bus.watch(alive_key("*", "*"), self._saw_alive)

    def _saw_consumed(self, sample: Sample) -> None:
        if not self._inbox.allows(sample):
            return
        admitted = partial(self._door.admitted, name=JOURNAL.name, key=sample.key, writer=sample.writer)
        match admitted(Consumed, sample.payload, fault_of=partial(JOURNAL.fault_of, sample.key)):
            case Consumed(topic="START") as entry:
                started = admitted(Started, entry.inline, fault_of=lambda started: "")
                if isinstance(started, Started):
                    self._progress.reader(entry.instance, started.reads)
            case Consumed(topic=Succession.__name__) as entry:
                succession = admitted(Succession, entry.inline, fault_of=lambda told: "")
                if isinstance(succession, Succession):
                    self._progress.stands_by(entry.instance, bool(succession.predecessor))
            case Consumed(topic=TakesOver.__name__) as entry:
                self._progress.stands_by(entry.instance, False)
            case Consumed() as entry:
                own = entry.writer == self._writer
                self._progress.consumed(entry.instance, entry.topic, entry.sequence if own else -1)
        self._progress.changed(self._loop)

    def _saw_alive(self, key: str, alive: bool) -> None:
        self._progress.alive(key.rsplit("/", 1)[-1], alive)
        self._progress.changed(self._loop)
