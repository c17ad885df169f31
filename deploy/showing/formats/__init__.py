"""All formats a scene graph is written in: one line of the registry makes one, for the command line and Python."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from prior_sg.deploy.errors import UserError
from prior_sg.services.runtime import extras

if TYPE_CHECKING:
    from prior_sg.deploy.showing.material import Material

HERE = "prior_sg.deploy.showing"
MOMENTS = 60  # of a run, at most, in formats that tell how the scene came about
MOST_MOMENTS = 240  # where a timeline plays them


class ExportError(UserError):
    """The file cannot be written as asked; the message says what to do."""


@dataclass(frozen=True)
class Format:
    """One way to write a scene graph."""

    name: str
    file: str  # its usual name, whose ending is the format's
    writer: str  # module:function(material, path), loaded when used
    summary: str
    extra: str = ""  # that brings its packages
    moments: int = 0  # of a run that it tells, at most
    cloud: bool = False  # whether it shows coloured points

    @property
    def suffix(self) -> str:
        """Ending of its files; "" is a folder."""
        return Path(self.file).suffix

    @property
    def write(self) -> Callable[["Material", Path], None]:
        """The function that writes it."""
        module, _, function = self.writer.partition(":")
        found: Callable[[Material, Path], None] = getattr(importlib.import_module(f"{HERE}.{module}"), function)
        return found


_ALL = (
    Format("json", "scene.json", "formats.plain:write_json", "ours: everything in plain JSON"),
    Format("dsg", "dsg.json", "formats.plain:write_dsg", "Spark-DSG as JSON, for Hydra's tools", "dsg"),
    Format("dsg-binary", "dsg.sparkdsg", "formats.plain:write_dsg", "Spark-DSG, binary", "dsg"),
    Format("node-link", "graph.json", "formats.graphs:write_node_link", "networkx and D3: nodes, links", "graph"),
    Format("graphml", "scene.graphml", "formats.graphs:write_graphml", "Gephi, yEd, Cytoscape", "graph"),
    Format("gltf", "scene.glb", "formats.gltf:write_gltf", "Blender, any viewer of 3D models", cloud=True),
    Format("geojson", "scene.geojson", "formats.geojson:write_geojson", "QGIS and maps, with the world's offset"),
    Format("rrd", "scene.rrd", "formats.recording:write_rrd", "Rerun, with a timeline", "rerun", MOMENTS, cloud=True),
    Format(
        "foxglove",
        "foxglove.mcap",
        "formats.foxglove:write_foxglove",
        "Foxglove: images, map and figures over time, and a layout",
        "foxglove",
        MOST_MOMENTS,
        cloud=True,
    ),
    Format("csv", "tables", "formats.tables:write_csv", "spreadsheets: a folder of tables"),
    Format("html", "scene.html", "formats.page:write_html", "one page to look at and to pass on", moments=MOMENTS),
    Format("text", "scene.txt", "formats.plain:write_text", "language models: in few words, the most useful first"),
    Format("png", "map.png", "formats.plain:write_png", "pictures: the map, and places in 3D in NAME-3d.png", "map"),
)
FORMATS = {entry.name: entry for entry in _ALL}


def named(name: str, path: Path | None) -> Format:
    """The format of a name, else of a file's ending, else ours. Raises ExportError when nothing fits."""
    if name:
        if name not in FORMATS:
            raise ExportError(f"there is no format {name!r}; known: {', '.join(FORMATS)}")
        return FORMATS[name]
    if path is None:
        return FORMATS["json"]
    found = next((one for one in _ALL if one.suffix and one.suffix == path.suffix), None)
    if found is None:
        endings = ", ".join(dict.fromkeys(one.suffix for one in _ALL if one.suffix))
        raise ExportError(f"{path} names no format; end it in one of {endings}, or name one of {', '.join(FORMATS)}")
    return found


def save(material: "Material", path: Path, name: str = "") -> None:
    """Write a scene; the format follows from the path's ending unless named. Raises ExportError or ExtraMissing."""
    chosen = named(name, path)
    if path.suffix != chosen.suffix:
        wanted = f"a file ending in {chosen.suffix}" if chosen.suffix else "a folder, without an ending"
        raise ExportError(f"{chosen.name} is written to {wanted}; got {path}")
    extras.require(chosen.extra, f"format {chosen.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        chosen.write(material, path)
    except OSError as error:
        raise ExportError(
            f"cannot write {path} ({error.strerror or error}); choose another place with --out"
        ) from error
