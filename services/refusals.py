"""What a step says to an input that is well formed and absurd (pure)."""


class InputRefused(ValueError):
    """An input cannot be what it says; the message is one sentence. Nothing has been changed by it. Faults of a program
    are never told this way: they end the service."""
