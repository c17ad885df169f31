"""Settings of the services as a user gives them, and what holds where nothing is given."""

import argparse
import os
from collections.abc import Mapping, Sequence
from typing import Any

from prior_sg.services.folders import expanded
from prior_sg.services.roles import NAMES
from prior_sg.services.runtime.config import check_sections, from_arguments, from_environment, merge, read_file, resolve
from prior_sg.services.runtime.keys import VARIABLE
from prior_sg.services.runtime.service import Service

DEFAULT_CONNECT = "tcp/127.0.0.1:7447"
DEFAULT_ROBOT = "robot1"
ROUTER_WAIT_S = 5.0  # before a program or a person is told that none answers: a busy machine takes its time
DEMO_ENVIRONMENT = "residential home"
DEMO_TASK = "real-estate listing"

Layers = Mapping[str, Mapping[str, Any]]  # fields by service


def connect_in_force() -> str:
    """The router of this environment: PSG_CONNECT, else the one that every command expects on this machine."""
    return os.environ.get("PSG_CONNECT", DEFAULT_CONNECT)


def add_keys(parser: argparse.ArgumentParser) -> None:
    """The option that names a bundle of keys."""
    parser.add_argument(
        "--keys",
        default=os.environ.get(VARIABLE, ""),
        metavar="FOLDER",
        help=f"bundle of keys, for routers beyond this host (docs/security.md); default: {VARIABLE}",
    )


def use_keys(folder: str) -> None:
    """Let this process and those that it starts use a bundle of keys."""
    if folder:
        os.environ[VARIABLE] = str(expanded(folder).resolve())


def settings_layers(config: str, settings: Sequence[str]) -> Layers:
    """Settings of all services: the TOML file, then the environment, then `SERVICE.FIELD=VALUE`. Raises ConfigError."""
    file, given = read_file(config), from_arguments(settings)
    check_sections(file, list(NAMES))
    check_sections(given, list(NAMES))
    return merge(file, from_environment(os.environ), given)


def resolved_config(service: Service, config: str, settings: Sequence[str]) -> Any:
    """The config of one service from all layers. Raises ConfigError."""
    return resolve(service.config, service.name, settings_layers(config, settings))


def check_settings(config: str, settings: Sequence[str]) -> None:
    """Resolve the config of every service now, so that a wrong setting is told before anything starts."""
    from prior_sg.services.registry import SERVICES

    for service in SERVICES:
        resolved_config(service, config, settings)
