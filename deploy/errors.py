"""What goes wrong for a user and is told in one sentence."""

from prior_sg.services.errors import PriorSgError


class UserError(PriorSgError):
    """What the user asked cannot be done; the message says what to do instead."""


class UsageError(UserError):
    """A command is put so that it can never be done, whatever runs or lies on the disk; as the parser's own errors."""

    exit_status = 2
