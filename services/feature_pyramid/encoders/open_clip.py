"""Encoders `open_clip/MODEL/PRETRAINED`: any model of open_clip, with published weights or those of a file.

On a graphics card in half precision; crops are resized and normalised there, all of one size at once.
"""

from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.feature_pyramid.encoders import torchvision_parts
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, Options, key_chunk, package, reason
from prior_sg.services.feature_pyramid.encoders.torch_pixels import Pixels
from prior_sg.services.feature_pyramid.encoders.two_towers import ClipEncoder

TEXT_BATCH = 64


def space_of(choice: str) -> str:
    """The embedding space: of weights in a file, named after the file. Raises EncoderUnavailable."""
    model, pretrained = parts_of(choice)
    return f"open_clip/{model}/{key_chunk(Path(pretrained).stem) if is_file(pretrained) else pretrained}"


def check(choice: str) -> None:
    """That open_clip knows the model, and the file of the weights, if one is named, is there. Raises
    EncoderUnavailable.
    """
    _check(library(), *parts_of(choice))


def load(choice: str, options: Options) -> ClipEncoder:
    """The encoder with its weights, which the model hub delivers at first use. Raises EncoderUnavailable."""
    towers = towers_of(choice, options)
    return ClipEncoder(space_of(choice), towers, options.batch_on(towers.device))


def towers_of(choice: str, options: Options) -> "Towers":
    """The model with its weights. Raises EncoderUnavailable."""
    name, pretrained = parts_of(choice)
    torch, open_clip = package("torch"), library()
    _check(open_clip, name, pretrained)
    device = _device(torch, options.device)
    if options.threads and device == "cpu":
        torch.set_num_threads(options.threads)
    about = {} if is_file(pretrained) else open_clip.get_pretrained_cfg(name, pretrained)
    try:
        model = open_clip.create_model(
            name,
            pretrained=pretrained,
            precision="fp16" if device == "cuda" else "fp32",
            device=device,
            force_quick_gelu=bool(about.get("quick_gelu")),  # as the weights were trained
        )
        tokenizer = open_clip.get_tokenizer(name)
    except Exception as error:  # the hub, the network, the disk and the model each raise their own
        raise EncoderUnavailable(
            f"the weights {pretrained!r} of open_clip's {name} cannot be loaded ({reason(error)}); fetch them once "
            "where the hub can be reached, or name a file with them as open_clip/MODEL/FILE."
        ) from error
    return Towers(torch, model.eval(), tokenizer, device)


class Towers:
    """One model, for arrays and strings."""

    def __init__(self, torch: Any, model: Any, tokenizer: Any, device: str) -> None:
        self.model, self.tokenizer, self.device = model, tokenizer, device
        self._torch, self._kind = torch, next(model.parameters()).dtype
        size = model.visual.image_size
        self.side_px = int(size[0] if isinstance(size, tuple | list) else size)
        self.logit_scale = float(model.logit_scale.detach().exp())
        asked = getattr(model.visual, "preprocess_cfg", {}).get("interpolation")
        self.pixels = Pixels(
            torch,
            device,
            side_px=self.side_px,
            mean=model.visual.image_mean,
            std=model.visual.image_std,
            interpolation="bilinear" if asked == "bilinear" else "bicubic",
        )

    def images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Image embeddings (crop, dim) of RGB crops, uint8 (h, w, 3)."""
        with self._torch.inference_mode():
            return self.model.encode_image(self.pixels(crops, self._kind)).float().cpu().numpy()

    def texts(self, texts: list[str]) -> np.ndarray:
        """Text embeddings (text, dim)."""
        with self._torch.inference_mode():
            parts = [
                self.model.encode_text(self.tokenizer(texts[first : first + TEXT_BATCH]).to(self.device))
                for first in range(0, len(texts), TEXT_BATCH)
            ]
            return self._torch.cat(parts).float().cpu().numpy()


def parts_of(choice: str) -> tuple[str, str]:
    """Model and weights that a choice names. Raises EncoderUnavailable."""
    _, _, rest = choice.partition("/")
    model, _, pretrained = rest.partition("/")
    if not model or not pretrained:
        raise EncoderUnavailable(
            f"{choice!r} names no model with weights; write open_clip/MODEL/PRETRAINED, for example "
            "open_clip/ViT-H-14/laion2b_s32b_b79k."
        )
    return model, pretrained


def is_file(pretrained: str) -> bool:
    """Whether weights are named by a file, not by a tag of open_clip's."""
    return "/" in pretrained or pretrained.endswith((".pt", ".pth", ".bin", ".safetensors"))


def library() -> Any:
    """The package open_clip. Raises EncoderUnavailable."""
    try:
        torchvision_parts.load()
    except ImportError as error:
        raise EncoderUnavailable("open_clip is not installed; run `pip install 'prior-sg[clip]'`.") from error
    return package("open_clip", "open-clip-torch")


def _check(open_clip: Any, name: str, pretrained: str) -> None:
    if name not in open_clip.list_models():
        raise EncoderUnavailable(f"open_clip has no model {name!r}; `open_clip.list_models()` lists those it has.")
    if is_file(pretrained):
        if not Path(pretrained).is_file():
            raise EncoderUnavailable(f"the weight file {pretrained} does not exist; name one that does.")
        return
    tags = open_clip.list_pretrained_tags_by_model(name)
    if pretrained not in tags:
        raise EncoderUnavailable(
            f"open_clip has no weights {pretrained!r} for {name}; choose from {', '.join(tags) or 'a file'}."
        )


def _device(torch: Any, wanted: str) -> str:
    if wanted not in ("auto", "cpu", "cuda"):
        raise EncoderUnavailable(f"feature_pyramid.device is auto, cpu or cuda, not {wanted!r}.")
    found = torch.cuda.is_available()
    if wanted == "cuda" and not found:
        raise EncoderUnavailable("PyTorch sees no graphics card; set feature_pyramid.device=cpu.")
    return "cuda" if found and wanted != "cpu" else "cpu"
