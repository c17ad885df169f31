"""SigLIP and SigLIP 2 through transformers: `siglip/HF_NAME`, or a folder in place of the name.

Both were trained on text in lower case. SigLIP's own tokenizer sees to that; that of SigLIP 2 does in newer versions of
transformers only, so texts are lowered here in any case.
"""

from pathlib import Path
from typing import Any

import numpy as np
from tokenizers import Regex, Tokenizer, normalizers, processors

from prior_sg.services.feature_pyramid.encoders import torchvision_parts
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, package, reason
from prior_sg.services.feature_pyramid.encoders.exporting.model import ExportError, Model, Tower
from prior_sg.services.feature_pyramid.encoders.exporting.open_clip_tokens import PUNCTUATION, behind
from prior_sg.services.feature_pyramid.encoders.torch_pixels import Interpolation, Pixels

INTERPOLATIONS: dict[int, Interpolation] = {2: "bilinear", 3: "bicubic"}  # Pillow's numbers
SENTENCEPIECE = ("sentencepiece", "protobuf")  # what transformers calls the packages that it lacks


def model_of(choice: str) -> Model:
    """The model with its weights. Raises EncoderUnavailable, ExportError."""
    name = choice.removeprefix("siglip/")
    if not name:
        raise ExportError("siglip/ names no model; write siglip/HF_NAME, as siglip/google/siglip-base-patch16-224.")
    short = name.rstrip("/").rpartition("/")[2]
    look, tokenizer, model = _loaded(name)
    context = int(model.config.text_config.max_position_embeddings)

    def tokens(texts: list[str]) -> np.ndarray:
        lowered = [text.lower() for text in texts]
        how = {"padding": "max_length", "max_length": context, "truncation": True}
        return np.array(tokenizer(lowered, **how)["input_ids"], np.int64)

    return Model(
        name=short,
        source=f"SigLIP of the folder {short}" if Path(name).is_dir() else f"SigLIP, https://huggingface.co/{name}",
        packages=("transformers", "tokenizers"),
        pixels=_pixels(look, model.config.vision_config.image_size),
        image=Tower(model, lambda pixels: model.vision_model(pixel_values=pixels).pooler_output).eval(),
        text=Tower(model, lambda ids: model.text_model(input_ids=ids).pooler_output).eval(),
        logit_scale=float(model.logit_scale.detach().exp()),
        context=context,
        pad_id=int(tokenizer.pad_token_id),
        tokens=tokens,
        tokenizer=_tokenizer(tokenizer),
    )


def _loaded(name: str) -> tuple[Any, Any, Any]:
    """Image processor, tokenizer and network of a published name or a folder. Raises EncoderUnavailable."""
    torchvision_parts.load_if_installed()
    transformers = package("transformers")
    transformers.utils.logging.disable_progress_bar()
    try:
        config = transformers.AutoConfig.from_pretrained(name)
        if config.model_type != "siglip":
            raise ExportError(f"{name} is a model of the kind {config.model_type}; siglip/HF_NAME takes SigLIP only.")
        look = transformers.AutoImageProcessor.from_pretrained(name)
        tokenizer = transformers.AutoTokenizer.from_pretrained(name)
        model = transformers.AutoModel.from_pretrained(name, attn_implementation="eager").eval().float()
    except (OSError, ValueError, ImportError) as error:
        if any(word in str(error).lower() for word in SENTENCEPIECE):
            raise EncoderUnavailable(
                f"the tokenizer of {name} needs the package sentencepiece; run `pip install 'prior-sg[export]'`."
            ) from error
        raise EncoderUnavailable(
            f"SigLIP's weights {name!r} cannot be loaded ({reason(error)}); name a folder with them, or a model "
            "that this machine can download."
        ) from error
    return look, tokenizer, model


def _pixels(look: Any, side_px: int) -> Pixels:
    way = INTERPOLATIONS.get(int(look.resample))
    if way is None:
        raise ExportError(f"its image processor resizes in a way unknown here ({look.resample}); export another model.")
    mean, std = look.image_mean, look.image_std
    return Pixels(package("torch"), "cpu", side_px=int(side_px), mean=mean, std=std, interpolation=way)


def _tokenizer(tokenizer: Any) -> Tokenizer:
    """The tokenizer as one of the package `tokenizers`, from the model's sentence pieces where it has none."""
    backend = getattr(tokenizer, "backend_tokenizer", None)
    if backend is not None:
        return behind([normalizers.Lowercase()], backend)
    from transformers.convert_slow_tokenizer import SpmConverter

    pieces = SpmConverter(tokenizer).converted()
    end = tokenizer.eos_token
    pieces.post_processor = processors.TemplateProcessing(
        single=f"$A {end}", special_tokens=[(end, tokenizer.eos_token_id)]
    )
    plain = [normalizers.Lowercase(), normalizers.Replace(Regex(PUNCTUATION), "")]
    return behind([*plain, normalizers.Replace(Regex(r"\s+"), " "), normalizers.Strip()], pieces)
