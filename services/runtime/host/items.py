"""What comes to a service beside samples and replies."""

from dataclasses import dataclass

from prior_sg.schemas.codec import Message
from prior_sg.schemas.topics import Query
from prior_sg.services.runtime.bus import Request


@dataclass(frozen=True)
class Question:
    """Somebody's question to this service."""

    query: Query
    request: Request


@dataclass(frozen=True)
class Work:
    """A job to do for a dispatcher."""

    request: Request
    message: Message | None  # None = malformed


@dataclass(frozen=True)
class LastWord:
    """This process is to end here: another takes over."""
