"""One self-contained page of a run: map, regions, objects, beliefs, the way there, scores and settings.

Nothing is fetched: style, script, pictures and data lie in the file, and its content policy forbids all else. Labels
and tasks come from models and users: data is JSON without a `<`, and the script makes text nodes of it.
"""

import base64
import hashlib
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.showing.colors import label_colors
from prior_sg.deploy.showing.formats.page.steps import steps_of
from prior_sg.deploy.showing.material import Material, Moment
from prior_sg.deploy.showing.top_view import FURNITURE_SHARE, WALL_SHARE, layers_of
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.members import headline
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.status import Loss
from prior_sg.services.losses import line as loss_line

MAX_BYTES = 8_000_000  # of the steps; more are thinned
MAX_PLACES = 20_000  # drawn; of more, an even part
MAX_CELLS, FINEST_M = 600_000, 0.025  # of the floor's grid
WALLS = "Walls are those of the end of the run, whatever moment is shown; stripes are predicted from the surroundings."
NO_WALLS = "Without a map of walls: the floor is what places cover; stripes are predicted from the surroundings."
FURNITURE_OPACITY = 0.35
MAX_SETTING = 120  # characters of one that are shown


def write_html(material: Material, path: Path) -> None:
    """The page as one file."""
    path.write_text(page(material), encoding="utf-8")


def page(material: Material) -> str:
    """The page as text."""
    parts = {name: (files(__package__) / f"page.{name}").read_text(encoding="utf-8") for name in ("html", "css", "js")}
    sources = {"script-src": parts["js"], "style-src": parts["css"]}
    allowed = "; ".join(f"{kind} '{_digest(text)}'" for kind, text in sources.items())
    scene = material.scene
    return Template(parts["html"]).substitute(
        policy=f"default-src 'none'; img-src data:; {allowed}",
        title=escape(f"{scene.task or 'scene'} – {scene.environment or scene.robot}"),
        style=parts["css"],
        script=parts["js"],
        data=_embedded(_data(material)),
    )


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _embedded(value: Any) -> str:
    """JSON that cannot end the element it stands in."""
    return json_text(value, indent=None).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _data(material: Material) -> dict[str, Any]:
    scene, moments = material.scene, material.moments or [Moment(0, material.scene)]
    if moments[-1].scene is not scene:
        moments = [*moments[:-1], Moment(moments[-1].revision, scene)]  # what a run kept has the last word
    steps, notes = _bounded_steps(moments)
    colors = [label_colors(moment.scene) for moment in moments]
    counts = f"{len(scene.regions)} regions, {len(scene.place_ids)} places, {len(scene.objects)} objects"
    return {
        "task": headline(scene.task, scene.merged_of, scene.plain),
        "about": " · ".join(text for text in (scene.environment, scene.robot, counts) if text),
        "colors": {label: list(color) for known in colors for label, color in known.items()},
        "grid": _grid(scene, material.voxels),
        "path": np.round(scene.trajectory[:, :2].astype(float), 2).tolist(),
        "steps": steps,
        "tables": _tables(material),
        "notes": [*notes, WALLS if material.voxels else NO_WALLS],
    }


def _bounded_steps(moments: Sequence[Moment]) -> tuple[list[dict[str, Any]], list[str]]:
    """Steps of at most MAX_BYTES, and what was left out for it: places above MAX_PLACES, then every other moment."""
    total, notes = len(moments[-1].scene.place_ids), list[str]()
    every = -(-total // MAX_PLACES)
    if every > 1:
        notes.append(f"Of {total} places one in {every} is drawn.")
    steps = list(steps_of(moments, max(1, every)))
    while len(json_text(steps, indent=None)) > MAX_BYTES and len(moments) > 1:
        moments = moments[-1::-2][::-1]
        steps = list(steps_of(moments, max(1, every)))
    return steps, notes


def _grid(scene: Scene, voxels: VoxelMap | None) -> dict[str, Any]:
    """Corner (metres), cell and size of the floor's grid; with walls known, pictures of free cells and of walls whose
    opacity is what counts, north up.
    """
    layers = layers_of(scene, voxels, False)
    cell_m = max(FINEST_M, layers.cell_m * (layers.free.size / MAX_CELLS) ** 0.5)
    width, height = (max(1, round(count * layers.cell_m / cell_m)) for count in layers.free.shape)
    x_m, y_m = (layers.origin * layers.cell_m).tolist()
    told = {"x": x_m, "y": y_m, "cell": cell_m, "width": width, "height": height}
    if voxels is None:
        return told
    size = (width, height)
    walls, furniture = (_resized(layers.walls >= share, size) for share in (WALL_SHARE, FURNITURE_SHARE))
    solid = np.maximum(walls, FURNITURE_OPACITY * furniture)
    return told | {"free": _picture(_resized(layers.free, size)), "walls": _picture(solid)}


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Opacity (row, column) of a mask (i, j), north up; finer than the mask its outline is smooth and sharp."""
    rows = np.ascontiguousarray(mask.T[::-1], np.float32)
    if size[0] <= rows.shape[1]:
        return cv2.resize(rows, size, interpolation=cv2.INTER_AREA)
    finer = cv2.resize(rows, size, interpolation=cv2.INTER_CUBIC)
    blurred = cv2.GaussianBlur(finer, (0, 0), size[0] / rows.shape[1] / 2)
    return ((blurred - 0.5) * 5 + 0.5).clip(0, 1)


def _picture(opacity: np.ndarray) -> str:
    """A PNG file as an address; `opacity` (row, column) in [0, 1]."""
    alpha = np.round(255 * opacity).astype(np.uint8)
    encoded, data = cv2.imencode(".png", np.dstack((np.zeros((*alpha.shape, 3), np.uint8), alpha)))
    if not encoded:
        raise OSError("the map could not be encoded as PNG")
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()


def _tables(material: Material) -> list[tuple[str, list[tuple[str, str | None]]]]:
    """Title and rows of what can be unfolded; a row without a value is a heading."""
    scene = material.scene
    scores = [(name, "–" if v is None else f"{v:.4g}") for name, v in material.scores.items()]
    losses = [(loss_text, "") for loss_text in _losses(material)]
    settings: list[tuple[str, str | None]] = []
    for service, fields in material.settings.items():
        settings += [(service, None), *((name, str(value)[:MAX_SETTING]) for name, value in fields.items())]
    about = [("prior", scene.prior_digest), ("embedding space", scene.space)]
    about += [
        ("origin of the world, m", ", ".join(f"{axis:.3f}" for axis in scene.origin_m)),
        ("stamp, ns", str(scene.stamp_ns)),
    ]
    return [
        ("Scores against the ground truth", list(scores)),
        ("Printed markers", [(str(marker.key), _marker(marker)) for marker in scene.markers]),
        ("What could not be used", list(losses)),
        ("Settings", settings),
        ("About this scene", list(about)),
    ]


def _marker(marker: SceneMarker) -> str:
    where = ", ".join(f"{value:.2f}" for value in marker.position_m)
    return f"{where} m, from {marker.frames} keyframes{f', in doubt: {marker.doubt}' if marker.doubt else ''}"


def _losses(material: Material) -> list[str]:
    return [loss_line(msgspec.convert(loss, Loss)) for loss in material.losses or ()]
