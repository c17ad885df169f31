"""Where questions to a service wait, and how they are answered: they change nothing."""

import logging
import threading
from collections.abc import Callable
from functools import partial

from prior_sg.schemas.codec import Message, encode
from prior_sg.schemas.topics import Query
from prior_sg.services.refusals import NotYet
from prior_sg.services.runtime.bus import Request
from prior_sg.services.runtime.host.door import Door
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.host.items import Question

log = logging.getLogger(__name__)
MOST_QUESTIONS = 256  # that wait in one service


class Answering:
    """Of one host."""

    def __init__(self, inbox: Inbox, door: Door) -> None:
        self._inbox, self._door = inbox, door
        self._room = threading.Semaphore(MOST_QUESTIONS)

    def receive(self, query: Query, request: Request) -> None:
        """Somebody asks, on a foreign thread. Questions come before inputs: whoever asks waits."""
        if self._room.acquire(blocking=False):
            self._inbox.put(Question(query, request), first=True)
        else:
            request.refuse(f"{MOST_QUESTIONS} questions wait here already; ask again later")

    def reply(self, question: Question, answer: Callable[[Message], Message]) -> None:
        """Answer one, or say why not."""
        query, asked = question.query, question.request
        self._room.release()
        fault_of = partial(query.fault_of, asked.key)
        request = self._door.admitted(query.request, asked.payload, name=query.name, key=asked.key, fault_of=fault_of)
        if request is None:
            asked.refuse(f"the request is not a valid {query.request.__name__} for {asked.key}")
            return
        self._inbox.of(query.name).consumed += 1
        try:
            payload = encode(answer(request))
        except NotYet as error:
            asked.refuse(f"{query.name}: {error}")
            return
        except Exception as error:  # an answer changes no state: a question it cannot take must not end the service
            log.exception("question not answered", extra={"query": query.name})
            asked.refuse(f"{query.name}: {error}")
            return
        asked.reply(payload)
