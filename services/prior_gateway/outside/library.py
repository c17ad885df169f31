"""The curated knowledge that ships with the gateway: under `library/`, one TOML file per environment, and one with the
sizes of all objects."""

import hashlib
import tomllib
from importlib.resources import files
from typing import TypeVar

import msgspec

from prior_sg.services.prior_gateway.core.compose import Library
from prior_sg.services.prior_gateway.core.knowledge import Environment, Size, check_environment, with_sizes

SIZES = "sizes.toml"
K = TypeVar("K")


class Listing(msgspec.Struct, frozen=True, kw_only=True):
    """What the library knows about one environment, for people."""

    name: str
    synonyms: list[str]
    regions: list[str]  # base regions
    tasks: dict[str, list[str]]  # task -> its regions; the first is the generic one


def load() -> Library:
    """Read and check every file; raises ValueError that names the file."""
    content = hashlib.blake2b(digest_size=6)
    folder = files(__package__) / "library"
    texts = {file.name: file.read_text(encoding="utf-8") for file in folder.iterdir() if file.name.endswith(".toml")}
    sizes = _read(SIZES, texts[SIZES], dict[str, Size])
    found = []
    for name, text in sorted(texts.items()):
        content.update(text.encode())
        if name != SIZES:
            environment = _read(name, text, Environment)
            try:
                check_environment(environment)
                found.append(with_sizes(environment, sizes))
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
    return Library(environments=tuple(found), version=content.hexdigest())


def _read(name: str, text: str, kind: type[K]) -> K:
    try:
        return msgspec.convert(tomllib.loads(text), kind)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ValueError(f"{name}: {error}") from error


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
