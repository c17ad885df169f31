"""Whether colour and depth images show the same pixels: where depth steps, colour mostly does too (pure)."""

from collections.abc import Sequence

import numpy as np

from prior_sg.services.ingest.core.inspection.findings import Finding, note, ok, problem
from prior_sg.services.ingest.core.inspection.sample import Shot
from prior_sg.services.opencv import cv2

WIDTH_PX = 160  # images are compared at about this width
STEP = 0.06  # of depth, relative, that is an edge
REACH = 0.2  # shifts looked at, share of the width
ZOOMS = (1.0, 0.6, 0.7, 0.8, 0.87, 0.93, 1.07, 1.15, 1.25, 1.4, 1.6)
BROAD_PX = 13  # at WIDTH_PX
NEAR_PX = 2  # at WIDTH_PX: taken as no shift
LEAST_EDGES = 400  # pixels over all shots
SIGNIFICANT, CERTAIN, SEEN = 6.0, 8.0, 4.0  # standard deviations of the scores of all shifts
ALIKE_PX = 3  # at WIDTH_PX: shifts that two halves of the shots must share
BETTER = 1.25  # of the score as it is
FAR = 0.04  # share of the width from which a shift is a problem
MEND = "register depth to colour, or give the intrinsics of both cameras"
Edges = tuple[np.ndarray, np.ndarray, tuple[int, int]]


def judge(shots: Sequence[Shot]) -> list[Finding]:
    """The shift and zoom of colour against depth, if any."""
    prepared = [_edges(shot.depth, shot.grey) for shot in shots if shot.grey is not None]
    if sum(int(steps.sum()) for steps, _, _ in prepared) < LEAST_EDGES:
        return [note("registration", "too few edges to say whether colour lies on depth")]
    found = {zoom: scores(prepared, zoom) for zoom in ZOOMS}
    zoom, (shift_px, best) = max(((zoom, _peak(grid)) for zoom, grid in found.items()), key=lambda item: item[1][1])
    here = _middle(found[1.0])
    far = float(np.abs(shift_px).max()) / WIDTH_PX > FAR or abs(zoom - 1) > 2 * FAR
    beside = zoom != 1.0 or np.abs(shift_px).max() > NEAR_PX
    clear = beside and best >= (SIGNIFICANT if far else CERTAIN) and best > BETTER * here
    if clear and _in_both_halves(prepared, zoom, shift_px):
        verdict = problem if far else note
        return [verdict("registration", _said(shift_px, zoom, shots[0].intrinsics.width_px), MEND)]
    if here >= SEEN:
        return [ok("registration", "edges of colour and depth coincide")]
    return [ok("registration", "edges of colour and depth do not say whether the images are registered")]


def _in_both_halves(prepared: Sequence[Edges], zoom: float, shift_px: np.ndarray) -> bool:
    """Whether each half of the shots says the same."""
    halves = prepared[::2], prepared[1::2]
    shifts = [_peak(scores(half, zoom))[0] for half in halves if half]
    return len(shifts) == 2 and all(np.abs(shift - shift_px).max() <= ALIKE_PX for shift in shifts)


def _said(shift_px: np.ndarray, zoom: float, width_px: int) -> str:
    right, down = (round(float(value) * width_px / WIDTH_PX) for value in shift_px)
    sides = (
        f"{abs(right)} px {'right' if right >= 0 else 'left'} of and {abs(down)} px {'below' if down >= 0 else 'above'}"
    )
    return f"colour lies {sides} depth" + (f", {zoom:g} times as large" if zoom != 1 else "")


def scores(prepared: Sequence[Edges], zoom: float) -> np.ndarray:
    """For each shift (2 r + 1, 2 r + 1; rows down, columns right) how many deviations better colour fits than usual."""
    reach = round(REACH * WIDTH_PX)
    total = np.zeros((2 * reach + 1, 2 * reach + 1))
    for steps, spectrum, shape in prepared:
        zoomed = _zoomed(steps, zoom)
        product = spectrum * np.conj(np.fft.rfft2(zoomed, shape))
        correlation = np.roll(np.fft.irfft2(product, shape), (reach, reach), axis=(0, 1))
        total += correlation[: 2 * reach + 1, : 2 * reach + 1] / max(1.0, zoomed.sum())
    sharp = total - cv2.blur(total, (BROAD_PX, BROAD_PX))  # images are alike over many pixels, edges over few
    return (sharp - sharp.mean()) / (sharp.std() or 1.0)


def _edges(depth: np.ndarray, grey: np.ndarray) -> Edges:
    """Where depth steps (h, w) 0 or 1, at WIDTH_PX columns; the spectrum of the colour's gradient, and its shape."""
    height_px, width_px = depth.shape
    size = WIDTH_PX, max(1, round(height_px * WIDTH_PX / width_px))
    depth = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    steps = ((near > 0) & (far > near * (1 + STEP))).astype(np.float64)
    steps *= (depth - near) < (far - depth)  # the nearer side, whose outline colour shows
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    gradient = np.minimum(gradient, 2 * gradient.mean() + 1e-6)  # a few strong edges must not decide alone
    shape = size[1] + 2 * round(REACH * WIDTH_PX), WIDTH_PX + 2 * round(REACH * WIDTH_PX)
    return steps, np.fft.rfft2(gradient - gradient.mean(), shape), shape


def _zoomed(steps: np.ndarray, zoom: float) -> np.ndarray:
    if zoom == 1.0:
        return steps
    height_px, width_px = steps.shape
    mapping = np.array(((zoom, 0, (1 - zoom) * width_px / 2), (0, zoom, (1 - zoom) * height_px / 2)))
    return cv2.warpAffine(steps, mapping, (width_px, height_px), flags=cv2.INTER_NEAREST)


def _peak(grid: np.ndarray) -> tuple[np.ndarray, float]:
    """The best shift, (right, down) in pixels at WIDTH_PX, and its score."""
    row, column = np.unravel_index(int(grid.argmax()), grid.shape)
    reach = grid.shape[0] // 2
    return np.array((column - reach, row - reach)), float(grid.max())


def _middle(grid: np.ndarray) -> float:
    reach = grid.shape[0] // 2
    window = slice(reach - NEAR_PX, reach + NEAR_PX + 1)
    return float(grid[window, window].max())
