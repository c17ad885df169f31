"""Task-driven hierarchical scene graphs from posed RGB-D streams.

    import prior_sg

    with prior_sg.Mapper(environment="residential home", task="serve drinks to guests") as mapper:
        mapper.read("recordings/home")
        print(mapper.scene.regions.labels)

`Mapper` does everything in this process, `Client` talks to a running system, `open_source` reads recordings, `Scene` is
what comes out, `open_history` gives what was. Whatever goes wrong for a user is an `Error`. Nothing is imported before
it is used.
"""

TYPE_CHECKING = False  # `typing` takes long to import, and nothing is before it is used
if TYPE_CHECKING:
    from prior_sg.deploy.api.client import Client as Client
    from prior_sg.deploy.api.errors import NotInSceneError as NotInSceneError
    from prior_sg.deploy.api.errors import PackageMissingError as PackageMissingError
    from prior_sg.deploy.api.errors import PosesError as PosesError
    from prior_sg.deploy.api.errors import SaveError as SaveError
    from prior_sg.deploy.api.errors import TaskError as TaskError
    from prior_sg.deploy.api.history import open_history as open_history
    from prior_sg.deploy.api.mapper import Mapper as Mapper
    from prior_sg.deploy.api.scene import Scene as Scene
    from prior_sg.services.errors import PriorSgError as Error
    from prior_sg.services.ingest.sources import SourceError as SourceError
    from prior_sg.services.ingest.sources import open_source as open_source
    from prior_sg.services.runtime.bus import BusError as BusError
    from prior_sg.services.runtime.client import NoPriorError as NoPriorError
    from prior_sg.services.runtime.config import ConfigError as ConfigError

    __version__: str

_HOMES = {
    "BusError": "services.runtime.bus",
    "Client": "deploy.api.client",
    "ConfigError": "services.runtime.config",
    "Error": "services.errors:PriorSgError",
    "Mapper": "deploy.api.mapper",
    "NoPriorError": "services.runtime.client",
    "NotInSceneError": "deploy.api.errors",
    "PackageMissingError": "deploy.api.errors",
    "PosesError": "deploy.api.errors",
    "SaveError": "deploy.api.errors",
    "Scene": "deploy.api.scene",
    "SourceError": "services.ingest.sources",
    "TaskError": "deploy.api.errors",
    "open_history": "deploy.api.history",
    "open_source": "services.ingest.sources",
}
__all__ = [
    "BusError",
    "Client",
    "ConfigError",
    "Error",
    "Mapper",
    "NoPriorError",
    "NotInSceneError",
    "PackageMissingError",
    "PosesError",
    "SaveError",
    "Scene",
    "SourceError",
    "TaskError",
    "__version__",
    "open_history",
    "open_source",
]


def __getattr__(name: str) -> object:
    from importlib import import_module, metadata

    if name == "__version__":
        return metadata.version("prior-sg")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOMES[name].partition(":")
    value: object = getattr(import_module(f"{__name__}.{module}"), attribute or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
