"""Measurement of two-tower encoders on a graphics card. Weights are random: speed does not depend on them."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from prior_sg.services.feature_pyramid.encoders.open_clip import Towers, library

MODELS = ("ViT-H-14", "ViT-L-14")
SIDES_PX = (224, 352, 480)  # of the crops of a 640 x 480 pyramid
BATCH = 256
MATRIX = 8192  # side of the product that tells the card's peak
ROUNDS = 5


def on_card() -> dict[str, float]:
    """Figures of this machine's card; nothing where there is none."""
    import torch

    if not torch.cuda.is_available():
        return {}
    peak = matrix_peak(torch, "cuda", MATRIX)
    metrics: dict[str, float] = {"peak_tflops": peak / 1e12}
    for name in MODELS:
        metrics |= {f"{key}_{name}": value for key, value in measured(name, "cuda", BATCH, peak).items()}
    metrics["peak_share"] = min(metrics[f"peak_share_{name}"] for name in MODELS)
    metrics["openclip_ratio"] = min(metrics[f"openclip_ratio_{name}"] for name in MODELS)
    return metrics


def measured(name: str, device: str, batch: int, peak: float) -> dict[str, float]:
    """One model: our way and open_clip's own, from the same crops to embeddings on the processor.

    Open_clip's own way: its transform of each picture, then `encode_image` under autocast with weights as they are;
    `encode_image_ratio` compares with its network alone, its pictures ready on the card.
    """
    import torch

    open_clip = library()
    precision = "fp16" if device == "cuda" else "fp32"
    towers = Towers(torch, open_clip.create_model(name, precision=precision, device=device).eval(), None, device)
    plain = open_clip.create_model(name, device=device).eval()
    about = {"mean": plain.visual.image_mean, "std": plain.visual.image_std}
    transform = open_clip.image_transform(towers.side_px, is_train=False, **about)
    rng = np.random.default_rng(0)
    sides = [SIDES_PX[number % len(SIDES_PX)] for number in range(batch)]
    crops = [rng.integers(0, 256, (side, side, 3), dtype=np.uint8) for side in sides]

    def encode(pixels: Any) -> np.ndarray:
        with torch.inference_mode(), torch.autocast(device):
            return plain.encode_image(pixels.to(device)).float().cpu().numpy()

    ready = _transformed(torch, transform, crops).to(device)
    ours = batch / _seconds(lambda: towers.images(crops))
    return {
        "crops_per_s": ours,
        "peak_share": ours * flops(plain, ready[:1]) / peak,
        "openclip_ratio": ours * _seconds(lambda: encode(_transformed(torch, transform, crops)), 1) / batch,
        "encode_image_ratio": ours * _seconds(lambda: encode(ready)) / batch,
    }


def matrix_peak(torch: Any, device: str, side: int) -> float:
    """Operations per second of a bfloat16 matrix product."""
    matrix = torch.randn(side, side, device=device, dtype=torch.bfloat16)

    def products() -> None:
        for _ in range(10):
            product = matrix @ matrix
        product[0, 0].item()  # waits for the card

    return 10 * 2 * side**3 / _seconds(products)


def flops(model: Any, pixels: Any) -> float:
    """Operations that one picture takes."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    fast = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)  # it hides its products from the counter
    try:
        with torch.inference_mode(), FlopCounterMode(display=False) as counter:
            model.encode_image(pixels)
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)
    return float(counter.get_total_flops()) / len(pixels)


def _transformed(torch: Any, transform: Any, crops: list[np.ndarray]) -> Any:
    from PIL import Image

    return torch.stack([transform(Image.fromarray(crop)) for crop in crops])


def _seconds(run: Callable[[], Any], rounds: int = ROUNDS) -> float:
    """The shortest of several rounds, after one that warms up."""
    run()
    spent = []
    for _ in range(rounds):
        started_s = time.perf_counter()
        run()
        spent.append(time.perf_counter() - started_s)
    return min(spent)
