"""What a family of published models must give, so that a model of it can be written."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer

from prior_sg.services.feature_pyramid.encoders.torch_pixels import Pixels
from prior_sg.services.runtime.service import ServiceError


class ExportError(ServiceError):
    """A model cannot be written; the message is one sentence that says what to do."""


class Tower(torch.nn.Module):
    """One tower of a model, as a network of its own."""

    def __init__(self, model: Any, embed: Callable[[Any], Any]) -> None:
        super().__init__()
        self.model, self._embed = model, embed

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Embeddings (row, dim) of pixels or of token ids."""
        return self._embed(values)


@dataclass(frozen=True)
class Model:
    """A model in PyTorch, on the processor in single precision."""

    name: str
    source: str  # where the weights come from, and where their licence is
    packages: tuple[str, ...]  # distributions that gave model and tokenizer
    pixels: Pixels
    image: Tower  # float32 (crop, 3, side, side), normalised, to (crop, dim)
    text: Tower  # int64 (text, context) to (text, dim)
    logit_scale: float  # the trained one, after the exponential
    context: int  # token ids per text
    pad_id: int
    tokens: Callable[[list[str]], np.ndarray]  # the model's own way: int64 (text, context)
    tokenizer: Tokenizer  # what is to give the same


class TorchTowers:
    """A model in PyTorch for arrays and strings."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self.side_px, self.logit_scale = model.pixels.side_px, model.logit_scale

    def images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings (crop, dim) of RGB crops, uint8 (h, w, 3)."""
        with torch.inference_mode():
            return self._model.image(self._model.pixels(crops, torch.float32)).numpy()

    def texts(self, texts: list[str]) -> np.ndarray:
        """Embeddings (text, dim)."""
        with torch.inference_mode():
            return self._model.text(torch.from_numpy(self._model.tokens(texts))).numpy()
