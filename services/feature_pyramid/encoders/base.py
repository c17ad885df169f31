"""What an encoder is, and which family of encoders serves an embedding space."""

import re
from importlib import import_module
from typing import Any, NamedTuple, Protocol

import numpy as np

from prior_sg.schemas.features import TextEmbeddings
from prior_sg.services.runtime.service import ServiceError

# family (how the choice begins) -> module with `load(choice, options) -> Encoder`, `space_of(choice) -> str` and
# `check(choice)`, which raises EncoderUnavailable where a package or a file is not there; imported when needed
FAMILIES = {
    "conse/": "prior_sg.services.feature_pyramid.encoders.conse",
    "open_clip/": "prior_sg.services.feature_pyramid.encoders.open_clip",
    "onnx:": "prior_sg.services.feature_pyramid.encoders.onnx",
}


class EncoderUnavailable(ServiceError):
    """The embedding space cannot be served here; the message says what to do."""


class Options(NamedTuple):
    """How an encoder is to run."""

    threads: int = 0  # 0 = the library's own choice (OMP_NUM_THREADS)
    batch_size: int = 0  # crops per forward pass; 0 = what suits the device
    runtime: str = "auto"  # of a family that has several
    device: str = "auto"  # cpu, cuda, or auto: cuda where there is one

    def batch_on(self, device: str) -> int:
        """Crops per forward pass on cpu or cuda."""
        return self.batch_size or (256 if device == "cuda" else 4)


class Encoder(Protocol):
    """Images and text into one embedding space.

    Text comes with what reads its similarities: each concept's mean and spread over the space's background, and the
    space's temperature and null score (paper: tau, s_null).
    """

    space: str
    dim: int
    side_px: int  # of the square images that the network sees
    batch_size: int  # crops per forward pass

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings of RGB crops, each uint8 (h, w, 3): float32 (crop, dim), unit length."""
        ...

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Descriptors of concepts, each given by its phrases. Raises ValueError for a concept without phrases."""
        ...


def load_encoder(choice: str, options: Options) -> Encoder:
    """The encoder that serves a choice (see FAMILIES), weights loaded. Raises EncoderUnavailable."""
    return _family(choice).load(choice, options)


def space_of(choice: str) -> str:
    """The embedding space of a choice, without loading weights. Raises EncoderUnavailable."""
    return _family(choice).space_of(choice)


def check_encoder(choice: str) -> None:
    """That what a choice needs is there, without loading it. Raises EncoderUnavailable."""
    _family(choice).check(choice)


def package(module: str, name: str = "") -> Any:
    """An installed package, imported when needed. Raises EncoderUnavailable; `name` is what pip calls it."""
    try:
        return import_module(module)
    except ImportError as error:
        name = name or module.replace("_", "-")
        raise EncoderUnavailable(f"the package {name} is not installed; run `pip install {name}`.") from error


def reason(error: Exception) -> str:
    """The first sentence of what a library says went wrong, without its full stop."""
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return re.split(r"(?<=\.)\s", first)[0].rstrip(".")


def key_chunk(name: str) -> str:
    """A name as it may stand in a key and in the name of a space."""
    return re.sub(r"[^\w.-]+", "-", name)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Rows scaled to unit length: float32."""
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def _family(choice: str) -> Any:
    for prefix, module in FAMILIES.items():
        if choice.startswith(prefix):
            return import_module(module)
    raise EncoderUnavailable(
        f"no encoder serves the embedding space {choice!r}; set feature_pyramid.space to one that begins with "
        f"{' or '.join(FAMILIES)}."
    )
