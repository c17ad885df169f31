"""The one base of everything that goes wrong for a user (pure)."""


class PriorSgError(Exception):
    """What was asked cannot be done; the message is one sentence that says what to do."""

    exit_status = 1  # of a command that ends with it


def reason_of(error: BaseException) -> str:
    """Why something failed; what the system says comes without its number and without the path once more."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)
