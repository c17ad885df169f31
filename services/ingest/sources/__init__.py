"""Sources of posed RGB-D frames: one loader per file, and the one place that tells layouts apart."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from prior_sg.services.ingest.core.options import ReadOptions, is_camera, is_robot
from prior_sg.services.ingest.sources import (
    coda,
    dataset,
    generic,
    hm3d,
    icl_nuim,
    recording,
    replica,
    scannet,
    seven_scenes,
    tartanground,
    tum,
)
from prior_sg.services.ingest.sources.base import Found, Source, SourceError
from prior_sg.services.ingest.sources.clouds import folder as clouds_folder
from prior_sg.services.ingest.sources.devices import live as devices_live
from prior_sg.services.ingest.sources.exports import euroc, record3d, rtabmap, stray_scanner
from prior_sg.services.ingest.sources.hints import hint
from prior_sg.services.ingest.sources.mono.film import with_depth
from prior_sg.services.ingest.sources.normalise import finish
from prior_sg.services.ingest.sources.ros import live as ros_live
from prior_sg.services.ingest.sources.ros import recordings as ros_recordings
from prior_sg.services.ingest.sources.tables import LastingError

__all__ = ["LAYOUT_NAMES", "LastingError", "ReadOptions", "Source", "SourceError", "open_source"]

LAYOUTS = (
    dataset,
    seven_scenes,
    tum,
    icl_nuim,
    replica,
    scannet,
    hm3d,
    tartanground,
    coda,
    clouds_folder,
    stray_scanner,
    record3d,
    rtabmap,
    euroc,
    generic,
    ros_recordings,
)
LAYOUT_NAMES = (*(layout.NAME for layout in LAYOUTS), recording.NAME)


def open_source(
    path: str | Path,
    world_up: Sequence[float] = (),
    floor_m: float = 0.0,
    robot: str = "",
    options: ReadOptions | None = None,
) -> Source:
    """The source at `path`, by its layout.

    `options` say how it is read where its files do not, or say it wrongly. `world_up` (x, y, z) is the direction that
    points up in the source's world, empty for what its layout says; `floor_m` is the height of its floor in that
    direction. Poses come out in a world with z up and the floor at zero; ground truth stays in the world as it comes
    out when neither is given. `robot` picks one robot of a log, empty for the first; these three go before `options`.
    `ros2:/` is a running robot, `realsense:` and `oak:` are cameras. Raises SourceError.
    """
    path = Path(path)
    options = _with(options or ReadOptions(), world_up, floor_m, robot)
    if is_camera(str(path)):
        return devices_live.load(path, options)
    if is_robot(str(path)):
        return ros_live.load(path, options)
    if not path.exists():
        known = "a dataset folder, a 7-Scenes folder, a ROS bag or an MCAP log"
        raise SourceError(f"the source {path} does not exist: give {known}")
    if options.layout:
        return _as_told(path, options)
    if path.is_file() and path.suffix == ".mcap" and not ros_recordings.fits(path):
        return recording.load(path, options)
    for layout in LAYOUTS:
        if layout.fits(path):
            return _finished(layout.load(path, options), options)
    said = hint(path, lambda folder: any(layout.fits(folder) for layout in LAYOUTS))
    looks = ", ".join(layout.LOOKS for layout in LAYOUTS)
    raise SourceError(
        f"{path} is no known source{f': {said}' if said else ''}; looked for {looks}, or a file ending in .mcap (log)"
    )


def _with(options: ReadOptions, world_up: Sequence[float], floor_m: float, robot: str) -> ReadOptions:
    """The options with what was given beside them."""
    return msgspec.structs.replace(
        options,
        world_up=list(world_up) or options.world_up,
        floor_m=floor_m or options.floor_m,
        source_robot=robot or options.source_robot,
    )


def _as_told(path: Path, options: ReadOptions) -> Source:
    """The source in the layout that was named. Raises SourceError."""
    if options.layout == recording.NAME:
        return recording.load(path, options)
    layout = next((layout for layout in LAYOUTS if options.layout == layout.NAME), None)
    if layout is None:
        raise SourceError(f"there is no layout {options.layout!r}; known: {', '.join(LAYOUT_NAMES)}")
    try:
        found = layout.load(path, options)
    except OSError as error:
        raise SourceError(f"{path} cannot be read as {layout.NAME}: {error.strerror}") from error
    return _finished(replace(found, why=("as told",)), options)


def _finished(found: Found, options: ReadOptions) -> Source:
    """The source of what a loader found, with depth where its files have none. Raises SourceError."""
    if found.depthless:
        return finish(*with_depth(found, options))
    if options.depth_model and found.layout != euroc.NAME:
        raise SourceError(f"{found.path} has depth, so that a network has nothing to do: leave out --depth-model")
    return finish(found, options)
