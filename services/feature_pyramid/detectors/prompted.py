"""Detectors that are asked for things by name: GroundingDINO and OWLv2, through transformers."""

from typing import Any

import numpy as np

from prior_sg.services.feature_pyramid import pretrained
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.lift import Grid, mask_in_box, without_doubles
from prior_sg.services.feature_pyramid.core.upright import quarter_turns, turned, turned_back
from prior_sg.services.feature_pyramid.detectors.base import Detector, Found, Shot
from prior_sg.services.feature_pyramid.detectors.masks import load_masks

MODELS = {"grounding_dino": "GroundingDinoForObjectDetection", "owlv2": "Owlv2ForObjectDetection"}
MOST_TOKENS = 250  # of the names in one question to GroundingDINO, which reads 256, start and end among them


class Prompted(Detector):
    """Boxes by the network; masks by SAM, or the part of a box whose depth goes with its middle."""

    prompted = True

    def __init__(self, kind: str, model: str, cfg: Config) -> None:
        self.name, self.kind, self.cfg = cfg.detector, kind, cfg
        what = f"the detector {cfg.detector}"
        self.processor, self.model, self.device = pretrained.load(what, MODELS[kind], model, cfg.device)
        self.masks = load_masks(cfg)

    def detect(self, shot: Shot, sought: tuple[str, ...] = ()) -> list[Found]:
        if not sought:
            return []
        turns, (height_px, width_px) = quarter_turns(shot.world_from_camera), shot.color.shape[:2]
        boxes_px, scores, names = self.boxes(turned(shot.color, turns), sought)
        boxes_px = turned_back(boxes_px, turns, width_px, height_px)
        keep = np.flatnonzero(scores >= self.cfg.detector_threshold)
        keep = keep[without_doubles(boxes_px[keep], scores[keep])][: self.cfg.segments.most]
        grid = Grid.of(shot.depth_m, self.cfg.segments.cell_px)
        if self.masks is None:
            masks = [mask_in_box(box_px, grid, shot.camera) for box_px in boxes_px[keep]]
        else:
            masks = self.masks.of(shot.color, boxes_px[keep], grid)
        found = [Found(boxes_px[i], mask, float(scores[i]), int(names[i])) for i, mask in zip(keep, masks, strict=True)]
        return [one for one in found if one.mask.any()]

    def boxes(self, color: np.ndarray, sought: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Every box the network proposes, pixels (n, 4), inside the image; its score (n,), and for which name (n,)."""
        parts = []
        for first, end in self._questions(sought):
            boxes, scores, names = self._asked(color, sought[first:end])
            parts.append((boxes, scores, names + first))
        boxes, scores, names = (np.concatenate(values) for values in zip(*parts, strict=True))
        height_px, width_px = color.shape[:2]
        # OWLv2 sees the image padded to a square at its right or lower side
        scale_px = (width_px, height_px) if self.kind == "grounding_dino" else (max(width_px, height_px),) * 2
        middle, size = boxes[:, :2], boxes[:, 2:]
        corners = [np.clip((middle + sign * size / 2) * scale_px, 0, (width_px, height_px)) for sign in (-1, 1)]
        boxes_px = np.concatenate(corners, axis=1).astype(np.float32)
        seen = (boxes_px[:, 2:] - boxes_px[:, :2] >= 1).all(axis=1)
        return boxes_px[seen], scores[seen], names[seen]

    def _questions(self, sought: tuple[str, ...]) -> list[tuple[int, int]]:
        """First and end of the names that go into one question each: all at once, but for GroundingDINO."""
        if self.kind != "grounding_dino":
            return [(0, len(sought))]
        tokens = [len(self.processor.tokenizer(as_sentences((name,)))["input_ids"]) - 2 for name in sought]
        return batches(tokens, MOST_TOKENS)

    def _asked(self, color: np.ndarray, sought: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Boxes (n, 4) as middle and size, in shares of what the network sees; the score and best name of each."""
        dino = self.kind == "grounding_dino"
        text: Any = as_sentences(sought) if dino else [[f"a photo of a {name}" for name in sought]]
        padding = True if dino else "max_length"
        asked = self.processor(images=[color], text=text, padding=padding, truncation=True, return_tensors="pt")
        with pretrained.torch().inference_mode():
            outputs = self.model(**asked.to(self.device))
        logits, boxes = outputs.logits[0].float(), outputs.pred_boxes[0].float().cpu().numpy()
        scores = logits.sigmoid().cpu().numpy()
        if dino:
            stop = self.processor.tokenizer.convert_tokens_to_ids(".")
            names = best_sentence(scores, asked["input_ids"][0].tolist(), stop)
        else:
            names = logits.argmax(dim=1).cpu().numpy()
        return boxes, scores.max(axis=1), names


def as_sentences(sought: tuple[str, ...]) -> str:
    """Names as GroundingDINO wants them: in lower case, each ending in the only full stop it has."""
    return " ".join(f"{name.lower().replace('.', ' ').strip()}." for name in sought)


def best_sentence(token_scores: np.ndarray, token_ids: list[int], stop: int) -> np.ndarray:
    """Which name (box,) scores best, on average over its tokens; names end with `stop`, the first follows a start mark.

    `token_scores` (box, token) may have more columns than there are tokens. A name without tokens scores nothing.
    """
    ends = [at for at, token in enumerate(token_ids) if token == stop]
    starts = [1, *(end + 1 for end in ends[:-1])]
    none = np.full(len(token_scores), -1.0)
    pairs = zip(starts, ends, strict=True)
    means = [token_scores[:, start:end].mean(axis=1) if end > start else none for start, end in pairs]
    return np.argmax(means, axis=0)


def batches(sizes: list[int], most: int) -> list[tuple[int, int]]:
    """First and end of runs of as many entries as together are no larger than `most`, each with one entry at least."""
    runs: list[tuple[int, int]] = []
    first, total = 0, 0
    for index, size in enumerate(sizes):
        if total + size > most and index > first:
            runs.append((first, index))
            first, total = index, 0
        total += size
    return [*runs, (first, len(sizes))]
