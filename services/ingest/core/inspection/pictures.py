"""Cameras, depth values, and whether colour lies on depth (pure)."""

import math
from collections.abc import Sequence

import numpy as np

from prior_sg.services.ingest.core.detection import likely_unit_m
from prior_sg.services.ingest.core.inspection.findings import Finding, note, ok, problem
from prior_sg.services.ingest.core.inspection.sample import SATURATED, Recording, Shot

USUAL_VIEW_DEG = (30.0, 130.0)
USUAL_CENTER = 0.1  # share of the image by which the principal point may lie beside the middle
SQUARE = 0.05  # by which fx and fy may differ
USUAL_MEDIAN_M = (0.2, 60.0)
ABSURD_MEDIAN_M = (0.01, 300.0)
REPEATED = 0.03  # share of measured pixels that one value at the far end may have
FEW_VALID = 0.2


def judge(recording: Recording) -> list[Finding]:
    """Findings about the images of the sample."""
    shots = recording.shots
    damaged = [
        problem("images", f"{count} of the sample cannot be decoded: {reason}", "mend these files")
        for reason, count in recording.damaged.items()
    ]
    if not shots:
        return damaged
    return [*damaged, *_camera(shots[0]), *_depth(shots, recording.depth_unit_m or shots[0].depth_scale_m)]


def _camera(shot: Shot) -> list[Finding]:
    camera = shot.intrinsics
    views_deg = [
        2 * math.degrees(math.atan(size / 2 / focal))
        for size, focal in ((camera.width_px, camera.fx_px), (camera.height_px, camera.fy_px))
    ]
    said = f"{camera.width_px} x {camera.height_px} pixels, {views_deg[0]:.0f} x {views_deg[1]:.0f} degrees of view"
    offset = max(
        abs(camera.cx_px - (camera.width_px - 1) / 2) / camera.width_px,
        abs(camera.cy_px - (camera.height_px - 1) / 2) / camera.height_px,
    )
    if not USUAL_VIEW_DEG[0] <= max(views_deg) <= USUAL_VIEW_DEG[1]:
        return [problem("intrinsics", f"{said} is no usual camera", "--intrinsics fx,fy,cx,cy")]
    if not (0 <= camera.cx_px < camera.width_px and 0 <= camera.cy_px < camera.height_px):
        return [
            problem("intrinsics", f"{said}; the principal point lies outside the image", "--intrinsics fx,fy,cx,cy")
        ]
    parts = [f"the principal point lies {offset:.0%} of the image beside the middle"] if offset > USUAL_CENTER else []
    if abs(camera.fx_px / camera.fy_px - 1) > SQUARE:
        parts.append(f"pixels are not square: fx {camera.fx_px:.1f}, fy {camera.fy_px:.1f}")
    if parts:
        return [note("intrinsics", f"{said}; {'; '.join(parts)}", "right if images were cropped or stretched")]
    return [ok("intrinsics", said)]


def _depth(shots: Sequence[Shot], unit_m: float) -> list[Finding]:
    """`unit_m` is that of the numbers in the files, which may be others than the shots'."""
    values = np.concatenate([shot.depth[::4, ::4].ravel() for shot in shots]).astype(np.float64)
    measured = values[values > 0]
    valid = len(measured) / len(values)
    if not len(measured):
        return [problem("depth", "no pixel of the sample has a measurement", "give depth images", hopeless=True)]
    scale_m = shots[0].depth_scale_m
    if not math.isfinite(scale_m):
        better_m = likely_unit_m(float(np.median(measured)))
        text = f"a unit of depth of {scale_m} m is none"
        return [problem("depth", text, f"--depth-scale {better_m:.6g}", hopeless=True)]
    low, median, high = np.percentile(measured, (1, 50, 99)) * scale_m
    said = f"{low:.4g} to {high:.4g} m, median {median:.4g} m, in {valid:.0%} of the pixels"
    if not USUAL_MEDIAN_M[0] <= median <= USUAL_MEDIAN_M[1]:
        better_m = likely_unit_m(median / unit_m)
        hopeless = not ABSURD_MEDIAN_M[0] <= median <= ABSURD_MEDIAN_M[1]
        text = f"the median depth is {median:.4g} m with {unit_m:.4g} m per unit"
        return [problem("depth", text, f"--depth-scale {better_m:.6g}", hopeless=hopeless)]
    found = [note("depth", said) if valid < FEW_VALID else ok("depth", said)]
    return found + _repeated(measured, scale_m, unit_m)


def _repeated(measured: np.ndarray, scale_m: float, unit_m: float) -> list[Finding]:
    """One value at the far end that many pixels have: a limit, or a sign for "nothing measured"."""
    largest = measured.max()
    share = float((measured == largest).mean())
    if largest >= SATURATED:
        text = f"{share:.1%} of measured pixels have the value {SATURATED} ({SATURATED * scale_m:.1f} m)"
        verdict = problem if share > REPEATED else note
        return [verdict("invalid depth", text, f"--depth-invalid {SATURATED}")]
    if share > REPEATED:
        value = f"{largest * scale_m / unit_m:.6g}"
        text = f"{share:.1%} of measured pixels have the largest value {value} ({largest * scale_m:.1f} m)"
        return [note("invalid depth", text, f"--depth-invalid {value} if it means that nothing was measured")]
    return []
