"""What goes wrong for those who ask through a door, beside what the client raises."""

from prior_sg.services.errors import PriorSgError


class FaultyRequestError(PriorSgError):
    """What was asked can never be answered; the message says why."""


class BusyError(PriorSgError):
    """Too much of this kind goes on at the moment."""
