"""What goes wrong for a user and is told in one sentence."""


class UserError(Exception):
    """What the user asked cannot be done; the message says what to do instead."""
