"""What `prior-sg eval` can compare, by name; light, so that the command line can list it."""

from typing import Any

OURS = "ours"
BASELINES = ("clio", "hovsg", "hydra", "argmax")  # modules of the folder baselines
SIMULATED = ("sim", "simlike")  # encoders, each followed by :P, how often it errs
SWEEPS: dict[str, tuple[Any, ...]] = {  # values by setting
    "crop": (112, 224, 448),
    "encoder": tuple(f"conse/efficientnet-lite{size}/minilm-l6-v2" for size in (0, 1, 2)),
    "radius": (0.375, 0.75, 1.5, 3.0),
}
ORACLES = {  # parts that the truth can replace
    "features": "crops carry the text embedding of the true region that most of their points lie in",
    "places": "places carry the text embedding of their true region",
    "objects": "the objects are those of the ground truth that the robot has seen; as ours where it names none",
    "prior": "existence and adjacency counted from the ground truth",
}
