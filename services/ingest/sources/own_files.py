"""Which files of a folder of one's own belong to which frame: folders by their names, files by the number in theirs."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.sources.pose_lists import PoseList

COLORS = ("rgb", "color", "colour", "image", "images", "rgbs", "colors", "colours")
DEPTHS, POSES = ("depth", "depths"), ("pose", "poses")
PICTURES, ARRAYS = (".png", ".jpg", ".jpeg", ".bmp", ".webp"), (".png", ".npy", ".tiff", ".tif", ".exr")
MATRICES = (".txt", ".npy", ".csv", ".pose")


@dataclass(frozen=True)
class Files:
    """The files of one frame."""

    color: Path | None
    depth: Path | None
    pose: Path | np.ndarray | None  # a file, or the numbers of a list


@dataclass(frozen=True)
class Folder:
    """What of a folder in a layout of one's own is taken."""

    colors: dict[float, Path]  # by the number of the frame
    depths: dict[float, Path]
    poses: Mapping[float, Path | np.ndarray]
    held: tuple[str, ...]  # what was found
    listed: PoseList | None = None
    depthless: bool = False  # there is colour alone


def folder_of(path: Path, names: Sequence[str]) -> Path | None:
    """The folder in `path` with the first of these names, in letters of any size."""
    found = {child.name.lower(): child for child in path.iterdir() if child.is_dir()} if path.is_dir() else {}
    return next((found[name] for name in names if name in found), None)


def by_number(folder: Path, endings: Sequence[str]) -> dict[float, Path]:
    """Files by the number in their names: the one that differs from file to file."""
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in endings and not f.name.startswith("."))
    words = [re.findall(r"\d+\.\d+|\d+", file.stem) for file in files]
    width = min((len(row) for row in words), default=0)
    if not width:
        return {}
    column = max(range(width), key=lambda i: (len({row[i] for row in words}), i))
    return {float(row[column]): file for row, file in zip(words, files, strict=True)}
