"""Masks of boxes by SAM, through transformers, which loads its successors by the same class."""

from typing import Any

import numpy as np

from prior_sg.services.feature_pyramid import pretrained
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.lift import Grid
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable

KINDS = "depth or sam:MODEL"


class Masks:
    """Cuts the thing that a box frames out of an image."""

    def __init__(self, model: str, cfg: Config) -> None:
        what = f"the masks {cfg.detector_masks}"
        self.processor, self.model, self.device = pretrained.load(what, "AutoModelForMaskGeneration", model, cfg.device)

    def of(self, color: np.ndarray, boxes_px: np.ndarray, grid: Grid) -> list[np.ndarray]:
        """The mask of each box (n, 4) on the grid, measured cells only: the one that the network rates best."""
        if not len(boxes_px):
            return []
        asked = self.processor(images=[color], input_boxes=[boxes_px.tolist()], return_tensors="pt")
        with pretrained.torch().inference_mode():
            outputs = self.model(**asked.to(self.device))
        masks = self._full_size(outputs.pred_masks.cpu(), asked)[0]  # (box, candidate, h, w)
        best = outputs.iou_scores[0].cpu().argmax(dim=-1).tolist()
        step = grid.cell_px
        cells = [masks[i, candidate, step // 2 :: step, step // 2 :: step].numpy() for i, candidate in enumerate(best)]
        return [mask & (grid.depths_m > 0) for mask in cells]

    def _full_size(self, masks: Any, asked: Any) -> Any:
        sizes = [asked["original_sizes"].cpu()]
        if "reshaped_input_sizes" in asked:  # SAM scales an image into a square, the later ones stretch it
            sizes.append(asked["reshaped_input_sizes"].cpu())
        return self.processor.post_process_masks(masks, *sizes)


def load_masks(cfg: Config) -> Masks | None:
    """The network of a setting, None where the depth alone gives masks. Raises EncoderUnavailable."""
    kind, _, model = cfg.detector_masks.partition(":")
    if cfg.detector_masks == "depth":
        return None
    if kind == "sam" and model:
        return Masks(model, cfg)
    raise EncoderUnavailable(
        f"no masks are called {cfg.detector_masks!r}; set feature_pyramid.detector_masks to {KINDS}."
    )
