"""Work on a part of the map in slices, each of which can be brought up to date by itself (pure).

Waves run through neighbouring voxels, so what two slices share lies along their common sides: slices are compact in
plan, and hold whole columns, from the floor to the ceiling that most distances are measured to.
"""

import numpy as np


def slices(cells: np.ndarray, most: int, camera: np.ndarray) -> list[np.ndarray]:
    """Cells (n, 2 or 3) in groups of at most `most`, but for columns that alone are higher; those nearest to the camera
    in plan first.

    `camera` (2,) is in cells. What is at most `most` stays as it is.
    """
    if len(cells) <= most:
        return [cells]
    groups = halved(cells, most)
    groups.sort(key=lambda group: float(((group[:, :2].mean(axis=0) + 0.5 - camera) ** 2).sum()))
    return groups


def halved(cells: np.ndarray, most: int) -> list[np.ndarray]:
    """Cells parted across their longer side in plan until each part is small enough or a single column."""
    spans = np.ptp(cells[:, :2], axis=0)
    if len(cells) <= most or not spans.any():
        return [cells]
    along = cells[:, int(spans.argmax())]
    middle = np.sort(along)[len(along) // 2]
    low = along < (middle if middle > along.min() else middle + 1)
    return halved(cells[low], most) + halved(cells[~low], most)
