"""Encoders `onnx:FOLDER`: a user's own export of a model with an image and a text tower, described by a manifest.

`prior-sg encoders export` writes such a folder; docs/encoders.md shows the manifest.
"""

import hashlib
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from tokenizers import Tokenizer

from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, Options, key_chunk
from prior_sg.services.feature_pyramid.encoders.onnx_session import Session
from prior_sg.services.feature_pyramid.encoders.resampling import resampled
from prior_sg.services.feature_pyramid.encoders.two_towers import ClipEncoder
from prior_sg.services.folders import expanded
from prior_sg.services.opencv import cv2

MANIFEST = "manifest.json"
TEXT_BATCH = 64


class File(msgspec.Struct, frozen=True, kw_only=True):
    """A file of the folder, with the digest it must have."""

    file: str
    sha256: str


class Network(File, frozen=True, kw_only=True):
    """A network, and the file that holds its weights where they do not fit into its own."""

    weights: File | None = None


class Image(Network, frozen=True, kw_only=True):
    """The image tower: float32 (crop, 3, side, side), normalised, to embeddings (crop, dim)."""

    side_px: int
    mean: tuple[float, float, float]  # of pixels in [0, 1]
    std: tuple[float, float, float]
    # of crops to the side: `area` averages what shrinks and is fast; the others are those of Pillow and torchvision
    interpolation: Literal["area", "bicubic", "bilinear"] = "area"


class Text(Network, frozen=True, kw_only=True):
    """The text tower: int64 (text, context) token ids, and a mask if it has a second input, to (text, dim)."""

    context: int
    pad_id: int = 0


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """What manifest.json says."""

    name: str
    image: Image
    text: Text
    tokenizer: File  # in the format of the package tokenizers
    logit_scale: float = 100.0  # the trained one, after the exponential
    source: str = ""  # where the weights come from
    licence: str = ""  # of the weights
    made_with: dict[str, str] = {}  # versions of what wrote the folder


_MANIFEST = msgspec.json.Decoder(Manifest)  # built at import: services of one process load encoders side by side


def space_of(choice: str) -> str:
    """The embedding space: the manifest's name and digest. Raises EncoderUnavailable."""
    folder = _folder(choice)
    name = _manifest(folder).name
    return f"onnx/{key_chunk(name)}-{hashlib.sha256((folder / MANIFEST).read_bytes()).hexdigest()[:8]}"


def load(choice: str, options: Options) -> ClipEncoder:
    """The encoder, its files checked against the manifest. Raises EncoderUnavailable."""
    return ClipEncoder(space_of(choice), towers_of(choice, options), options.batch_on(_device(options)))


def towers_of(choice: str, options: Options) -> "Towers":
    """The two networks, their files checked against the manifest. Raises EncoderUnavailable."""
    folder = _folder(choice)
    manifest = _manifest(folder)
    image, text, tokens = _files(folder, manifest)
    return Towers(
        manifest,
        Session(image, options.threads, _device(options)),
        Session(text, options.threads, _device(options)),
        tokenizer_of(tokens, manifest.text),
    )


def check(choice: str) -> None:
    """That every file of the manifest is there and is the one it describes. Raises EncoderUnavailable."""
    folder = _folder(choice)
    _files(folder, _manifest(folder))


def _files(folder: Path, manifest: Manifest) -> tuple[Path, Path, Path]:
    """The networks of images and texts and the tokenizer, checked."""
    for network in (manifest.image, manifest.text):
        if network.weights is not None:
            _checked(folder, network.weights)
    return _checked(folder, manifest.image), _checked(folder, manifest.text), _checked(folder, manifest.tokenizer)


def _device(options: Options) -> str:
    return "cpu" if options.device == "auto" else options.device


class Towers:
    """Two exported networks."""

    def __init__(self, about: Manifest, image: Session, text: Session, tokenizer: Tokenizer) -> None:
        self.side_px, self.logit_scale = about.image.side_px, about.logit_scale
        self._image, self._text, self._tokenizer = image, text, tokenizer
        self._mean, self._std = (
            255 * np.array(values, np.float32)[:, None, None] for values in (about.image.mean, about.image.std)
        )
        self._interpolation = about.image.interpolation

    def images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings (crop, dim) of RGB crops, uint8 (h, w, 3)."""
        pixels = np.stack([self._resized(crop) for crop in crops])
        return self._image((pixels - self._mean) / self._std).astype(np.float32)

    def texts(self, texts: list[str]) -> np.ndarray:
        """Embeddings (text, dim)."""
        parts = [self._batch(texts[first : first + TEXT_BATCH]) for first in range(0, len(texts), TEXT_BATCH)]
        return np.concatenate(parts).astype(np.float32)

    def _batch(self, texts: list[str]) -> np.ndarray:
        encodings = self._tokenizer.encode_batch(texts)
        tokens = np.array([encoding.ids for encoding in encodings], np.int64)
        mask = np.array([encoding.attention_mask for encoding in encodings], np.int64)
        return self._text(*(tokens, mask)[: len(self._text.inputs)])

    def _resized(self, crop: np.ndarray) -> np.ndarray:
        """Float32 (3, side, side)."""
        if self._interpolation != "area":
            return resampled(crop, self.side_px, self._interpolation)
        way = cv2.INTER_AREA if crop.shape[0] > self.side_px else cv2.INTER_CUBIC
        sized = cv2.resize(crop, (self.side_px, self.side_px), interpolation=way)
        return sized.transpose(2, 0, 1).astype(np.float32)


def _folder(choice: str) -> Path:
    folder = expanded(choice.removeprefix("onnx:"))
    if not (folder / MANIFEST).is_file():
        raise EncoderUnavailable(f"{folder} has no {MANIFEST}; docs/encoders.md shows what belongs into the folder.")
    return folder


def _manifest(folder: Path) -> Manifest:
    try:
        return _MANIFEST.decode((folder / MANIFEST).read_bytes())
    except msgspec.DecodeError as error:
        raise EncoderUnavailable(f"{folder / MANIFEST} is not valid: {error}; see docs/encoders.md.") from error


def _checked(folder: Path, part: File) -> Path:
    path = folder / part.file
    if not path.is_file():
        raise EncoderUnavailable(f"{path} is missing; {MANIFEST} names it.")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != part.sha256:
        raise EncoderUnavailable(f"{path} is not the file that {MANIFEST} describes: its sha256 is {digest}.")
    return path


def tokenizer_of(path: Path, about: Text) -> Tokenizer:
    """The tokenizer of a file, giving `context` ids per text. Raises EncoderUnavailable."""
    try:
        tokenizer = Tokenizer.from_file(str(path))
    except Exception as error:  # the package raises plain exceptions
        raise EncoderUnavailable(f"{path} is not a tokenizer: {error}") from error
    tokenizer.enable_truncation(about.context)
    tokenizer.enable_padding(length=about.context, pad_id=about.pad_id)
    return tokenizer
