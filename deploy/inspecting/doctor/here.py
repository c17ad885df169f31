"""Facts of this host: what its own checks say of limits, keys, folders, settings, the encoder and the database."""

import os
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.inspecting.doctor.findings import UPDATE, Cache, Finding, Folder, Here, Keys
from prior_sg.deploy.limits import check_memory, files_allowed
from prior_sg.deploy.running.crashes import crashes, sentence
from prior_sg.services import folders
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.keys import bundle_in_force

COMMAND = re.compile(r"`([^`]+)`")


@dataclass(frozen=True)
class Asked:
    """What is meant to run here, as `prior-sg up` would be told it."""

    out: Path
    config: str = ""
    settings: tuple[str, ...] = ()
    encoder: str = ""


def of_this_host(asked: Asked) -> Here:
    """Changes nothing, not even by trying to write."""
    keys, told = _keys()
    return Here(
        told=[*_limits(), *told, *_services(asked), *_crashes(asked.out / "crashes", time.time())],
        clock_ns=time.time_ns(),
        keys=keys,
        folders=[_folder("results and logs", asked.out, "prior-sg up --out FOLDER")],
        caches=_caches() if _lacking("map") is None else [],
        files_allowed=files_allowed(),
    )


def _limits() -> Iterator[Finding]:
    try:
        check_memory("map")
    except UserError as error:
        yield Finding("memory", str(error), "ulimit -v unlimited")


def _keys() -> tuple[Keys | None, list[Finding]]:
    try:
        bundle = bundle_in_force()
    except BusError as error:
        return None, [_said("keys", error, "prior-sg keys add")]
    if bundle is None:
        return None, []
    own, today = bundle.own, time.strftime("%Y-%m-%d", time.gmtime())
    return Keys(own.name, own.role, own.until, own.state(today)), []


def _folder(purpose: str, path: Path, mend: str) -> Folder:
    there = _nearest(path)
    return Folder(purpose, str(path), _writable(there), shutil.disk_usage(there).free, mend)


def _nearest(path: Path) -> Path:
    """Itself, or the folder above it in which it would be made."""
    path = path.absolute()
    return next(one for one in (path, *path.parents) if os.path.lexists(one))


def _writable(path: Path) -> bool:
    return path.is_dir() and os.access(path, os.W_OK | os.X_OK)


def _caches() -> list[Cache]:
    """As `services/compiled.py` and the encoders look for folders, but for the temporary one they fall back on."""
    mine = os.environ.get("NUMBA_CACHE_DIR")
    beside_code, of_user = Path(folders.__file__).parent, folders.user_cache()
    compiled = [Path(mine)] if mine else [beside_code, of_user.with_name("numba")]
    return [
        Cache(what, tuple(map(str, tried)), any(_writable(_nearest(one)) for one in tried), variable)
        for what, tried, variable in (
            ("compiled code", compiled, "NUMBA_CACHE_DIR"),
            ("exported networks", [of_user], "XDG_CACHE_HOME"),
        )
    ]


def _services(asked: Asked) -> list[Finding]:
    """Of their settings, encoder and database; nothing where no service is installed and none was asked for."""
    if (lacking := _lacking("map")) is not None:
        return [lacking] if asked.config or asked.settings or asked.encoder else []
    from prior_sg.deploy.inspecting.doctor.settings import settings_here

    settings = [f"scene_store.path={asked.out / 'scene.sqlite'}", *asked.settings]
    if asked.encoder:
        settings.append(f"feature_pyramid.space={asked.encoder}")
    found = settings_here(asked.config, settings)
    of_encoder = _encoder(found.configs["feature_pyramid"].space) if found.names_encoder else []
    store = found.configs.get("scene_store")
    return [*found.told, *of_encoder, *(_database(store) if store is not None else [])]


def _lacking(extra: str) -> Finding | None:
    try:
        extras.require(extra, "what is to run here")
    except extras.ExtraMissing as error:
        return Finding("packages", str(error), f"pip install 'prior-sg[{extra}]'")
    return None


def _encoder(choice: str) -> list[Finding]:
    if (lacking := _lacking("clip" if choice.startswith("open_clip/") else "encode")) is not None:
        return [lacking]
    from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, check_encoder

    try:
        check_encoder(choice)
    except EncoderUnavailable as error:
        return [_said("encoder", error, "prior-sg encoders check ENCODER")]
    return []


def _database(cfg: Any) -> list[Finding]:
    from prior_sg.services.scene_store.storage.tables import StoreError
    from prior_sg.services.scene_store.storage.unopened import check_storage

    try:
        check_storage(cfg)
    except extras.ExtraMissing as error:
        return [_said("database", error, UPDATE)]
    except StoreError as error:
        return [_said("database", error, _mend_of_store(cfg.path, str(error)))]
    return []


def _mend_of_store(path: str, said: str) -> str:
    if "this program needs" in said:
        return UPDATE
    if "is locked" in said:
        return f"fuser -v {path}"
    return f"mv {path} {path}.aside" if "move the file away" in said else "prior-sg up --set scene_store.path=PATH"


def _crashes(folder: Path, now_s: float) -> Iterator[Finding]:
    for one in crashes(folder, now_s):
        yield Finding("crashes", f"{sentence(one, now_s)}; send it to who maintains this, then", f"rm -r {folder}")


def _said(topic: str, error: PriorSgError, otherwise: str) -> Finding:
    """What a check says, with the command that it names, if it names one."""
    commands = COMMAND.findall(str(error))
    return Finding(topic, str(error), commands[-1] if commands else otherwise)
