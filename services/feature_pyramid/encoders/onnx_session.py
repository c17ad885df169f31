"""ONNX Runtime: sessions, and a folder in the user's cache where exported networks are kept."""

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable
from prior_sg.services.folders import temporary_cache, user_cache

log = logging.getLogger(__name__)


class Session:
    """One network, ready to run: arrays by input name to the first output. One that `keeps` holds memory ready for its
    next call."""

    def __init__(self, path: Path, threads: int, device: str = "cpu", *, keeps: bool = True) -> None:
        runtime = _runtime()
        options = runtime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = threads_of(threads)
        options.enable_cpu_mem_arena = keeps
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads leave others the cores
        try:
            self._session = runtime.InferenceSession(str(path), options, providers=_providers(runtime, device))
        except Exception as error:  # the runtime raises exceptions of its own, without a common base
            raise EncoderUnavailable(f"{path} is not a network that ONNX Runtime can load: {error}") from error
        self.inputs = [entry.name for entry in self._session.get_inputs()]

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        """The first output; inputs in the network's own order."""
        return self._session.run(None, dict(zip(self.inputs, arrays, strict=True)))[0]


class AtFirstCall:
    """The same, loaded when it is first called: for what may never be needed, or hours later."""

    def __init__(self, path: Path, threads: int, device: str = "cpu") -> None:
        self._made_of = path, threads, device

    @cached_property
    def _session(self) -> Session:
        return Session(*self._made_of, keeps=False)

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        """The first output; inputs in the network's own order."""
        return self._session(*arrays)


def threads_of(threads: int) -> int:
    """How many threads to use when so many are set; 0 = OMP_NUM_THREADS, or one a core."""
    return threads or int(os.environ.get("OMP_NUM_THREADS", "0")) or os.cpu_count() or 1


def cached(name: str, made_of: list[str], export: Callable[[Path], None], suffix: str = ".onnx") -> Path:
    """The exported network `name`, or another file that takes long to make, made at first use.

    `made_of` is everything that determines it (versions, weights): whatever changes gets a file of its own. An export
    may write more files beside the one it is given. Several processes may export at once; half of one is never seen.
    """
    digest = hashlib.blake2b("\n".join(made_of).encode(), digest_size=8).hexdigest()
    file = f"{name}-{digest}{suffix}"
    try:
        return _made(cache_folder() / file, export)
    except OSError as error:
        say_temporary(cache_folder(), str(error.strerror))
    try:
        return _made(temporary_cache("onnx") / file, export)
    except OSError as error:
        raise EncoderUnavailable(
            f"neither {cache_folder()} nor the temporary folder can be written ({error.strerror}); set XDG_CACHE_HOME "
            "to a folder that can be, or feature_pyramid.runtime=torch"
        ) from error


@cache
def say_temporary(folder: Path, reason: str) -> None:
    """Once, however many networks are exported."""
    log.warning("exports are kept in the temporary folder: %s cannot be written (%s)", folder, reason)


def _made(path: Path, export: Callable[[Path], None]) -> Path:
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        made = Path(folder) / path.name
        export(made)
        for beside in set(made.parent.iterdir()) - {made}:
            beside.replace(path.parent / beside.name)
        made.replace(path)
    return path


def cache_folder() -> Path:
    """Where exports are kept when it can be written."""
    return user_cache() / "onnx"


def _runtime() -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise EncoderUnavailable(
            "the package onnxruntime is not installed; run `pip install onnxruntime`, or set "
            "feature_pyramid.runtime=torch"
        ) from error
    return onnxruntime


def _providers(runtime: Any, device: str) -> list[str]:
    if device == "cpu":
        return ["CPUExecutionProvider"]
    if "CUDAExecutionProvider" not in runtime.get_available_providers():
        raise EncoderUnavailable(
            "this build of ONNX Runtime has no CUDA; run `pip install onnxruntime-gpu`, or set "
            "feature_pyramid.device=cpu"
        )
    return ["CUDAExecutionProvider", "CPUExecutionProvider"]
