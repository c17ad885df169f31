"""Encoders `open_clip/MODEL/PRETRAINED`: any model of open_clip, with published weights or those of a file.

On a graphics card in half precision; crops are resized and normalised there, all of one size at once.
"""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.feature_pyramid.encoders import torchvision_parts
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, Options, key_chunk, package
from prior_sg.services.feature_pyramid.encoders.two_towers import ClipEncoder

TEXT_BATCH = 64


def space_of(choice: str) -> str:
    """The embedding space: of weights in a file, named after the file. Raises EncoderUnavailable."""
    model, pretrained = _parts(choice)
    return f"open_clip/{model}/{key_chunk(Path(pretrained).stem) if _is_file(pretrained) else pretrained}"


def load(choice: str, options: Options) -> ClipEncoder:
    """The encoder with its weights, which the model hub delivers at first use. Raises EncoderUnavailable."""
    name, pretrained = _parts(choice)
    torch, open_clip = package("torch"), library()
    _check(open_clip, name, pretrained)
    device = _device(torch, options.device)
    if options.threads and device == "cpu":
        torch.set_num_threads(options.threads)
    precision = "fp16" if device == "cuda" else "fp32"
    try:
        model = open_clip.create_model(name, pretrained=pretrained, precision=precision, device=device)
        tokenizer = open_clip.get_tokenizer(name)
    except Exception as error:  # the hub, the network, the disk and the model each raise their own
        why = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise EncoderUnavailable(
            f"the weights {pretrained!r} of open_clip's {name} cannot be loaded ({why}); fetch them once where the hub "
            "can be reached, or name a file with them as open_clip/MODEL/FILE."
        ) from error
    return ClipEncoder(space_of(choice), Towers(torch, model.eval(), tokenizer, device), options.batch_on(device))


class Towers:
    """One model, for arrays and strings."""

    def __init__(self, torch: Any, model: Any, tokenizer: Any, device: str) -> None:
        self._torch, self._model, self._tokenizer, self._device = torch, model, tokenizer, device
        size = model.visual.image_size
        self.side_px = int(size[0] if isinstance(size, tuple | list) else size)
        self.logit_scale = float(model.logit_scale.detach().exp())
        self._kind = next(model.parameters()).dtype
        about = (model.visual.image_mean, model.visual.image_std)
        self._mean, self._std = (255 * torch.tensor(v, device=device).view(1, 3, 1, 1) for v in about)

    def images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Image embeddings (crop, dim) of RGB crops, uint8 (h, w, 3)."""
        torch, by_size = self._torch, defaultdict(list)
        for index, crop in enumerate(crops):
            by_size[crop.shape].append(index)
        pixels = torch.empty((len(crops), 3, self.side_px, self.side_px), dtype=self._kind, device=self._device)
        with torch.inference_mode():
            for rows in by_size.values():
                raw = torch.from_numpy(np.stack([crops[row] for row in rows])).to(self._device, non_blocking=True)
                pixels[rows] = self._seen(raw).to(self._kind)
            return self._model.encode_image(pixels).float().cpu().numpy()

    def texts(self, texts: list[str]) -> np.ndarray:
        """Text embeddings (text, dim)."""
        with self._torch.inference_mode():
            parts = [
                self._model.encode_text(self._tokenizer(texts[first : first + TEXT_BATCH]).to(self._device))
                for first in range(0, len(texts), TEXT_BATCH)
            ]
            return self._torch.cat(parts).float().cpu().numpy()

    def _seen(self, raw: Any) -> Any:
        """Crops of one size, uint8 (crop, h, w, 3), as the network sees them."""
        pixels, side = raw.permute(0, 3, 1, 2).float(), (self.side_px, self.side_px)
        if tuple(pixels.shape[2:]) != side:
            resize = self._torch.nn.functional.interpolate
            pixels = resize(pixels, side, mode="bicubic", align_corners=False, antialias=True).clamp(0, 255)
        return (pixels - self._mean) / self._std


def _parts(choice: str) -> tuple[str, str]:
    _, _, rest = choice.partition("/")
    model, _, pretrained = rest.partition("/")
    if not model or not pretrained:
        raise EncoderUnavailable(
            f"{choice!r} names no model with weights; write open_clip/MODEL/PRETRAINED, for example "
            "open_clip/ViT-H-14/laion2b_s32b_b79k."
        )
    return model, pretrained


def _is_file(pretrained: str) -> bool:
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
    if _is_file(pretrained):
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
