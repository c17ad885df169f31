"""What goes wrong for programs, beside what services and the bus raise; all of it is `prior_sg.Error`."""

from prior_sg.services.errors import PriorSgError


class TaskError(PriorSgError):
    """A task was given and no regions followed."""


class PosesError(PriorSgError):
    """Corrected poses were not taken."""


class NotInSceneError(PriorSgError, LookupError):
    """There is no such place or region."""


class SaveError(PriorSgError):
    """A scene cannot be written as asked."""


class PackageMissingError(PriorSgError, ImportError):
    """An optional package is not installed."""
