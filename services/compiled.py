"""Inner loops compiled by numba, kept on disk between processes wherever something can be written."""

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

from prior_sg.services.folders import temporary_cache

F = TypeVar("F", bound=Callable)
log = logging.getLogger(__name__)


def compiled(**options: Any) -> Callable[[F], F]:
    """A decorator: compiled at first use, without the interpreter's lock; `options` are those of `numba.njit`.

    What is compiled is kept beside the code, in the user's cache, or in a temporary folder; where none of them can be
    written, every process compiles anew.
    """

    def decorate(function: F) -> F:
        try:
            return _kept(function, options)
        except RuntimeError:  # neither beside the code nor in the user's cache
            _keep_in_temporary_folder()
        try:
            return _kept(function, options)
        except RuntimeError:
            return numba.njit(nogil=True, **options)(function)

    return decorate


def _kept(function: F, options: dict[str, Any]) -> F:
    return numba.njit(cache=True, nogil=True, **options)(function)


def _keep_in_temporary_folder() -> None:
    """From now on, here and in processes started from here; says so once."""
    if os.environ.get("NUMBA_CACHE_DIR"):  # tried, or what the user wants
        return
    try:
        folder: Path | None = temporary_cache("compiled")
    except OSError:
        folder = None
    os.environ["NUMBA_CACHE_DIR"] = vars(numba.config)["CACHE_DIR"] = str(folder or os.devnull)
    where = f"it is kept in {folder}" if folder else "every process compiles anew, which takes a minute"
    log.warning(
        "compiled code can be kept neither beside the program nor in the user's cache: %s; "
        "set NUMBA_CACHE_DIR to a folder that can be written",
        where,
    )
