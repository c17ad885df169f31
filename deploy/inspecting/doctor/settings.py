"""Whether every service can be given its settings, and which layer is to be mended."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from prior_sg.deploy.inspecting.doctor.findings import Finding
from prior_sg.deploy.settings import Layers, settings_layers
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.config import (
    ENVIRONMENT_PREFIX,
    ConfigError,
    from_arguments,
    from_environment,
    resolve,
)
from prior_sg.services.runtime.service import Service

SET = "prior-sg up --set SERVICE.FIELD=VALUE"


@dataclass(frozen=True)
class SettingsHere:
    """Configs by service of those that can have one, why others cannot, and whether an encoder was named."""

    configs: Mapping[str, Any]
    told: Sequence[Finding]
    names_encoder: bool


def settings_here(config: str, settings: Sequence[str]) -> SettingsHere:
    """As `prior-sg up` with these options would resolve them."""
    try:
        layers = settings_layers(config, settings)
    except ConfigError as error:
        return SettingsHere({}, [Finding("settings", str(error), _mend_of_layers(config))], False)
    configs, told = {}, []
    for service in SERVICES:
        try:
            configs[service.name] = resolve(service.config, service.name, layers)
        except ConfigError as error:
            told.append(Finding("settings", str(error), _mend(service, str(error), config, settings)))
    named = "feature_pyramid" in configs and "space" in layers.get("feature_pyramid", {})
    return SettingsHere(configs, told, named)


def _mend_of_layers(config: str) -> str:
    """Of what is wrong in the file as a whole, or else after --set."""
    try:
        settings_layers(config, ())
    except ConfigError:
        return f"$EDITOR {config}"
    return SET


def _mend(service: Service, said: str, config: str, settings: Sequence[str]) -> str:
    """Of the last layer that by itself gives the same fault."""
    if _fault(service, from_arguments(settings)) == said:
        return SET
    if _fault(service, from_environment(os.environ)) == said:
        mine = [name for name in os.environ if name.startswith(f"{ENVIRONMENT_PREFIX}{service.name.upper()}__")]
        wrong = [name for name in mine if _fault(service, from_environment({name: os.environ[name]}))] or mine
        return f"unset {' '.join(sorted(wrong))}"
    return f"$EDITOR {config}" if config else SET


def _fault(service: Service, layer: Layers) -> str:
    try:
        resolve(service.config, service.name, layer)
    except ConfigError as error:
        return str(error)
    return ""
