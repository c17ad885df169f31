"""One turn or frame of a lidar: its points, when each was measured, and where the sensor was then (pure)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from prior_sg.services.geometry import transform

TIMES = ("t", "time", "timestamp", "timestamps", "offset_time", "time_offset", "time_stamp", "point_time_offset")
MOST_POINTS = 1 << 25
NEAREST_M = 0.1  # drivers write zeros where nothing came back, and see their own mount
SLICE_NS = 1_000_000  # within which the sensor is taken to stand still
LONGEST_NS = 1_000_000_000  # a sweep; longer offsets are no offsets
EDGE_NS = 100_000_000  # a last sweep may end so long after the last pose
DATES = ((1e17, 1), (1e14, 10**3), (1e11, 10**6), (1e8, 10**9))  # times from here on are dates of so many ns per unit


class CloudError(ValueError):
    """A cloud cannot be used; the text is the reason."""


@dataclass(frozen=True)
class Sweep:
    """Points (n, 3) in the sensor's frame, and when each was measured, ns after the sweep's stamp; None = at once."""

    points_lidar: np.ndarray
    offsets_ns: np.ndarray | None = None


def sweep_of(columns: Mapping[str, np.ndarray], stamp_ns: int) -> Sweep:
    """The sweep of named numbers of its points, of any shape. Raises CloudError.

    Whole numbers of time are nanoseconds and others seconds, after the stamp; such as are dates count as what they are.
    """
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        held = ", ".join(name[:20] for name in list(columns)[:12]) or "nothing"
        raise CloudError(f"its points lack {', '.join(missing)}; they have {held}")
    points = np.stack([np.ravel(columns[name]).astype(np.float64) for name in "xyz"], axis=1)
    with np.errstate(invalid="ignore", over="ignore"):
        kept = np.isfinite(points).all(axis=1) & ((points**2).sum(axis=1) >= NEAREST_M**2)
    times = next((np.ravel(columns[name]) for name in TIMES if name in columns), None)
    return Sweep(points[kept], None if times is None else _offsets_ns(times[kept], stamp_ns))


def _offsets_ns(times: np.ndarray, stamp_ns: int) -> np.ndarray | None:
    """Nanoseconds after the stamp; None where all points have one time. Raises CloudError."""
    if not len(times) or (times == times[0]).all():
        return None
    if not np.isfinite(times.astype(np.float64)).all():
        raise CloudError("its points have times that are no numbers")
    whole = times.dtype.kind in "iu"
    largest = float(np.abs(times.astype(np.float64)).max())
    dated = 0 if whole and largest < LONGEST_NS else next((ns for least, ns in DATES if largest >= least), 0)
    if whole:
        offsets = times.astype(np.int64) * (dated or 1)
    else:
        offsets = np.rint(times.astype(np.longdouble) * (dated or 10**9)).astype(np.int64)
    offsets -= stamp_ns if dated else 0
    if np.abs(offsets).max() > LONGEST_NS:
        raise CloudError(f"its points were measured up to {np.abs(offsets).max() / 1e9:.3g} s from its stamp")
    return offsets


def in_world(sweep: Sweep, stamp_ns: int, world_from_lidar: Callable[[int], np.ndarray]) -> np.ndarray:
    """Points (n, 3) where they were measured, with the sensor's pose at the time of each. Raises what the poses do."""
    if sweep.offsets_ns is None:
        return transform(world_from_lidar(stamp_ns), sweep.points_lidar)
    slices, index = np.unique(sweep.offsets_ns // SLICE_NS, return_inverse=True)
    middles_ns = slices * SLICE_NS + SLICE_NS // 2
    poses = np.stack([world_from_lidar(stamp_ns + int(middle)) for middle in middles_ns])[index]
    return np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.points_lidar) + poses[:, :3, 3]
