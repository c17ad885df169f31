"""What is let in: payloads that are messages, on the keys they belong to. The rest is counted, logged and dropped."""

import logging
from collections.abc import Callable

from prior_sg.schemas.codec import DecodeError, Message, decode
from prior_sg.services.runtime.host.inbox import Inbox

log = logging.getLogger(__name__)


class Door:
    """Of one service; used by any thread."""

    def __init__(self, inbox: Inbox) -> None:
        self._inbox = inbox

    def admitted(
        self,
        kind: type[Message],
        payload: bytes,
        *,
        name: str,
        key: str,
        fault_of: Callable[[Message], str],
        writer: str = "",
    ) -> Message | None:
        """The message; None after counting and logging that it is malformed, or why it does not belong on its key."""
        try:
            message = decode(kind, payload)
        except DecodeError as error:
            self._refuse("malformed message dropped", name, key, str(error), writer)
            return None
        if fault := fault_of(message):
            self._refuse("message on a key that is not its own dropped", name, key, fault, writer)
            return None
        return message

    def refused(self, name: str, key: str, why: str, writer: str) -> None:
        """Count and log a message that the service itself would not take."""
        self._refuse("message refused", name, key, why, writer)

    def _refuse(self, event: str, name: str, key: str, why: str, writer: str) -> None:
        self._inbox.of(name).malformed += 1
        log.warning(event, extra={"topic": name, "key": key, "writer": writer, "why": why[:200]})
