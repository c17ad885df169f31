"""Crops as a network of PyTorch sees them: resized, normalised, on its device, all of one size at once."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

Interpolation = Literal["bicubic", "bilinear"]


class Pixels:
    """What happens to crops before a network: resizing as in torchvision, less the mean, through the spread."""

    def __init__(
        self,
        torch: Any,
        device: str,
        *,
        side_px: int,
        mean: Sequence[float],
        std: Sequence[float],
        interpolation: Interpolation,
    ) -> None:
        self.side_px, self.interpolation = side_px, interpolation
        self.mean, self.std = _three(mean), _three(std)  # of pixels in [0, 1]
        self._torch, self._device = torch, device
        self._mean, self._std = (255 * torch.tensor(v, device=device).view(1, 3, 1, 1) for v in (self.mean, self.std))

    def __call__(self, crops: list[np.ndarray], kind: Any) -> Any:
        """A tensor (crop, 3, side, side) of type `kind` from RGB crops, uint8 (h, w, 3)."""
        torch, by_size = self._torch, defaultdict(list)
        for index, crop in enumerate(crops):
            by_size[crop.shape].append(index)
        pixels = torch.empty((len(crops), 3, self.side_px, self.side_px), dtype=kind, device=self._device)
        for rows in by_size.values():
            raw = torch.from_numpy(np.stack([crops[row] for row in rows])).to(self._device, non_blocking=True)
            pixels[rows] = self._seen(raw).to(kind)
        return pixels

    def _seen(self, raw: Any) -> Any:
        """Crops of one size, uint8 (crop, h, w, 3), as the network sees them."""
        pixels, side = raw.permute(0, 3, 1, 2).float(), (self.side_px, self.side_px)
        if tuple(pixels.shape[2:]) != side:
            resize = self._torch.nn.functional.interpolate
            pixels = resize(pixels, side, mode=self.interpolation, align_corners=False, antialias=True).clamp(0, 255)
        return (pixels - self._mean) / self._std


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    red, green, blue = map(float, values)
    return red, green, blue
