"""What exports are made of: a scene, and whatever is known beside it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene


@dataclass(frozen=True)
class Cloud:
    """Coloured surface points of a map."""

    points_world: np.ndarray  # (point, 3) float32, metres
    colors: np.ndarray  # (point, 3) uint8, red, green, blue


@dataclass(frozen=True)
class Moment:
    """The scene as it stood after one delta of a run."""

    revision: int
    scene: Scene


@dataclass(frozen=True)
class Material:
    """A scene and what is known beside it. Most formats need the scene alone; all else may be missing."""

    scene: Scene
    voxels: VoxelMap | None = None
    cloud: Cloud | None = None
    moments: list[Moment] = field(default_factory=list)  # of the run, in order of time; the last equals `scene`
    scores: dict[str, float | None] = field(default_factory=dict)  # against ground truth, by name
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)  # of each service that ran
    losses: list[dict[str, Any]] | None = None  # what a run could not use; None = not known
    truth: GroundTruth | None = None
    prior: Prior | None = None  # that the regions follow
    log: Path | None = None  # recording with every image of the run
    crs: str = ""  # coordinate reference system of the world with its origin, such as EPSG:32632; "" = local metres
