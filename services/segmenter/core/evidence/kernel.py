"""Semantic integration kernel and temporal fusion: from pyramids to one descriptor per place (pure)."""

from typing import NamedTuple

import msgspec
import numpy as np
import scipy

from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import inverse

ROWS_PER_BLOCK = 128  # places multiplied at once: their sums stay in the processor's cache


class KernelConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Which places a frame observes, and how its crops are weighted."""

    gamma: float = 1.0  # bandwidth of the scale trust, in squared natural logarithms (unpublished)
    min_depth_m: float = 0.3  # places closer to the camera plane are not observed
    max_depth_m: float = 10.0  # nor places further away
    border_share: float = 0.0  # share of the image's sides, at its border, in which places are not observed
    occlusion_tolerance_m: float = (
        0.3  # a place may lie this far behind the depth surface; less than wall and clearance
    )

    def __post_init__(self) -> None:
        if not (self.gamma > 0 and 0 <= self.min_depth_m < self.max_depth_m and 0 <= self.border_share < 0.5):
            raise ValueError("gamma and the depth range must be positive, and border_share below 0.5")


class Frame(NamedTuple):
    """One pyramid, compact: crops sorted by layer, arrays of its own."""

    camera_from_world: np.ndarray  # (4, 4)
    intrinsics: Intrinsics
    centers_px: np.ndarray  # (crop, 2) float32
    sigmas_px: np.ndarray  # (crop,) float32
    layer_starts: np.ndarray  # (layer,) first crop of each layer
    embeddings: np.ndarray  # (crop, dim) float16
    surface_m: np.ndarray  # (row, column) float16, holes filled


def compact(pyramid: Pyramid) -> Frame:
    """What integration needs of a pyramid, copied."""
    order = np.argsort(pyramid.layers, kind="stable")
    return Frame(
        camera_from_world=inverse(pyramid.world_from_camera),
        intrinsics=pyramid.intrinsics,
        centers_px=pyramid.centers_px[order],
        sigmas_px=pyramid.sigmas_px[order],
        layer_starts=np.unique(pyramid.layers[order], return_index=True)[1],
        embeddings=pyramid.embeddings[order],
        surface_m=fill_holes(pyramid.surface_m).astype(np.float16),
    )


def fill_holes(surface_m: np.ndarray) -> np.ndarray:
    """The surface with each unmeasured cell (0) at the depth of the nearest measured one; a copy.

    Sensors lose depth on dark, shiny and far surfaces. The neighbour's depth hides places beyond what was measured
    around the hole, so a hole never shows a place through a wall; without any measurement nothing is visible.
    """
    holes = surface_m <= 0
    if not holes.any() or holes.all():
        return surface_m.copy()
    rows, columns = scipy.ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    return surface_m[rows, columns]


def project(frame: Frame, positions_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and depths (n,) of world positions (n, 3); pixels behind the camera are not meaningful."""
    rotation, shift, camera = frame.camera_from_world[:3, :3], frame.camera_from_world[:3, 3], frame.intrinsics
    x, y, depths_m = (positions_m @ rotation.T + shift).T
    safe_m = np.where(depths_m > 1e-6, depths_m, 1.0)
    pixels = np.stack((x / safe_m * camera.fx_px + camera.cx_px, y / safe_m * camera.fy_px + camera.cy_px), axis=1)
    return pixels, depths_m


