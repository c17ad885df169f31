"""What an encoder is, and which family of encoders serves an embedding space."""

from importlib import import_module
from typing import Protocol

import numpy as np

from schemas.features import TextEmbeddings
from services.runtime.service import ServiceError

# family (the space's first part) -> module with `load(space, threads, batch_size) -> Encoder`, imported when needed
FAMILIES = {"conse": "services.feature_pyramid.conse"}


class EncoderUnavailable(ServiceError):
    """The embedding space cannot be served here; the message says what to do."""


class Encoder(Protocol):
    """Images and text into one embedding space."""

    space: str
    dim: int

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings of RGB crops, each uint8 (h, w, 3): float32 (crop, dim), unit length."""
        ...

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Descriptors of concepts, each given by its phrases. Raises ValueError for a concept without phrases."""
        ...


def load_encoder(space: str, threads: int, batch_size: int) -> Encoder:
    """The encoder of an embedding space, weights loaded. Raises EncoderUnavailable."""
    family = space.split("/", maxsplit=1)[0]
    if family not in FAMILIES:
        raise EncoderUnavailable(
            f"no encoder serves the embedding space {space!r}; set feature_pyramid.space to one that begins with "
            f"{' or '.join(f'{name}/' for name in sorted(FAMILIES))}."
        )
    return import_module(FAMILIES[family]).load(space, threads, batch_size)
