"""The text side of an embedding space in this process, for scenes that no system serves."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from prior_sg.deploy.api.errors import PackageMissingError
from prior_sg.services.runtime import extras


def embed_here(space: str, phrases: Sequence[str]) -> np.ndarray[Any, Any]:
    """Unit vectors (phrase, dim). Raises PriorSgError where the space's encoder is not installed."""
    vectors: np.ndarray[Any, Any] = _encoder(space).encode_text([[phrase] for phrase in phrases]).embeddings
    return vectors


@cache
def _encoder(space: str) -> Any:
    from prior_sg.services.feature_pyramid.encoders.base import Options, load_encoder

    try:
        return load_encoder(space, Options())
    except ModuleNotFoundError as error:
        raise PackageMissingError(extras.advice(error) or str(error)) from error