def visible(frame: Frame, positions_m: np.ndarray, cfg: KernelConfig) -> np.ndarray:
    """Rows of the places that the frame observes: in front, inside the image, and not behind the depth surface.

    A place counts as hidden when its centre lies behind the surface at its pixel by more than the tolerance, which
    covers the errors of depth and of the coarse surface.
    """
    tangents = frustum_tangents(frame.intrinsics)
    near = in_frustum(frame.camera_from_world, tangents, positions_m, cfg.min_depth_m, cfg.max_depth_m)
    pixels, depths_m = project(frame, positions_m[near])
    size = np.array((frame.intrinsics.width_px, frame.intrinsics.height_px))
    border = cfg.border_share * size
    seen = (depths_m >= cfg.min_depth_m) & (depths_m <= cfg.max_depth_m)
    seen &= ((pixels >= border - 0.5) & (pixels < size - 0.5 - border)).all(axis=1)
    rows = np.flatnonzero(seen)
    cells = ((pixels[rows] + 0.5) / size * frame.surface_m.shape[::-1]).astype(np.int64)
    surface_m = frame.surface_m[cells[:, 1], cells[:, 0]]
    return near[rows[(surface_m > 0) & (depths_m[rows] - cfg.occlusion_tolerance_m <= surface_m)]]


def frustum_tangents(camera: Intrinsics) -> np.ndarray:
    """Bounds (4,) of x / z and y / z inside the image, and one pixel more so that rounding leaves nothing out."""
    left, right = (-1.5 - camera.cx_px) / camera.fx_px, (camera.width_px + 0.5 - camera.cx_px) / camera.fx_px
    top, bottom = (-1.5 - camera.cy_px) / camera.fy_px, (camera.height_px + 0.5 - camera.cy_px) / camera.fy_px
    return np.array((left, right, top, bottom))


@compiled()
def in_frustum(camera_from_world, tangents, positions_m, min_depth_m, max_depth_m):  # noqa: ANN001, ANN201
    """Rows, ascending, of the positions in a frustum; rounding leaves none out that is in it, but takes some beside."""
    found = np.empty(len(positions_m), np.int64)
    count, slack_m, across = 0, 1e-6, camera_from_world[2]
    for row in range(len(positions_m)):
        u, v, w = positions_m[row, 0], positions_m[row, 1], positions_m[row, 2]
        z_m = across[0] * u + across[1] * v + across[2] * w + across[3]
        if z_m < min_depth_m - slack_m or z_m > max_depth_m + slack_m:
            continue  # most are, and a call costs more than this
        if _is_inside(camera_from_world, tangents, positions_m, row, min_depth_m, max_depth_m):
            found[count] = row
            count += 1
    return found[:count].copy()


@compiled()
def frustums_with_any(cameras_from_world, tangents, positions_m, min_depth_m, max_depth_m):  # noqa: ANN001, ANN201
    """Which frustums, ascending, hold any of the positions, as `in_frustum` tells."""
    found, count = np.empty(len(cameras_from_world), np.int64), 0
    middle_m, radius_m = _ball(positions_m)
    for camera in range(len(cameras_from_world)):
        pose, bounds = cameras_from_world[camera], tangents[camera]
        across, along = max(-bounds[0], bounds[1]), max(-bounds[2], bounds[3])
        reach_m = max_depth_m * np.sqrt(1.0 + across * across + along * along) + radius_m + 1e-3
        apart_m2 = 0.0
        for axis in range(3):
            x, y, z = pose[axis, 0] * middle_m[0], pose[axis, 1] * middle_m[1], pose[axis, 2] * middle_m[2]
            apart_m2 += (x + y + z + pose[axis, 3]) ** 2
        if apart_m2 > reach_m * reach_m:  # too far for any
            continue
        for row in range(len(positions_m)):
            if _is_inside(pose, bounds, positions_m, row, min_depth_m, max_depth_m):
                found[count] = camera
                count += 1
                break
    return found[:count].copy()


@compiled()
def _ball(positions_m):  # noqa: ANN001, ANN202
    """Middle and radius of a ball around all positions."""
    middle_m, square_m2 = np.zeros(3), 0.0
    for axis in range(3):
        low_m, high_m = positions_m[:, axis].min(), positions_m[:, axis].max()
        middle_m[axis] = 0.5 * (low_m + high_m)
        square_m2 += (0.5 * (high_m - low_m)) ** 2
    return middle_m, np.sqrt(square_m2)


