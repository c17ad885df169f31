"""Writes a model as the folder that `onnx:FOLDER` reads, and compares what is read back with PyTorch.

The folder comes into being whole or not at all.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.services.feature_pyramid.encoders import onnx
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, Options, package, reason, unit
from prior_sg.services.feature_pyramid.encoders.exporting.model import ExportError, Model, TorchTowers
from prior_sg.services.opencv import cv2

FAMILIES = {  # how a choice begins -> module with `model_of(choice) -> Model`
    "open_clip/": "prior_sg.services.feature_pyramid.encoders.exporting.open_clip",
    "siglip/": "prior_sg.services.feature_pyramid.encoders.exporting.siglip",
}
TOLERANCE = 1e-3  # greatest distance between unit embeddings of PyTorch and of the folder
PICTURES = 8
PHRASES = (
    "a kitchen",
    "the inside of a railway station with many people waiting",
    "Children's play_area",
    "a café, open  24/7",
    "“living room” & hall",
    "Küche",
    "a very long corridor with doors and windows and lamps on both sides " * 6,
)
LICENCE = "not known; ask where the weights come from"
EXAMPLE_ROWS = 2

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Exported:
    """What was written, and how far it is from PyTorch."""

    space: str
    dim: int
    side_px: int
    size_bytes: int
    image_distance: float  # the greatest between unit embeddings
    text_distance: float


def export(choice: str, folder: Path, licence: str = "", progress: Progress = lambda text: None) -> Exported:
    """Write the model of a choice; `progress` hears what is being done. Raises ExportError, EncoderUnavailable."""
    family = next((module for prefix, module in FAMILIES.items() if choice.startswith(prefix)), None)
    if family is None:
        raise ExportError(f"{choice!r} cannot be exported; write open_clip/MODEL/PRETRAINED or siglip/HF_NAME.")
    package("onnx")
    package("onnxruntime")
    _check_free(folder)
    progress(f"loading {choice}, which the model hub delivers at first use")
    model = import_module(family).model_of(choice)
    with _emerging(folder.absolute()) as partial:
        manifest = _write(model, partial, licence or LICENCE, progress)
        progress("reading the folder back, and comparing with PyTorch")
        found = _compared(model, manifest, partial)
    return found


def _check_free(folder: Path) -> None:
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ExportError(f"{folder} is there already; name a new folder with --out, or remove it.")


@contextmanager
def _emerging(folder: Path) -> Iterator[Path]:
    """A folder beside the one wanted, which takes its place at the end and is gone after any failure."""
    partial = folder.with_name(f".{folder.name}.{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        yield partial
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write(model: Model, folder: Path, licence: str, progress: Progress) -> onnx.Manifest:
    """All files of the folder."""
    import torch

    side_px = model.pixels.side_px
    pixels = torch.zeros(EXAMPLE_ROWS, 3, side_px, side_px)
    tokens = torch.from_numpy(model.tokens(list(PHRASES[:EXAMPLE_ROWS])))
    progress("writing the image network")
    image = _network(model.image, pixels, folder / "image.onnx", "pixels")
    progress("writing the text network")
    text = _network(model.text, tokens, folder / "text.onnx", "tokens")
    model.tokenizer.no_truncation()
    model.tokenizer.no_padding()
    model.tokenizer.save(str(folder / "tokenizer.json"))
    progress("computing digests")
    about = model.pixels
    manifest = onnx.Manifest(
        name=model.name,
        image=onnx.Image(**image, side_px=side_px, mean=about.mean, std=about.std, interpolation=about.interpolation),
        text=onnx.Text(**text, context=model.context, pad_id=model.pad_id),
        tokenizer=_described(folder / "tokenizer.json"),
        logit_scale=model.logit_scale,
        source=model.source,
        licence=licence,
        made_with={name: metadata.version(name) for name in ("prior-sg", "torch", "onnx", *model.packages)},
    )
    (folder / onnx.MANIFEST).write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=2) + b"\n")
    return manifest


def _network(network: object, example: object, path: Path, takes: str) -> dict:
    """A tower's file, and what the manifest says of it. Raises ExportError."""
    from prior_sg.services.feature_pyramid.encoders import to_onnx

    try:
        weights = to_onnx.write_large(network, (example,), path, {takes: {0: "row"}}, "embeddings")
    except (OSError, MemoryError, EncoderUnavailable):
        raise
    except Exception as error:  # the exporter and the models each raise their own
        raise ExportError(
            f"PyTorch cannot write {path.name} of this model ({reason(error)}); export another model."
        ) from error
    described = _described(path)
    return {
        "file": described.file,
        "sha256": described.sha256,
        "weights": None if weights is None else _described(weights),
    }


def _described(path: Path) -> onnx.File:
    with path.open("rb") as file:
        return onnx.File(file=path.name, sha256=hashlib.file_digest(file, "sha256").hexdigest())


def _compared(model: Model, manifest: onnx.Manifest, folder: Path) -> Exported:
    """What the folder gives, beside what PyTorch gives. Raises ExportError."""
    _compare_tokens(model, manifest, folder)
    choice = f"onnx:{folder}"
    ours, theirs = onnx.towers_of(choice, Options()), TorchTowers(model)
    crops = pictures(model.pixels.side_px)
    images = ours.images(crops)
    image = _distance(images, theirs.images(crops))
    text = _distance(ours.texts(list(PHRASES)), theirs.texts(list(PHRASES)))
    for what, distance in (("image", image), ("text", text)):
        if not distance <= TOLERANCE:
            raise ExportError(
                f"the {what} network of {model.name} gives embeddings {distance:.1e} from PyTorch's, more than "
                f"{TOLERANCE:.0e}; nothing was written, export another model."
            )
    size = sum(file.stat().st_size for file in folder.iterdir())
    return Exported(onnx.space_of(choice), images.shape[1], ours.side_px, size, image, text)


def _compare_tokens(model: Model, manifest: onnx.Manifest, folder: Path) -> None:
    tokenizer = onnx.tokenizer_of(folder / manifest.tokenizer.file, manifest.text)
    for phrase in PHRASES:
        if tokenizer.encode(phrase).ids != model.tokens([phrase])[0].tolist():
            raise ExportError(
                f"the written tokenizer of {model.name} reads {phrase!r} otherwise than its own; nothing was written, "
                "export another model."
            )


def pictures(side_px: int) -> list[np.ndarray]:
    """Smooth noise of several sizes, always the same: uint8 (h, h, 3)."""
    rng = np.random.default_rng(0)
    found = []
    for number in range(PICTURES):
        size = max(int(side_px * (1.0, 2.3, 0.7, 1.6)[number % 4]), 8)
        coarse = rng.integers(0, 256, (4 * (number + 1), 4 * (number + 1), 3), dtype=np.uint8)
        found.append(cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC))
    return found


def _distance(ours: np.ndarray, theirs: np.ndarray) -> float:
    """The greatest Euclidean distance of rows, each scaled to unit length."""
    return float(np.linalg.norm(unit(ours) - unit(theirs), axis=1).max())
