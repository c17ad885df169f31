"""The curated knowledge that ships with the gateway: one TOML file per environment under `library/`."""

import hashlib
import tomllib
from importlib.resources import files

import msgspec

from services.prior_gateway.core import Library
from services.prior_gateway.knowledge import Environment, check_environment


class Listing(msgspec.Struct, frozen=True, kw_only=True):
    """What the library knows about one environment, for people."""

    name: str
    synonyms: list[str]
    regions: list[str]  # base regions
    tasks: dict[str, list[str]]  # task -> its regions; the first is the generic one


def load() -> Library:
    """Read and check every file; raises ValueError that names the file."""
    found: list[Environment] = []
    content = hashlib.blake2b(digest_size=6)
    folder = files("services.prior_gateway") / "library"
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if not file.name.endswith(".toml"):
            continue
        text = file.read_text(encoding="utf-8")
        content.update(text.encode())
        try:
            environment = msgspec.convert(tomllib.loads(text), Environment)
            check_environment(environment)
        except (tomllib.TOMLDecodeError, msgspec.ValidationError, ValueError) as error:
            raise ValueError(f"{file.name}: {error}") from error
        found.append(environment)
    return Library(environments=tuple(found), version=content.hexdigest())


def environments() -> list[Listing]:
    """Everything in the library, by name of the environment."""
    return [
        Listing(
            name=environment.name,
            synonyms=environment.synonyms,
            regions=[entry.name for entry in environment.regions],
            tasks={
                task.name: list(task.regions) for task in sorted(environment.tasks, key=lambda task: not task.generic)
            },
        )
        for environment in sorted(load().environments, key=lambda environment: environment.name)
    ]