@compiled()
def _is_inside(pose, tangents, positions_m, row, min_depth_m, max_depth_m):  # noqa: ANN001, ANN202, PLR0917
    slack_m = 1e-6
    u, v, w = positions_m[row, 0], positions_m[row, 1], positions_m[row, 2]
    z_m = pose[2, 0] * u + pose[2, 1] * v + pose[2, 2] * w + pose[2, 3]
    if z_m < min_depth_m - slack_m or z_m > max_depth_m + slack_m:
        return False
    x_m = pose[0, 0] * u + pose[0, 1] * v + pose[0, 2] * w + pose[0, 3]
    y_m = pose[1, 0] * u + pose[1, 1] * v + pose[1, 2] * w + pose[1, 3]
    beside = x_m < tangents[0] * z_m - slack_m or x_m > tangents[1] * z_m + slack_m
    above = y_m < tangents[2] * z_m - slack_m or y_m > tangents[3] * z_m + slack_m
    return not (beside or above)


def kernel(frame: Frame, positions_m: np.ndarray, query_radius_m: float, gamma: float) -> tuple[np.ndarray, np.ndarray]:
    """Integration weights W (place, crop) and trust T (place,) of observed places (eqs. query_state, spatial_affinity,
    scale_trust, observation_trust).

    Crops of one layer have one scale, so w_sca times the highest w_spa of a layer is the highest W in it.
    """
    pixels, depths_m = project(frame, positions_m)
    focal_px = 0.5 * (frame.intrinsics.fx_px + frame.intrinsics.fy_px)
    query_states = np.column_stack((pixels, focal_px * query_radius_m / depths_m)).astype(np.float32)
    crop_states = np.column_stack((frame.centers_px, frame.sigmas_px))
    return weigh(query_states, crop_states, frame.layer_starts, float(gamma))


@compiled(fastmath=True)
def weigh(
    query_states: np.ndarray, crop_states: np.ndarray, layer_starts: np.ndarray, gamma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (place, crop) and trust (place,), float32: eqs. spatial_affinity, scale_trust, observation_trust.

    States are float32 (n, 3): pixel u, v and scale sigma in pixels.
    """
    places, crops, layers = len(query_states), len(crop_states), len(layer_starts)
    weights, trust = np.empty((places, crops), np.float32), np.zeros(places, np.float32)
    crop_logs, sharpness = np.log(crop_states[:, 2]), np.float32(1.0 / gamma)
    for place in range(places):
        u, v, sigma = query_states[place]
        area, log = sigma**2, np.log(sigma)
        for layer in range(layers):
            end = layer_starts[layer + 1] if layer + 1 < layers else crops
            best = np.float32(0.0)
            for crop in range(layer_starts[layer], end):
                du, dv = u - crop_states[crop, 0], v - crop_states[crop, 1]
                spatial = (du * du + dv * dv) / (np.float32(2.0) * (area + crop_states[crop, 2] ** 2))
                scale = (log - crop_logs[crop]) ** 2 * sharpness
                weight = np.exp(-(spatial + scale))
                weights[place, crop] = weight
                best = max(best, weight)
            trust[place] += best
    return weights, trust


class Evidence:
    """Running sums per place over all frames that observed it: sum of T e_p, sum of T, and count.

    Places hold a slot each; slots of removed places are used again.
    """

    def __init__(self) -> None:
        self.slots: dict[int, int] = {}
        self._free: list[int] = []
        self._used = 0
        self.sums = np.zeros((0, 0), dtype=np.float32)  # (slot, dim): sum over frames of T e_p
        self.trust = np.zeros(0)  # (slot,)
        self.frames = np.zeros(0, dtype=np.int64)  # (slot,) keyframes that observed the place

    def add(self, place_ids: list[int]) -> None:
        """Empty slots for these places, which are new or to be integrated afresh."""
        for place in place_ids:
            if place not in self.slots:
                self.slots[place] = self._free.pop() if self._free else self._used
                self._used = max(self._used, self.slots[place] + 1)
        self._reserve(self._used, self.sums.shape[1])
        taken = self.of(place_ids)
        self.sums[taken], self.trust[taken], self.frames[taken] = 0.0, 0.0, 0

    def remove(self, place_ids: list[int]) -> None:
        """Forget places."""
        self._free.extend(self.slots.pop(place) for place in place_ids)

    def of(self, place_ids: list[int]) -> np.ndarray:
        """Slots of places."""
        return np.fromiter((self.slots[place] for place in place_ids), dtype=np.int64, count=len(place_ids))

    def blank(self) -> "Evidence":
        """The same places in the same slots, nothing observed yet."""
        other = Evidence()
        other.slots, other._free, other._used = dict(self.slots), list(self._free), self._used
        other._reserve(self._used, 0)
        return other

    def observe(self, slots: np.ndarray, frame: Frame, weights: np.ndarray, trust: np.ndarray) -> None:
        """Add one frame's observation of the places in `slots` (eqs. single_observation_feature,
        temporal_fusion_places)."""
        self._reserve(self._used, frame.embeddings.shape[1])
        accumulate(self.sums, slots, weights, trust, frame.embeddings.astype(np.float32))
        self.trust[slots] += trust
        self.frames[slots] += 1

    def fits(self, frame: Frame) -> bool:
        """Whether the frame's embeddings have as many dimensions as those observed before."""
        return not self.frames.any() or frame.embeddings.shape[1] == self.sums.shape[1]

    def descriptors(self, slots: np.ndarray) -> np.ndarray:
        """d_vis (place, dim), unit length; zero for places never observed."""
        sums = self.sums[slots].astype(np.float64)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0)

    def _reserve(self, slots: int, dim: int) -> None:
        """Room for `slots` slots of `dim` dimensions; the dimensions change only while nothing was observed."""
        have, width = self.sums.shape
        if slots <= have and dim == width:
            return
        if dim != width and self.frames.any():
            raise ValueError(f"embeddings of {dim} dimensions do not go with those of {width}")
        size = max(have, slots if slots <= have else max(slots, 2 * have, 64))
        sums = np.zeros((size, dim), dtype=np.float32)
        if dim == width:
            sums[:have] = self.sums
        self.sums = sums
        self.trust = np.concatenate((self.trust, np.zeros(size - have)))
        self.frames = np.concatenate((self.frames, np.zeros(size - have, dtype=np.int64)))


