"""The command that writes a scene graph in a format of the registry."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from prior_sg.deploy.cli.shared import Commands, add_bus, console, open_client
from prior_sg.deploy.errors import UserError

if TYPE_CHECKING:
    from prior_sg.deploy.showing.formats import Format
    from prior_sg.deploy.showing.material import Material


def add_commands(commands: Commands) -> None:
    """`export`."""
    from prior_sg.deploy.showing.formats import FORMATS

    export = commands.add(
        "export",
        cmd_export,
        "write a scene graph in another format, or as a page to look at",
        "prior-sg export out/demo --format html",
        needs="map",
    )
    export.epilog = "\n".join(
        [
            "formats:",
            *(f"  {one.name:<11} {one.file:<14} {one.summary}" for one in FORMATS.values()),
            "",
            str(export.epilog),
        ]
    )
    export.add_argument(
        "source",
        nargs="?",
        type=Path,
        help="a run's folder, scene.json, scene.sqlite, log.mcap or a file of Spark-DSG; default: the running system",
    )
    export.add_argument(
        "--format", default="", metavar="FORMAT", help="one of those below; default: what --out ends in, else json"
    )
    export.add_argument(
        "--out", type=Path, help="file (csv: folder) to write; default: the format's usual name, in the run's folder"
    )
    export.add_argument(
        "--crs", default="", help="reference system of the source's coordinates, such as EPSG:32632 (geojson names it)"
    )
    add_bus(export)


def cmd_export(arguments: argparse.Namespace) -> int:
    """Read the scene, choose format and file, write."""
    from prior_sg.deploy.showing import formats

    chosen = formats.named(arguments.format, arguments.out)
    out = arguments.out or _usual_place(arguments.source, chosen)
    if arguments.source is not None and out.resolve() == arguments.source.resolve():
        raise UserError(f"{out} is what is read; name another file with --out")
    with console.status(f"reading {arguments.source or arguments.connect}"):
        material = replace(_material(arguments, chosen), crs=arguments.crs)
    if material.log is not None and out.resolve() == material.log.resolve():
        raise UserError(f"{out} is what is read; name another file with --out")
    with console.status(f"writing {out}"):
        formats.save(material, out, chosen.name)
    console.print(f"{len(material.scene.place_ids)} places, {len(material.scene.regions)} regions: {out}")
    return 0


def _usual_place(source: Path | None, chosen: "Format") -> Path:
    """In a run's folder, beside a file, or here."""
    if source is None:
        return Path(chosen.file)
    return (source if source.is_dir() else source.parent) / chosen.file


def _material(arguments: argparse.Namespace, chosen: "Format") -> "Material":
    from prior_sg.deploy.showing.reading import read_material

    if arguments.source is None:
        return _live(arguments)
    return read_material(arguments.source, arguments.robot, moments_wanted=chosen.moments, cloud_wanted=chosen.cloud)


def _live(arguments: argparse.Namespace) -> "Material":
    """The scene of the running store, and the walls where the place graph answers."""
    from prior_sg.deploy.showing.material import Material
    from prior_sg.schemas.places import MapRequest
    from prior_sg.schemas.scene import SceneRequest
    from prior_sg.schemas.topics import SCENE, VOXEL_MAP
    from prior_sg.services.runtime.bus import BusError

    with open_client(arguments.connect) as client:
        scene, voxels = client.ask(SCENE, SceneRequest(robot=arguments.robot)), None
        if not len(scene.place_ids):
            raise UserError(f"the store holds no places of {arguments.robot}; name another with --robot")
        try:
            voxels = client.ask(VOXEL_MAP, MapRequest(robot=arguments.robot))
        except BusError as error:
            console.print(f"without the map of walls: {error}")
    return Material(scene, voxels)
