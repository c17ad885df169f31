"""What a service says to an input that is well formed and absurd, and to a question that comes too early (pure)."""


class InputRefused(ValueError):
    """An input cannot be what it says; the message is one sentence. Nothing has been changed by it. Faults of a program
    are never told this way: they end the service."""


class NotYet(Exception):
    """A question cannot be answered yet; the message is one sentence. Whoever asks may ask again."""
