"""Sources of posed RGB-D frames: one loader per file, and the one place that tells layouts apart."""

from collections.abc import Sequence
from pathlib import Path

from prior_sg.services.ingest.sources import (
    coda,
    dataset,
    hm3d,
    icl_nuim,
    recording,
    replica,
    scannet,
    seven_scenes,
    tartanground,
    tum,
)
from prior_sg.services.ingest.sources.base import Source, SourceError

__all__ = ["Source", "SourceError", "open_source"]

LAYOUTS = (dataset, seven_scenes, tum, icl_nuim, replica, scannet, hm3d, tartanground, coda)


def open_source(path: str | Path, world_up: Sequence[float] = (), floor_m: float = 0.0, robot: str = "") -> Source:
    """The source at `path`, by its layout.

    `world_up` (x, y, z) is the direction that points up in the source's world, empty for what its layout says;
    `floor_m` is the height of its floor in that direction. Poses come out in a world with z up and the floor at zero;
    ground truth stays in the world as it comes out when neither is given. `robot` picks one robot of a log, empty for
    the first. Raises SourceError.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f"the source {path} does not exist: give a dataset folder, a 7-Scenes folder or an MCAP log")
    if path.is_file() and path.suffix == ".mcap":
        return recording.load(path, world_up, floor_m, robot)
    for layout in LAYOUTS:
        if layout.fits(path):
            return layout.load(path, world_up, floor_m)
    looks = ", ".join(layout.LOOKS for layout in LAYOUTS)
    raise SourceError(f"{path} is no known source: looked for {looks}, or a file ending in .mcap (log)")
