"""What can go wrong with an evaluation."""

from prior_sg.deploy.errors import UserError


class EvaluationError(UserError):
    """An evaluation cannot run; the message is one sentence that says what to do."""
