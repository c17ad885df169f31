"""Inner loops compiled by numba, kept on disk between processes wherever something can be written.

numba and LLVM take 70 MB and most of a second to load. So a process has them from its first call of a loop on, not from
its start.
"""

import functools
import hashlib
import logging
import marshal
import os
import threading
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeVar, cast

from prior_sg.services.compiling import CLOCK
from prior_sg.services.folders import temporary_cache

F = TypeVar("F", bound=Callable)
log = logging.getLogger(__name__)
WITHOUT_REFERENCES = 2  # form of marshal that tells equal code alike; later ones depend on who else holds its parts

if find_spec("numba") is None:  # told at the start, not at the first input
    raise ModuleNotFoundError("No module named 'numba'", name="numba")


def compiled(**options: Any) -> Callable[[F], F]:
    """A decorator: compiled at first use, without the interpreter's lock; `options` are those of `numba.njit`.

    What is compiled is kept beside the code, in the user's cache, or in a temporary folder; where none of them can be
    written, every process compiles anew.
    """

    def decorate(function: F) -> F:
        return cast(F, Loop(function, options))

    return decorate


class Loop:
    """One function to be compiled. Compiled code may call it, too."""

    __name__: str

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._options = function, options

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call what was compiled for arguments of these types; the first time it is compiled, or read from the disk."""
        return self._dispatcher(*arguments, **named)

    @functools.cached_property
    def _dispatcher(self) -> Any:
        """What numba makes of the function."""
        try:
            return _kept(self._function, self._options)
        except RuntimeError:  # neither beside the code nor in the user's cache
            _keep_in_temporary_folder()
        try:
            return _kept(self._function, self._options)
        except RuntimeError:
            return _counted(_numba().njit(nogil=True, **self._options)(self._function))

    def met(self) -> tuple[int, int]:
        """For how many argument types it was compiled in this process, and for how many that was read from the disk."""
        if "_dispatcher" not in vars(self):
            return 0, 0
        found = self._dispatcher.stats
        return sum(found.cache_misses.values()), sum(found.cache_hits.values())

    # What numba asks of a function that another loop calls: its type, and, for one to be inlined, options and code.

    @property
    def _numba_type_(self) -> Any:
        return self._dispatcher._numba_type_

    @property
    def targetoptions(self) -> dict[str, Any]:
        """As they were given."""
        options: dict[str, Any] = self._dispatcher.targetoptions
        return options

    @property
    def py_func(self) -> Callable:
        """The function as it is written."""
        return self._function


@functools.cache
def _numba() -> Any:
    """The package, loaded when it is first needed."""
    import numba

    return numba


def _kept(function: Callable, options: dict[str, Any]) -> Callable:
    """Compiled code as it is on the disk, unless it was made of something else. numba looks at the function's own file
    alone: code made with another module's loops and constants would outlast a change of these, as in an upgrade.
    """
    kept: Any = _numba().njit(cache=True, nogil=True, **options)(function)
    index = kept._cache._cache_file
    index._source_stamp = (index._source_stamp, made_of(function))
    kept._cache = _Kept(kept._cache)
    return cast(Callable, _counted(kept))


def _counted(dispatcher: Any) -> Any:
    dispatcher._compiler.compile = _compiling.during(dispatcher._compiler.compile)
    return dispatcher


class _Compiling(threading.local):
    """How many functions this thread is compiling, each for the one before."""

    depth = 0

    def during(self, compiles: Callable) -> Callable:
        """The same function, counted while it runs."""

        @functools.wraps(compiles)
        def counted(*arguments: Any) -> Any:
            self.depth += 1
            try:
                with CLOCK.running():
                    return compiles(*arguments)
            finally:
                self.depth -= 1

        return counted


_compiling = _Compiling()


class _Kept:
    """What numba keeps of one function on the disk. It gives nothing to a function that is being compiled: machine code
    cannot be inlined, and loops that only call each other take up to half as long again.
    """

    def __init__(self, cache: Any) -> None:
        self._cache = cache

    def load_overload(self, *arguments: Any) -> Any:
        """Machine code, or None where it is to be compiled."""
        return None if _compiling.depth else self._cache.load_overload(*arguments)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)


def made_of(function: Callable) -> str:
    """Digest of what else goes into a function's machine code: the code of the loops that it calls, and of those that
    these call, and the values that they name."""
    digest = hashlib.blake2b(digest_size=16)
    waiting, met = [function], {function}
    while waiting:
        for name, value in _named(waiting.pop()):
            if isinstance(value, Loop):
                called = value.py_func
                digest.update(marshal.dumps((name, called.__code__), WITHOUT_REFERENCES))
                if called not in met:
                    met.add(called)
                    waiting.append(called)
            else:
                digest.update(repr((name, value.tolist() if hasattr(value, "tolist") else value)).encode())
    return digest.hexdigest()


def _named(function: Callable) -> Iterator[tuple[str, Any]]:
    """Loops and values that a function's code names, also as members of modules of ours, in order."""
    names = sorted({name for code in _codes(function.__code__) for name in code.co_names})
    known: dict[str, Any] = function.__globals__
    modules = [value for name in names if isinstance(value := known.get(name), ModuleType)]
    ours = [vars(module) for module in modules if module.__name__.partition(".")[0] == __name__.partition(".")[0]]
    for members in (known, *ours):
        for name in names:
            value = members.get(name)
            if isinstance(value, Loop | int | float | str | tuple) or hasattr(value, "tolist"):
                yield name, value


def _codes(code: CodeType) -> Iterator[CodeType]:
    """A function's code, and that of the functions in it."""
    yield code
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _codes(inner)


def _keep_in_temporary_folder() -> None:
    """From now on, here and in processes started from here; says so once."""
    if os.environ.get("NUMBA_CACHE_DIR"):  # tried, or what the user wants
        return
    try:
        folder: Path | None = temporary_cache("compiled")
    except OSError:
        folder = None
    os.environ["NUMBA_CACHE_DIR"] = vars(_numba().config)["CACHE_DIR"] = str(folder or os.devnull)
    where = f"it is kept in {folder}" if folder else "every process compiles anew, which takes a minute"
    log.warning(
        "compiled code can be kept neither beside the program nor in the user's cache: %s; "
        "set NUMBA_CACHE_DIR to a folder that can be written",
        where,
    )
