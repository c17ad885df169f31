"""Models of open_clip: `open_clip/MODEL/PRETRAINED`."""

from pathlib import Path

from prior_sg.services.feature_pyramid.encoders import open_clip
from prior_sg.services.feature_pyramid.encoders.base import Options
from prior_sg.services.feature_pyramid.encoders.exporting.model import Model, Tower
from prior_sg.services.feature_pyramid.encoders.exporting.open_clip_tokens import tokenizer_of


def model_of(choice: str) -> Model:
    """The model with its weights. Raises EncoderUnavailable, ExportError."""
    name, pretrained = open_clip.parts_of(choice)
    towers = open_clip.towers_of(choice, Options(device="cpu"))
    tokenizer, model = towers.tokenizer, towers.model
    file = open_clip.is_file(pretrained)
    return Model(
        name=f"{name}-{Path(pretrained).stem if file else pretrained}",
        source=_source(name, pretrained, file),
        packages=("open-clip-torch",),
        pixels=towers.pixels,
        image=Tower(model, model.encode_image).eval(),
        text=Tower(model, model.encode_text).eval(),
        logit_scale=towers.logit_scale,
        context=int(tokenizer.context_length),
        pad_id=getattr(getattr(tokenizer, "tokenizer", None), "pad_token_id", None) or 0,
        tokens=lambda texts: tokenizer(texts).numpy(),
        tokenizer=tokenizer_of(tokenizer, name),
    )


def _source(name: str, pretrained: str, file: bool) -> str:
    if file:
        return f"open_clip {name}, weights of the file {Path(pretrained).name}"
    about = open_clip.library().get_pretrained_cfg(name, pretrained)
    hub = about.get("hf_hub", "").strip("/")
    where = f"https://huggingface.co/{hub}" if hub else about.get("url", "")
    return f"open_clip {name} {pretrained}" + (f", {where}" if where else "")
