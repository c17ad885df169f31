"""Which detector a setting names."""

from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.detectors.base import Detector
from prior_sg.services.feature_pyramid.detectors.prompted import MODELS, Prompted
from prior_sg.services.feature_pyramid.detectors.unprompted import Segments
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable

KINDS = "segments, none, grounding_dino:MODEL or owlv2:MODEL"


def is_prompted(cfg: Config) -> bool:
    """Whether the detector of a setting looks for objects by name."""
    return cfg.detector.partition(":")[0] in MODELS


def load_detector(cfg: Config) -> Detector:
    """The detector of a setting, weights loaded. Raises EncoderUnavailable."""
    kind, _, model = cfg.detector.partition(":")
    if cfg.detector_masks != "depth" and not is_prompted(cfg):
        raise EncoderUnavailable(
            f"feature_pyramid.detector_masks cuts out the boxes of prompted detectors; {cfg.detector!r} has none."
        )
    if cfg.detector == "segments":
        return Segments(cfg.segments)
    if cfg.detector == "none":
        return Detector()
    if is_prompted(cfg) and model:
        return Prompted(kind, model, cfg)
    raise EncoderUnavailable(f"no detector is called {cfg.detector!r}; set feature_pyramid.detector to {KINDS}.")
