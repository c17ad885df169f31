"""What encoders with an image and a text tower share (CLIP, SigLIP): phrases to concepts, and calibration of a space.

A concept's similarity to a picture of nothing is its bias in the space; the model's own logit scale says how much a
difference of similarities means; prompts of nothing, compared with pictures of nothing, say from where a similarity
means anything at all. So tau and s_null need no labelled images.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from prior_sg.schemas.features import TextEmbeddings
from prior_sg.services.feature_pyramid.encoders.base import unit
from prior_sg.services.opencv import cv2

TEMPLATES = ("{}", "a picture of {}", "a photo of {}")  # paper, Prior Graph Attributes: observation phrases, averaged
NULL_PROMPTS = ("a photo", "a picture of nothing", "a blurry photo", "an empty image", "a texture", "noise")
MAX_LOGIT_SCALE = 100.0  # what CLIP clips it to in training
PICTURES_OF_NOTHING = 48
PICTURE_PX = 224
KNOWN_TEXTS = 20_000  # kept: what many priors ask for


class Towers(Protocol):
    """A model with two towers."""

    side_px: int
    logit_scale: float  # the trained one, after the exponential

    def images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings (crop, dim), of any length, of RGB crops, uint8 (h, w, 3)."""
        ...

    def texts(self, texts: list[str]) -> np.ndarray:
        """Embeddings (text, dim), of any length."""
        ...


@dataclass(frozen=True)
class Calibration:
    """What reads similarities in one space."""

    background: np.ndarray  # (picture, dim) pictures of nothing, unit length
    null: np.ndarray  # (dim,) prompts of nothing, unit length
    logit_scale: float


class ClipEncoder:
    """Two towers as one encoder."""

    def __init__(self, space: str, towers: "Towers", batch_size: int) -> None:
        self.space, self.side_px, self.batch_size = space, towers.side_px, batch_size
        self._images, self._texts = towers.images, towers.texts
        self._known: dict[str, np.ndarray] = {}  # embeddings of texts, unit length
        texts, logit_scale = towers.texts, towers.logit_scale
        background = self._encode(pictures_of_nothing())
        null = unit(unit(texts(list(NULL_PROMPTS))).mean(axis=0))
        self._calibration = Calibration(background, null, min(logit_scale, MAX_LOGIT_SCALE))
        self.dim = background.shape[1]

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings of RGB crops, each uint8 (h, w, 3): float32 (crop, dim), unit length."""
        return self._encode(crops) if crops else np.zeros((0, self.dim), np.float32)

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Descriptors of concepts: normalised means over their phrases in all templates, calibrated.

        Raises ValueError for a concept without phrases.
        """
        if lacking := [index for index, phrases in enumerate(concepts) if not phrases]:
            raise ValueError(f"concept {lacking[0]} has no phrases; give each concept at least one")
        texts = [[template.format(phrase) for phrase in phrases for template in TEMPLATES] for phrases in concepts]
        self._learn([text for row in texts for text in row])
        embeddings = np.zeros((len(concepts), self.dim), np.float32)
        for index, row in enumerate(texts):
            embeddings[index] = unit(np.stack([self._known[text] for text in row]).mean(axis=0))
        return calibrated(self.space, embeddings, self._calibration)

    def _learn(self, texts: list[str]) -> None:
        """Embed what is not known yet, all at once. Text towers are slow on processors, and priors repeat phrases."""
        new = [text for text in dict.fromkeys(texts) if text not in self._known]
        if new and len(self._known) + len(new) > KNOWN_TEXTS:
            self._known, new = {}, list(dict.fromkeys(texts))
        if new:
            self._known.update(zip(new, unit(self._texts(new)), strict=True))

    def _encode(self, crops: list[np.ndarray]) -> np.ndarray:
        starts = range(0, len(crops), self.batch_size)
        return unit(np.concatenate([self._images(crops[first : first + self.batch_size]) for first in starts]))


def calibrated(space: str, embeddings: np.ndarray, by: Calibration) -> TextEmbeddings:
    """Text with its calibration: temperature times standardised similarity is the model's own logit, less each
    concept's bias.
    """
    similarity = by.background.astype(np.float64) @ embeddings.T.astype(np.float64)
    mean = similarity.mean(axis=0)
    spread = float(np.sqrt(((similarity - mean) ** 2).mean())) if len(embeddings) else 1.0
    null = float((by.background @ by.null).mean() - mean.mean()) / spread if len(embeddings) else 0.0
    return TextEmbeddings(
        space=space,
        embeddings=embeddings,
        background_mean=mean.astype(np.float32),
        background_std=np.full(len(embeddings), spread, np.float32),
        temperature=by.logit_scale * spread,
        null_score=max(null, 0.0),
    )


def pictures_of_nothing() -> list[np.ndarray]:
    """Flat colours, gradients and blurred noise, always the same: uint8 (224, 224, 3)."""
    rng, pictures = np.random.default_rng(0), []
    ramp = np.linspace(0, 1, PICTURE_PX)
    for number in range(PICTURES_OF_NOTHING):
        first, second = rng.uniform(0, 255, (2, 3))
        picture: Any
        if number % 3 == 0:
            picture = np.broadcast_to(first, (PICTURE_PX, PICTURE_PX, 3))
        elif number % 3 == 1:
            share = ramp[:, None] if rng.random() < 0.5 else ramp[None, :]
            share = np.broadcast_to(share, (PICTURE_PX, PICTURE_PX))[..., None]
            picture = first * share + second * (1 - share)
        else:
            sharp = rng.normal(0, 1, (PICTURE_PX, PICTURE_PX, 3)).astype(np.float32)
            noise = cv2.GaussianBlur(sharp, (0, 0), float(rng.uniform(1, 20)))
            picture = first + 60 * noise / noise.std()
        pictures.append(np.clip(picture, 0, 255).astype(np.uint8))
    return pictures
