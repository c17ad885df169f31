"""Where events, snapshots and the index over the present lie: SQLite or PostgreSQL, behind one class."""

from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.storage.tables import Storage

POSTGRES = ("postgresql://", "postgres://")


def is_url(path: str) -> bool:
    """Whether a place is named by an address instead of a file."""
    return path.startswith(POSTGRES)


def open_storage(cfg: Config, *, read_only: bool = False) -> Storage:
    """The storage that the setting `path` names. Raises StoreError, ExtraMissing."""
    if is_url(cfg.path):
        from prior_sg.services.scene_store.storage.postgres import Postgres

        return Postgres(cfg, read_only=read_only)
    from prior_sg.services.scene_store.storage.sqlite import Sqlite

    return Sqlite(cfg, read_only=read_only)
