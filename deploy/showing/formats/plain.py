"""Formats whose content other modules make: scene.json, Spark-DSG, pictures."""

from pathlib import Path

from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.showing.export import map_png, places_png, scene_json
from prior_sg.deploy.showing.material import Material
from prior_sg.deploy.showing.text import scene_text


def write_json(material: Material, path: Path) -> None:
    """The scene as in scene.json; with `losses` where a run knows them, which the store does not keep."""
    told = {} if material.losses is None else {"losses": material.losses}
    path.write_text(json_text(scene_json(material.scene) | told))


def write_text(material: Material, path: Path) -> None:
    """The scene in few words."""
    path.write_text(scene_text(material.scene))


def write_dsg(material: Material, path: Path) -> None:
    """The scene in Spark-DSG's layers; the ending chooses between JSON and binary."""
    from prior_sg.deploy.showing.dsg import save_spark_dsg

    save_spark_dsg(material.scene, path)


def write_png(material: Material, path: Path) -> None:
    """The map from above, and a picture of places in three dimensions beside it."""
    map_png(material.scene, material.voxels, path, material.truth)
    places_png(material.scene, material.voxels, picture_of_places(path))


def picture_of_places(path: Path) -> Path:
    """The file of the three-dimensional picture beside a map."""
    return path.with_stem(f"{path.stem}-3d")
