"""The scene as binary glTF 2.0, which Blender and every viewer of 3D models opens.

Layers are nodes to switch: map (coloured points), places (points), edges, trajectory (lines), regions (their hulls) and
objects (boxes); each region and object is a named node with its facts as `extras`. glTF has y up; the
topmost node turns our world, so that coordinates in the file stay the world's.
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.showing.colors import UNLABELLED, label_colors
from prior_sg.deploy.showing.export import DECIMALS
from prior_sg.deploy.showing.material import Material
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region

POINTS, LINES, LINE_LOOP, LINE_STRIP, TRIANGLES = 0, 1, 2, 3, 4
FLOAT, BYTE, INT = 5126, 5121, 5125
WORLD_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # a quarter turn about x
BOX = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
BOX_SIDES = np.array(((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)))
EDGE_COLOR, PATH_COLOR, OBJECT_COLOR = (70, 76, 84), (20, 20, 24), (176, 182, 190)


class Model:
    """A file in the making: arrays go into one buffer, nodes refer to them."""

    def __init__(self) -> None:
        root = {"name": "world", "rotation": WORLD_Z_UP, "children": []}
        self.told: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "prior-sg"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [root],
        }
        self._data = bytearray()
        self._materials: dict[tuple[int, ...], int] = {}

    def node(self, name: str, parent: int = 0, **facts: Any) -> int:
        """A node below another; its number."""
        number = self._append("nodes", {"name": name, **facts})
        self.told["nodes"][parent].setdefault("children", []).append(number)
        return number

    def mesh(
        self, mode: int, positions: np.ndarray, color: tuple[int, ...], *, colors: Any = None, indices: Any = None
    ) -> int:
        """A shape of one colour (0 to 255; a fourth is opacity), or of one per point; its number."""
        attributes = {"POSITION": self._array(positions.astype(np.float32), "VEC3", FLOAT, bounds=True)}
        if colors is not None:
            opaque = np.column_stack((colors, np.full(len(colors), 255))).astype(np.uint8)
            attributes["COLOR_0"] = self._array(opaque, "VEC4", BYTE, normalized=True)
        shape: dict[str, Any] = {"attributes": attributes, "mode": mode, "material": self._material(color)}
        if indices is not None:
            shape["indices"] = self._array(np.asarray(indices, np.uint32).ravel(), "SCALAR", INT)
        return self._append("meshes", {"primitives": [shape]})

    def save(self, path: Path) -> None:
        """Write header, JSON and buffer."""
        self.told["buffers"] = [{"byteLength": len(self._data)}]
        text = json_text(self.told, indent=None).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._data), b"BIN\0") + bytes(self._data)
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)

    def _array(
        self, values: np.ndarray, kind: str, component: int, *, bounds: bool = False, normalized: bool = False
    ) -> int:
        data = np.ascontiguousarray(values).tobytes()
        view = self._append("bufferViews", {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)})
        self._data += data + bytes(-len(data) % 4)
        told: dict[str, Any] = {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        if normalized:
            told["normalized"] = True
        if bounds:
            told |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self._append("accessors", told)

    def _material(self, color: tuple[int, ...]) -> int:
        if color not in self._materials:
            red, green, blue, *opacity = (round(part / 255, 4) for part in color)
            surface = {"baseColorFactor": [red, green, blue, *(opacity or [1.0])], "metallicFactor": 0.0}
            told: dict[str, Any] = {"pbrMetallicRoughness": surface, "doubleSided": True}
            if opacity:
                told["alphaMode"] = "BLEND"
            self._materials[color] = self._append("materials", told)
        return self._materials[color]

    def _append(self, kind: str, entry: dict[str, Any]) -> int:
        entries = self.told.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1


def write_gltf(material: Material, path: Path) -> None:
    """One .glb file with everything in it."""
    scene, model = material.scene, Model()
    colors = label_colors(scene)
    names = {region.id: region.label for region in scene.regions}
    if material.cloud is not None:
        shape = model.mesh(POINTS, material.cloud.points_world, (255, 255, 255), colors=material.cloud.colors)
        model.node("map", mesh=shape)
    if len(scene.place_ids):
        hues = np.array([colors.get(names.get(region, ""), UNLABELLED) for region in scene.place_regions.tolist()])
        model.node("places", mesh=model.mesh(POINTS, scene.positions_m, (255, 255, 255), colors=hues))
    if len(scene.edges):
        rows = np.searchsorted(scene.place_ids, scene.edges)
        ends_m = scene.positions_m[rows].reshape(-1, 3)  # without an index, which trimesh does not heed for lines
        model.node("edges", mesh=model.mesh(LINES, ends_m, EDGE_COLOR))
    if len(scene.trajectory) > 1:
        model.node("trajectory", mesh=model.mesh(LINE_STRIP, scene.trajectory, PATH_COLOR))
    floor_m = float(scene.positions_m[:, 2].min()) if len(scene.place_ids) else 0.0
    regions = model.node("regions")
    for region in scene.regions:
        _add_region(model, regions, region, colors.get(region.label, UNLABELLED), floor_m)
    objects = model.node("objects")
    for item in scene.objects:
        _add_object(model, objects, item)
    model.save(path)


def _add_region(model: Model, parent: int, region: Region, color: tuple[int, int, int], floor_m: float) -> None:
    """Its convex outline as a fan of triangles at the height of the lowest places."""
    facts: dict[str, Any] = {"extras": {"id": region.id, "label": region.label, "probability": region.probability}}
    if len(region.hull_m) > 2:
        corners = np.array([(x, y, floor_m) for x, y in region.hull_m], np.float32)
        fan = [(0, corner, corner + 1) for corner in range(1, len(corners) - 1)]
        facts["mesh"] = model.mesh(TRIANGLES, corners, (*color, 110), indices=fan)
    model.node(f"{region.label} {region.id}", parent, **facts)


def _add_object(model: Model, parent: int, item: SceneObject) -> None:
    """A box of its own size; boxes without extent stay nodes."""
    low_m, high_m = np.array(item.min_m), np.array(item.max_m)
    facts: dict[str, Any] = {"extras": {"id": item.id, "label": item.label, "probability": item.probability}}
    if (high_m > low_m).all():
        corners = BOX * (high_m - low_m) + (high_m + low_m) / 2
        sides = [(a, b, c, a, c, d) for a, b, c, d in BOX_SIDES.tolist()]
        facts["mesh"] = model.mesh(TRIANGLES, corners, (*OBJECT_COLOR, 140), indices=sides)
    else:
        facts["translation"] = np.round(item.position_m, DECIMALS).tolist()
    model.node(f"{item.label or 'object'} {item.id}", parent, **facts)
