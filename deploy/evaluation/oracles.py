"""Perfect parts, for finding out how much of an error is whose: the true region's text instead of pixels, and the
true objects instead of detected ones."""

import msgspec
import numpy as np

from prior_sg.deploy.truth import GroundTruth, TrueObject, in_view
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.priors import Prior
from prior_sg.services.geometry import transform
from prior_sg.services.segmenter.core.experts.context import ObjectView

NOISE = 0.5  # length of the noise added to the unit embedding of a region


def seen_objects(objects: tuple[TrueObject, ...], prior: Prior, voxels: VoxelMap) -> ObjectView:
    """The objects that the prior names and the robot has seen, that is, whose box holds an occupied voxel's centre."""
    names = [item.name for item in prior.objects]
    seen = [item for item, is_seen in zip(objects, in_view(objects, voxels), strict=True) if is_seen]
    seen = [item for item in seen if item.label in names]
    concepts = np.eye(len(names))[[names.index(item.label) for item in seen]].reshape(-1, len(names))
    positions_m = np.array([(item.min_m + item.max_m) / 2 for item in seen]).reshape(-1, 3)
    return ObjectView(ids=np.arange(len(seen)), positions_m=positions_m, concepts=concepts)


def true_features(
    pyramid: Pyramid, truth: GroundTruth, concepts: dict[str, np.ndarray], noise: float = NOISE
) -> Pyramid:
    """The pyramid with each crop's embedding replaced by that of the true region it shows, plus seeded noise.

    A crop shows the region whose polygon and floor hold most of its viewed points; crops that show none of the regions
    in `concepts` (name to unit embedding) are left out.
    """
    named = {region.id: region.label for region in truth.regions if region.label in concepts}
    cells_px, points_m = viewed_points(pyramid)
    regions = truth.region_of(points_m)
    offsets_px = np.abs(cells_px[None] - pyramid.centers_px[:, None])
    covered = (offsets_px < pyramid.sigmas_px[:, None, None]).all(axis=2)
    ids = np.array(sorted(named), np.int64)
    counts = covered.astype(np.float32) @ (regions[:, None] == ids).astype(np.float32)
    kept = counts.any(axis=1) if len(ids) else np.zeros(len(covered), bool)
    rng = np.random.default_rng(pyramid.frame_id)
    dim = pyramid.embeddings.shape[1]
    shown = [concepts[named[int(ids[best])]] for best in counts[kept].argmax(axis=1)] if kept.any() else []
    embeddings = np.array(shown, float).reshape(-1, dim) + noise / np.sqrt(dim) * rng.standard_normal((len(shown), dim))
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    return with_crops(pyramid, kept, embeddings)


def viewed_points(pyramid: Pyramid) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and world positions (n, 3) of the measured cells of the coarse depth surface."""
    camera = pyramid.intrinsics
    rows, columns = pyramid.surface_m.shape
    row, column = np.nonzero(pyramid.surface_m > 0)
    u = (column + 0.5) * camera.width_px / columns - 0.5
    v = (row + 0.5) * camera.height_px / rows - 0.5
    depth_m = pyramid.surface_m[row, column].astype(float)
    x, y = (u - camera.cx_px) / camera.fx_px * depth_m, (v - camera.cy_px) / camera.fy_px * depth_m
    points_m = transform(pyramid.world_from_camera, np.stack((x, y, depth_m), axis=1))
    return np.stack((u, v), axis=1), points_m


def with_crops(pyramid: Pyramid, kept: np.ndarray, embeddings: np.ndarray | None = None) -> Pyramid:
    """Only some crops of a pyramid, by mask, and perhaps with other embeddings."""
    return msgspec.structs.replace(
        pyramid,
        centers_px=pyramid.centers_px[kept],
        sigmas_px=pyramid.sigmas_px[kept],
        layers=pyramid.layers[kept],
        depths_m=pyramid.depths_m[kept],
        embeddings=(pyramid.embeddings[kept] if embeddings is None else embeddings).astype(np.float16),
    )


def top_layer(pyramid: Pyramid) -> Pyramid:
    """Only the largest crops, which show nearly the whole image."""
    layers = pyramid.layers
    return with_crops(pyramid, layers == layers.max(initial=0))
