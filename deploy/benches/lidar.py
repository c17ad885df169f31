"""What few rings of a lidar cost: the sample's depth, seen along rings only and upsampled again, against all of it.

Rings cover the camera's height of view evenly, and have 1 800 columns a turn, in the camera's own place.
"""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
from scipy.ndimage import distance_transform_edt

from prior_sg.deploy.evaluation import methods, runner
from prior_sg.deploy.evaluation.datasets import of_sequence
from prior_sg.deploy.evaluation.perception import Cache, Perceiver
from prior_sg.deploy.sample.packed import keyframe_of, write_log
from prior_sg.deploy.settings import DEMO_ENVIRONMENT
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.ingest.core.clouds.upsampling import splatted, upsampled
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.pixels import eight_bit, encoded, millimetres, stored
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.registry import BY_NAME

RINGS, COLUMNS = (16, 32, 64), 1800
TASK = "real-estate listing"
WRONG = 0.05  # share of the true depth off which depth is wrong
Upsample = Callable[[np.ndarray, Intrinsics, np.ndarray], np.ndarray]


def nearest(points_camera: np.ndarray, camera: Intrinsics, picture: np.ndarray) -> np.ndarray:
    """Each pixel has the depth of the point nearest to it."""
    depth_m = splatted(points_camera, camera)
    rows, columns = distance_transform_edt(depth_m == 0, return_distances=False, return_indices=True)
    return depth_m[rows, columns]


WAYS: dict[str, Upsample] = {
    "nearest": nearest,
    "surfaces": lambda points, camera, picture: upsampled(points, camera, None),
    "upsampled": upsampled,
}


def along_rings(depth_m: np.ndarray, camera: Intrinsics, rings: int) -> np.ndarray:
    """Points (n, 3) that a lidar in the camera's place measures, of a depth image (h, w)."""
    high = np.arctan(max(camera.cy_px, camera.height_px - 1 - camera.cy_px) / camera.fy_px)
    wide = np.arctan(max(camera.cx_px, camera.width_px - 1 - camera.cx_px) / camera.fx_px)
    elevation = np.linspace(-high, high, rings + 2)[1:-1, None]
    azimuth = np.arange(-wide, wide, 2 * np.pi / COLUMNS)[None]
    x, y = np.broadcast_arrays(np.tan(azimuth), np.tan(elevation) / np.cos(azimuth))
    u = np.rint(camera.fx_px * x + camera.cx_px).astype(int)
    v = np.rint(camera.fy_px * y + camera.cy_px).astype(int)
    seen = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    z = depth_m[v[seen], u[seen]]
    points = np.stack((x[seen] * z, y[seen] * z, z), axis=1)
    return points[z > 0]


def lidar_bench(source: Path) -> tuple[dict, dict]:
    """Depth, places and regions for each number of rings and each way of upsampling, and for the full depth."""
    metrics: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        logs = {"full": source}
        for rings in RINGS:
            for name, way in WAYS.items():
                key = f"{name}_{rings}"
                logs[key] = folder / f"{key}.mcap"
                packed = _pack(source, logs[key], rings, way)
                metrics |= {f"{key}_{what}": value for what, value in packed.items()}
        for key, scores in _scores(logs, folder).items():
            metrics |= {f"{key}_{what}": value for what, value in scores.items()}
    return metrics, {"source": source.name, "columns": COLUMNS, "wrong": WRONG, "encoder": "as configured"}


def _pack(source: Path, log: Path, rings: int, way: Upsample) -> dict[str, float]:
    """Write the source with depth of few rings; how much of its depth came back, and how well."""
    shares: list[tuple[float, float]] = []

    def keyframes() -> Iterator[Keyframe]:
        for frame in open_source(source):
            if not isinstance(frame, RawFrame):
                continue
            true_m = stored(frame.depth) * np.float64(frame.depth_scale_m)
            picture = eight_bit(frame.color)
            depth_m = way(along_rings(true_m, frame.intrinsics, rings), frame.intrinsics, picture)
            both = (depth_m > 0) & (true_m > 0)
            wrong = np.abs(depth_m - true_m)[both] > WRONG * true_m[both]
            shares.append((both.sum() / max(1, (true_m > 0).sum()), float(wrong.mean())))
            millimetred = msgspec.structs.replace(frame, depth_scale_m=0.001)
            yield keyframe_of(millimetred, "robot1", frame.color, encoded(millimetres(depth_m), ".png"))

    write_log(log, keyframes(), "robot1", f"{rings} rings of {source.name}", open_source(source).ground_truth)
    covered, wrong = np.mean(shares, axis=0)
    return {"covered": float(covered), "wrong": float(wrong)}


def _scores(logs: dict[str, Path], folder: Path) -> dict[str, dict[str, float]]:
    """Places and region scores of each log."""
    datasets = {key: of_sequence(log, DEMO_ENVIRONMENT, TASK) for key, log in logs.items()}
    ours = methods.ours(BY_NAME["segmenter"].config())
    perceiver = Perceiver({}, Cache(folder / "cache"), lambda *_: None)
    results = runner.run(list(datasets.values()), [ours], perceiver.perceive, lambda *_: None)
    scenes = {picture.sequence: picture.scene for picture in results.pictures}
    return {
        key: {
            "places": float(len(scenes[dataset.name].place_ids)),
            **{what: results.mean(ours.name, what, dataset.name) for what in ("f1_s", "f1_g")},
        }
        for key, dataset in datasets.items()
    }
