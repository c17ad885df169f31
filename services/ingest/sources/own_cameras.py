"""The camera of a folder of one's own, as people and tools write it: a matrix, JSON, YAML, a message of ROS."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.errors import reason_of
from prior_sg.services.ingest.core.pixels import stored
from prior_sg.services.ingest.sources.pose_lists import PoseList
from prior_sg.services.ingest.sources.tables import SourceError, read_json, text_of

CAMERAS = (
    "intrinsics",
    "intrinsic",
    "camera_intrinsics",
    "camera_intrinsic",
    "camera-intrinsics",
    "camera",
    "camera_info",
)
PATTERNS = (*(f"{name}.*" for name in CAMERAS), "K.txt")
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def described(path: Path, listed: PoseList | None) -> tuple[Path | None, dict[str, Any]]:
    """The file that holds the camera, and what it says; a file of its own goes before that of the poses."""
    files = [file for pattern in PATTERNS for file in sorted(path.glob(pattern)) if file.is_file()]
    if files:
        try:
            return files[0], fields_of(files[0])
        except (OSError, TypeError, ValueError, AttributeError) as error:
            raise SourceError(f"{files[0]} is not a camera: {reason_of(error)}") from error
    if listed is not None and listed.camera:
        fields = _flat({name.lower(): value for name, value in listed.camera.items() if name != "scale"})
        return listed.path, fields
    return None, {}


def unit_of(fields: dict[str, Any]) -> float | None:
    """Metres per depth unit of a camera's file; names other than ours may mean units per metre."""
    if "depth_scale_m" in fields:
        return float(fields["depth_scale_m"])
    if "depth_unit_scale_factor" in fields:
        return float(fields["depth_unit_scale_factor"])
    names = ("depth_scale", "depth_factor", "depthscale", "depthmapfactor", "scale")
    value = next((float(fields[name]) for name in names if name in fields), None)
    if value is None or not value > 0:
        return None
    return 1 / value if value >= 1 else value


def fields_of(path: Path) -> dict[str, Any]:
    """Named numbers of a camera's file. Raises SourceError."""
    if path.suffix.lower() == ".npy":
        return _of_matrix(np.ravel(stored(path.read_bytes())).tolist(), path)
    if path.suffix.lower() == ".json":
        content = read_json(path)
        content = content.get("camera", content) if isinstance(content, dict) else {"k": content}
        fields = _flat({str(key).lower(): value for key, value in content.items()})
    else:
        fields = _of_text(text_of(path), path)
    matrix = next((fields[k] for k in ("k", "camera_matrix", "intrinsic_matrix", "intrinsics") if k in fields), None)
    if "fx" not in fields and matrix is not None:
        matrix = matrix.get("data", matrix) if isinstance(matrix, dict) else matrix
        fields |= _of_matrix(np.ravel(np.array(matrix, float)).tolist(), path)
    return fields


def _of_text(text: str, path: Path) -> dict[str, Any]:
    """Named numbers of a YAML file, of OpenCV's or a ROS message's too, or of a bare matrix. Raises SourceError."""
    text = re.split(r"^\s*roi\s*:", text, maxsplit=1, flags=re.MULTILINE)[0]  # sizes of a part of the image
    text = re.sub(rf":[ \t]*\n((?:\s*-[ \t]+{NUMBER}[ \t]*(?:\n|$))+)", _in_brackets, text)
    named = re.findall(rf"^[\s\-]*([A-Za-z_][\w.]*)\s*[:=]\s*({NUMBER}|[A-Za-z_]\w*)\s*,?\s*$", text, re.MULTILINE)
    fields = _flat({name.lower().rpartition(".")[2]: value for name, value in named})
    if "fx" not in fields:
        numbers = in_brackets(text, r"(?:camera_matrix|\b[Kk]\b)[^\[]*")
        if not numbers:
            bare = re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE)
            numbers = [float(n) for n in re.findall(NUMBER, bare)]
        fields |= _of_matrix(numbers, path)
    bent = in_brackets(text, r"(?:distortion_coefficients|^\s*[Dd]\b)[^\[]*")
    if bent is None:
        raise SourceError(f"{path} is not a camera: its distortion is no list of numbers")
    return fields | ({"distortion": bent} if bent else {})


def in_brackets(text: str, before: str) -> list[float] | None:
    """The numbers in the first brackets behind a pattern; empty where there are none, None where they hold anything
    else or are never closed."""
    found = re.search(rf"{before}\[([^\[\]]*)(\]?)", text, re.MULTILINE | re.DOTALL)
    words = found[1].replace(",", " ").split() if found else []
    if found and not (found[2] and all(re.fullmatch(NUMBER, word) for word in words)):
        return None
    return [float(word) for word in words]


def _in_brackets(found: re.Match[str]) -> str:
    """A YAML list with a line for each number as one in brackets."""
    numbers = re.findall(NUMBER, re.sub(r"^[ \t]*-", "", found[1], flags=re.MULTILINE))
    return f": [{', '.join(numbers)}]\n"


ALIASES = {"w": "width", "h": "height", "image_width": "width", "image_height": "height", "fl_x": "fx", "fl_y": "fy",
           "fx_px": "fx", "fy_px": "fy", "cx_px": "cx", "cy_px": "cy", "ppx": "cx", "ppy": "cy",
           "width_px": "width", "height_px": "height"}  # fmt: skip


def _flat(fields: dict[str, Any]) -> dict[str, Any]:
    return {ALIASES.get(name, name): value for name, value in fields.items()}


def _of_matrix(numbers: Sequence[float], path: Path) -> dict[str, Any]:
    """fx fy cx cy of a matrix in a row, by rows or by columns, or of the four (or six, with the size) themselves."""
    if len(numbers) in (4, 6):
        names = ("fx", "fy", "cx", "cy", "width", "height")
        return dict(zip(names, numbers, strict=False))
    side = {9: 3, 12: 4, 16: 4}.get(len(numbers))
    if side is None:
        raise SourceError(f"{path} is not a camera: it has {len(numbers)} numbers instead of a matrix of 3 x 3")
    matrix = np.array(numbers, float).reshape(-1, side)[:3, :3]
    if matrix[2, 0] and not matrix[0, 2]:  # written by columns
        matrix = matrix.T
    return {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
