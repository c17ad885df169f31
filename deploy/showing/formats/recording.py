"""The scene as a recording of Rerun, with the timelines `stamp` and `revision`.

Every layer is one entity with all its points, lines or boxes, logged when it has changed: entities per place would make
the viewer slow and the file large. `rerun --memory-limit 2GB scene.rrd` bounds what the viewer keeps.
"""

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.deploy.showing.colors import UNLABELLED, label_colors
from prior_sg.deploy.showing.material import Material, Moment
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene

EDGE_COLOR, PATH_COLOR, OBJECT_COLOR, OPENING_COLOR = (120, 126, 134), (230, 120, 40), (150, 156, 164), (214, 39, 40)
Colors = dict[str, tuple[int, int, int]]
Layer = tuple[str, str, dict[str, Any]]  # its name, a shape of Rerun, and what that is made of


def write_rrd(material: Material, path: Path) -> None:
    """The moments of a run, or the scene alone as the only one."""
    import rerun

    scene = material.scene
    recording = rerun.RecordingStream("prior-sg", recording_id=f"{scene.robot}-{scene.stamp_ns}", send_properties=False)
    stream = rerun.binary_stream(recording)  # written by us: Rerun's own writer ends the process on a full disk
    recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("world", rerun.AnyValues(robot=scene.robot, task=scene.task, origin_m=[*scene.origin_m]), static=True)
    if material.cloud is not None:
        points = rerun.Points3D(material.cloud.points_world, colors=material.cloud.colors, radii=0.01)
        recording.log("world/map", points, static=True)
    logged = dict[str, bytes]()
    for moment in material.moments or [Moment(0, scene)]:
        recording.set_time("stamp", timestamp=np.datetime64(moment.scene.stamp_ns, "ns"))
        recording.set_time("revision", sequence=moment.revision)
        for name, shape, parts in _layers(moment.scene, label_colors(scene) | label_colors(moment.scene)):
            if logged.get(name) != (content := pickle.dumps(parts)):
                recording.log(f"world/{name}", getattr(rerun, shape)(**parts))
                logged[name] = content
    content = stream.read() or b""
    recording.disconnect()
    path.write_bytes(content)


def _layers(scene: Scene, colors: Colors) -> Iterator[Layer]:
    names = {region.id: region.label for region in scene.regions}
    hues = [colors.get(names.get(region, ""), UNLABELLED) for region in scene.place_regions.tolist()]
    yield "places", "Points3D", {"positions": scene.positions_m, "colors": hues, "radii": 0.06}
    ends_m = scene.positions_m[np.searchsorted(scene.place_ids, scene.edges)]
    yield "edges", "LineStrips3D", {"strips": ends_m, "colors": EDGE_COLOR, "radii": 0.01}
    yield "trajectory", "LineStrips3D", {"strips": [scene.trajectory], "colors": PATH_COLOR, "radii": 0.02}
    openings_m = scene.positions_m[np.searchsorted(scene.place_ids, scene.frontier_ids)]
    arrows = {"origins": openings_m, "vectors": scene.frontier_directions * 0.5, "colors": OPENING_COLOR}
    yield "frontiers", "Arrows3D", arrows
    floor_m = float(scene.positions_m[:, 2].min()) if len(scene.place_ids) else 0.0
    yield from _regions(scene.regions, colors, floor_m)
    boxes = np.array([(*item.min_m, *item.max_m) for item in scene.objects], np.float32).reshape(-1, 2, 3)
    labels = [item.label or "?" for item in scene.objects]
    sizes = {"centers": boxes.mean(axis=1), "sizes": boxes[:, 1] - boxes[:, 0]}
    spots_m = np.array([one.position_m for one in scene.markers], np.float32).reshape(-1, 3)
    told = [f"marker {one.id}{', in doubt' if one.doubt else ''}" for one in scene.markers]
    yield "markers", "Points3D", {"positions": spots_m, "labels": told, "colors": EDGE_COLOR, "radii": 0.08}
    yield "objects", "Boxes3D", sizes | {"labels": labels, "colors": OBJECT_COLOR}


def _regions(regions: list[Region], colors: Colors, floor_m: float) -> Iterator[Layer]:
    """Outlines at the height of the lowest places, and names where the regions are."""
    outlined = [region for region in regions if len(region.hull_m) > 2]
    strips = [[(x, y, floor_m) for x, y in (*region.hull_m, region.hull_m[0])] for region in outlined]
    hues = [colors.get(region.label, UNLABELLED) for region in outlined]
    yield "regions/outlines", "LineStrips3D", {"strips": strips, "colors": hues, "radii": 0.03}
    middles_m = np.array([region.position_m for region in regions], np.float32).reshape(-1, 3)
    titles = [f"{region.label} {region.probability:.0%}" for region in regions]
    hues = [colors.get(region.label, UNLABELLED) for region in regions]
    yield "regions/names", "Points3D", {"positions": middles_m, "labels": titles, "colors": hues, "radii": 0.12}
