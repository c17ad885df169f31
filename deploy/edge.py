"""Names and texts that a user gives are checked here, before anything is started."""

import argparse
import os
from collections.abc import Sequence

from prior_sg.deploy.errors import UsageError
from prior_sg.schemas.names import fault_of_robot, normal
from prior_sg.schemas.priors import fault_of_task


def names_in(text: str) -> list[str]:
    """Names separated by commas, each in one spelling."""
    return [name for name in map(normal, text.split(",")) if name]


def check_robot(name: str) -> None:
    """Raise UsageError unless a robot can be called so."""
    if fault := fault_of_robot(name):
        raise UsageError(fault)


def check_task(environment: str, task: str, regions: Sequence[str]) -> None:
    """Raise UsageError for what no gateway would take."""
    if fault := fault_of_task(environment, task, list(regions)):
        raise UsageError(fault)


def check_encoding(arguments: Sequence[str]) -> None:
    """Raise UsageError for an argument whose bytes are not text."""
    for argument in arguments:
        if any("\ud800" <= c <= "\udfff" for c in argument):
            raise UsageError(_no_text(argument))


def _no_text(argument: str) -> str:
    try:
        text = os.fsencode(argument).decode()
        return f"this terminal's locale has no letters for {text!r}; set LC_ALL=C.UTF-8"
    except UnicodeError:
        return f"{argument!a} is not valid UTF-8: type it anew, or rename the file or folder"


def check_arguments(arguments: argparse.Namespace) -> None:
    """Check, and bring to one spelling, what the options of any command name. Raises UsageError."""
    given = vars(arguments)
    if given.get("robot") is not None:  # None = of all robots
        check_robot(arguments.robot)
    environments = given.get("environment") or ""
    for environment in [environments] if isinstance(environments, str) else environments:
        check_task(environment, given.get("task") or "", names_in(given.get("regions") or ""))
    for name in ("environment", "task"):
        if isinstance(given.get(name), str):
            setattr(arguments, name, normal(given[name]))
