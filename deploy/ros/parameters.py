"""The task as a parameter of a node of ROS 2, so that `ros2 param set /prior_sg task "..."` gives one (pure).

Standard messages have no service that takes a text, and `ros2 param` is in every installation: it asks for all six
services of a node's parameters. A task is taken when it can be one; that regions follow it takes longer, and another
topic tells. The other parameters are for reading.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from prior_sg.deploy.ros.messages import Classes
from prior_sg.schemas.names import normal, shown
from prior_sg.schemas.priors import fault_of_task

PACKAGE = "rcl_interfaces"
NOT_SET, STRING = 0, 4  # of rcl_interfaces/msg/ParameterType
SERVICES = {  # request and reply, as their .srv files say it
    "get_parameters": ("GetParameters", "string[] names\n", f"{PACKAGE}/ParameterValue[] values\n"),
    "get_parameter_types": ("GetParameterTypes", "string[] names\n", "uint8[] types\n"),
    "describe_parameters": (
        "DescribeParameters",
        "string[] names\n",
        f"{PACKAGE}/ParameterDescriptor[] descriptors\n",
    ),
    "list_parameters": (
        "ListParameters",
        "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth\n",
        f"{PACKAGE}/ListParametersResult result\n",
    ),
    "set_parameters": (
        "SetParameters",
        f"{PACKAGE}/Parameter[] parameters\n",
        f"{PACKAGE}/SetParametersResult[] results\n",
    ),
    "set_parameters_atomically": (
        "SetParametersAtomically",
        f"{PACKAGE}/Parameter[] parameters\n",
        f"{PACKAGE}/SetParametersResult result\n",
    ),
}
MOST_ASKED = 100
TASK = "task"
MEANINGS = {
    TASK: "what the robot is to do, in plain words; its regions then follow it",
    "environment": "the kind of place that the robot is in",
    "robot": "name of the robot whose scene this node tells of",
}
Give = Callable[[str], str]  # takes a task that can be one; why it is not taken, empty = it is


def type_of(service: str) -> str:
    """The type of one of the services."""
    return f"{PACKAGE}/srv/{SERVICES[service][0]}"


class Parameters:
    """Answers the services from the values in force; `give` is told a task that is set."""

    def __init__(self, classes: Classes, values: Callable[[], Mapping[str, str]], give: Give) -> None:
        self._classes, self._values, self._give = classes, values, give

    def answer(self, service: str, request: Any) -> Any:
        """The reply of one of the services. Raises ValueError with one sentence."""
        if len(asked := request.prefixes if service == "list_parameters" else _asked(request)) > MOST_ASKED:
            raise ValueError(f"it asks for {len(asked)} parameters at once: at most {MOST_ASKED} are taken")
        match service:
            case "get_parameters":
                found: tuple[Any, ...] = ([self._value(name) for name in request.names],)
            case "get_parameter_types":
                kinds = [STRING if name in MEANINGS else NOT_SET for name in request.names]
                found = (np.array(kinds, np.uint8),)
            case "describe_parameters":
                found = ([self._description(name) for name in request.names],)
            case "list_parameters":
                found = (self._message("ListParametersResult", listed(request.prefixes), []),)
            case "set_parameters":
                found = ([self._set([one]) for one in request.parameters],)
            case _:
                found = (self._set(request.parameters),)
        return self._reply(service, *found)

    def _set(self, parameters: Iterable[Any]) -> Any:
        """All of them or none."""
        parameters = list(parameters)
        fault = next(filter(None, map(fault_of, parameters)), "")
        if not fault and len(parameters) > 1:
            fault = "the task is given twice: give one"
        for one in parameters if not fault else ():
            fault = self._give(normal(one.value.string_value))
        return self._message("SetParametersResult", not fault, fault)

    def _value(self, name: str) -> Any:
        known = name in MEANINGS
        kind, text = (STRING, self._values()[name]) if known else (NOT_SET, "")
        kinds = (np.uint8, np.bool_, np.int64, np.float64)
        return self._message("ParameterValue", kind, False, 0, 0.0, text, *(np.zeros(0, of) for of in kinds), [])

    def _description(self, name: str) -> Any:
        kind = STRING if name in MEANINGS else NOT_SET
        read_only = name != TASK
        return self._message("ParameterDescriptor", name, kind, MEANINGS.get(name, ""), "", read_only, False, [], [])

    def _message(self, name: str, *values: Any) -> Any:
        return self._classes[f"{PACKAGE}/msg/{name}"](*values)

    def _reply(self, service: str, *values: Any) -> Any:
        return self._classes[f"{type_of(service)}_Response"](*values)


def _asked(request: Any) -> Sequence[Any]:
    return request.names if hasattr(request, "names") else request.parameters


def listed(prefixes: Sequence[str]) -> list[str]:
    """Parameters of any of these prefixes; without one, all."""
    return [name for name in MEANINGS if not prefixes or name in prefixes]


def fault_of(parameter: Any) -> str:
    """Why a parameter cannot be set so, as a sentence; empty when it can."""
    name, value = parameter.name, parameter.value
    if name != TASK:
        return f"{shown(name[:60])!r} is for reading" if name in MEANINGS else f"no parameter {shown(name[:60])!r}"
    if value.type != STRING:
        return "a task is a text: write it in quotes"
    return fault_of_task_text(value.string_value)


def fault_of_task_text(text: str) -> str:
    """Why a text is no task, as a sentence; empty when it is one."""
    return fault_of_task("", text, []) if normal(text) else "the task is empty: say what the robot is to do"