@compiled()
def accumulate(
    sums: np.ndarray, slots: np.ndarray, weights: np.ndarray, trust: np.ndarray, embeddings: np.ndarray
) -> None:
    """sums[slots] += (trust * weights) @ embeddings, float32, in blocks of rows; no slot twice."""
    dim = embeddings.shape[1]
    scaled = np.empty((ROWS_PER_BLOCK, weights.shape[1]), np.float32)
    products = np.empty((ROWS_PER_BLOCK, dim), np.float32)
    for start in range(0, len(slots), ROWS_PER_BLOCK):
        count = min(ROWS_PER_BLOCK, len(slots) - start)
        for row in range(count):
            for crop in range(weights.shape[1]):
                scaled[row, crop] = weights[start + row, crop] * trust[start + row]
        np.dot(scaled[:count], embeddings, products[:count])
        for row in range(count):
            target = sums[slots[start + row]]
            for column in range(dim):
                target[column] += products[row, column]


class Targets(NamedTuple):
    """Places to integrate into: the slots of their evidence, and where they are in the world."""

    slots: np.ndarray  # (place,)
    positions_m: np.ndarray  # (place, 3)


def integrate(
    evidence: Evidence, frame: Frame, targets: Targets, query_radius_m: float, cfg: KernelConfig
) -> np.ndarray:
    """Add one frame to the evidence of the targets that it observes; returns their rows."""
    if not len(frame.sigmas_px):
        return np.zeros(0, dtype=np.int64)
    rows = visible(frame, targets.positions_m, cfg)
    if len(rows):
        weights, trust = kernel(frame, targets.positions_m[rows], query_radius_m, cfg.gamma)
        evidence.observe(targets.slots[rows], frame, weights, trust)
    return rows
