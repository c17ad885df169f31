"""Detectors that are asked for things by name: GroundingDINO and OWLv2, through transformers."""

from typing import Any

import numpy as np

from schemas.frames import Intrinsics
from services.feature_pyramid import torchvision_parts
from services.feature_pyramid.core import Config
from services.feature_pyramid.detect import Detector, Found, Grid, mask_in_box, without_doubles
from services.feature_pyramid.encoders import EncoderUnavailable, package

MODELS = {"grounding_dino": "GroundingDinoForObjectDetection", "owlv2": "Owlv2ForObjectDetection"}
AT_ONCE = 40  # prompts: GroundingDINO reads 256 tokens


class Prompted(Detector):
    """Boxes by the network; masks are the part of a box whose depth goes with its middle."""

    prompted = True

    def __init__(self, kind: str, model: str, cfg: Config) -> None:
        if not cfg.detector_prompts:
            raise EncoderUnavailable(
                f"the detector {cfg.detector} looks for what it is asked for; name the objects in "
                "feature_pyramid.detector_prompts."
            )
        self.name, self.kind, self.cfg = cfg.detector, kind, cfg
        self.torch = package("torch")
        torchvision_parts.load_if_installed()
        transformers = package("transformers")
        try:
            self.processor = transformers.AutoProcessor.from_pretrained(model)
            self.model = getattr(transformers, MODELS[kind]).from_pretrained(model).eval()
        except (OSError, ValueError) as error:
            raise EncoderUnavailable(
                f"the weights of the detector {cfg.detector} cannot be loaded ({str(error).splitlines()[0]}); name a "
                "folder that holds them or a model that this machine can download."
            ) from error
        cuda = cfg.device == "cuda" or (cfg.device == "auto" and self.torch.cuda.is_available())
        self.device = "cuda" if cuda else "cpu"
        self.model.to(self.device)

    def detect(
        self, color: np.ndarray, depth_m: np.ndarray, camera: Intrinsics, world_from_camera: np.ndarray
    ) -> list[Found]:
        boxes_px, scores = self.boxes(color)
        grid = Grid.of(depth_m, self.cfg.segments.cell_px)
        keep = np.flatnonzero(scores >= self.cfg.detector_threshold)
        keep = keep[without_doubles(boxes_px[keep], scores[keep])]
        found = [Found(boxes_px[i], mask_in_box(boxes_px[i], grid, camera), float(scores[i])) for i in keep]
        return [one for one in found if one.mask.any()][: self.cfg.segments.most]

    def boxes(self, color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every box the network proposes, pixels (n, 4), inside the image, and its score (n,) for its best prompt."""
        prompts = self.cfg.detector_prompts
        parts = [self._asked(color, prompts[at : at + AT_ONCE]) for at in range(0, len(prompts), AT_ONCE)]
        boxes, scores = (np.concatenate(values) for values in zip(*parts, strict=True))
        height_px, width_px = color.shape[:2]
        # OWLv2 sees the image padded to a square at its right or lower side
        scale_px = (width_px, height_px) if self.kind == "grounding_dino" else (max(width_px, height_px),) * 2
        middle, size = boxes[:, :2], boxes[:, 2:]
        corners = [np.clip((middle + sign * size / 2) * scale_px, 0, (width_px, height_px)) for sign in (-1, 1)]
        boxes_px = np.concatenate(corners, axis=1).astype(np.float32)
        seen = (boxes_px[:, 2:] - boxes_px[:, :2] >= 1).all(axis=1)
        return boxes_px[seen], scores[seen]

    def _asked(self, color: np.ndarray, prompts: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (n, 4) as middle and size, in shares of what the network sees, and the score of each."""
        text: Any = [[f"a photo of a {prompt}" for prompt in prompts]]
        if self.kind == "grounding_dino":
            text = ". ".join(prompts).lower() + "."
        padding = True if self.kind == "grounding_dino" else "max_length"
        asked = self.processor(images=[color], text=text, padding=padding, truncation=True, return_tensors="pt")
        with self.torch.inference_mode():
            outputs = self.model(**asked.to(self.device))
        scores = outputs.logits[0].float().sigmoid().amax(dim=-1)
        return outputs.pred_boxes[0].float().cpu().numpy(), scores.cpu().numpy()
