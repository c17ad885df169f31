"""What a run leaves for people: tables on the terminal, files in the output folder."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from rich.table import Table

from prior_sg.deploy.api.history import open_history
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.evaluation.metrics import evaluate
from prior_sg.deploy.evaluation.object_metrics import NO_DETECTOR, OBJECT_SHARES, object_scores
from prior_sg.deploy.inspecting.replay import Log, message_differences, undisturbed
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.running.job import Result
from prior_sg.deploy.showing.export import map_png, places_png, scene_json
from prior_sg.deploy.terminal import Terminal
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.topics import SCENE
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.record import attachments

SUFFIXES = {"json": (".json",), "spark-dsg": (".json", ".sparkdsg"), "png": (".png",)}
Told = list[dict[str, Any]] | None  # losses of a run; none where they are not known
MAIN_METRICS = ("f1_s", "f1_g", "miou_s", "miou_g", "miou_s_penalised", "accuracy")


class ExportError(UserError):
    """The file cannot be written as asked; the message says what to do."""


def region_table(scene: Scene) -> Table:
    """One row per region, largest first."""
    table = Table("id", "label", "places", "footprint m²", "probability", title=f"{scene.task} ({scene.environment})")
    for column in table.columns[2:]:
        column.justify = "right"
    for region in sorted(scene.regions, key=lambda region: -region.area_m2):
        table.add_row(
            str(region.id),
            region.label,
            str(region.place_count),
            f"{region.area_m2:.1f}",
            f"{region.probability:.2f}",
        )
    return table


def write(
    result: Result,
    out: Path,
    truth: dict[str, Any] | None,
    console: Terminal,
    objects: Sequence[TrueObject] = (),
) -> None:
    """Print the regions and the scores, and write scene.json, dsg.json, map.png, map-3d.png and metrics.json.

    scene.json and metrics.json also hold `losses`, which the store does not keep.
    `truth` and `objects` are the regions and objects of the ground truth, where there are any.
    """
    scene = result.scene
    console.print(region_table(scene))
    labelled = int((scene.place_regions >= 0).sum())
    named = sum(bool(item.label) for item in scene.objects)
    console.print(
        f"{len(scene.place_ids)} places ({labelled} labelled), {len(scene.edges)} edges, "
        f"{len(scene.regions)} regions, {len(scene.objects)} objects ({named} named); "
        f"{result.counts.encoded_summary()}; "
        f"{result.counts.crops} of {result.counts.crops_total} crops encoded"
    )
    for text in result.loss_lines:
        console.print(text)
    losses = msgspec.to_builtins(result.losses)
    if metrics := compare(result, truth, objects, console):
        (out / "metrics.json").write_text(json_text(metrics | {"losses": losses}))
    files = {"scene.json": "json", "dsg.json": "spark-dsg", "map.png": "png"}
    try:
        extras.require("dsg", "dsg.json")
    except extras.ExtraMissing as error:
        console.print(f"without dsg.json: {error}")
        del files["dsg.json"]
    for name, kind in files.items():
        export(scene, result.voxels, kind, out / name, truth, losses=losses)
    names = ", ".join((*files, "map-3d.png", result.log_path.name))
    console.print(f"written to {out}: {names} ({result.seconds:.0f} s)")
    console.print(f"look at it: prior-sg view {shlex.quote(str(out))}")


def compare(
    result: Result, truth: dict[str, Any] | None, objects: Sequence[TrueObject], console: Terminal
) -> dict[str, float | None]:
    """Scores of regions and objects, as far as there is a ground truth of them, also printed; None = no such score."""
    scene, metrics = result.scene, dict[str, float]()
    if truth is not None:
        metrics |= evaluate(scene, result.voxels, GroundTruth.from_json(truth))
        console.print("against the ground truth: " + ", ".join(f"{name} {metrics[name]:.3f}" for name in MAIN_METRICS))
        if not set(scene.labels) & {region["label"] for region in truth["regions"]}:
            console.print("no region name of this task is in the ground truth: only f1_g and miou_g compare anything")
    if objects and result.counts.detectors - {NO_DETECTOR}:
        found = object_scores(scene.objects, objects, [item.name for item in result.prior.objects], result.voxels)
        shares = ", ".join(
            f"{key.removeprefix('objects_').replace('_', ' ')} {found[key]:.3f}" for key in OBJECT_SHARES
        )
        counts = f"{found['objects_found']:.0f} found, {found['objects_true']:.0f} true of the prior's and seen"
        console.print(f"objects against the ground truth: {counts}, {shares}")
        metrics |= found
    return {name: None if math.isnan(value) else value for name, value in metrics.items()}


def export(
    scene: Scene,
    voxels: VoxelMap | None,
    kind: str,
    path: Path,
    truth: dict[str, Any] | None = None,
    *,
    losses: Told = None,
) -> None:
    """Write one file: `json`, `spark-dsg` or `png`; `losses`, where a run knows them, go into the first."""
    if path.suffix not in SUFFIXES[kind]:
        raise ExportError(f"{kind} is written to a file ending in {' or '.join(SUFFIXES[kind])}; got {path}")
    try:
        _write(scene, voxels, kind, path, truth, losses=losses)
    except OSError as error:
        raise ExportError(f"cannot write {path} ({error.strerror}); choose another file with --out") from error


def _write(
    scene: Scene,
    voxels: VoxelMap | None,
    kind: str,
    path: Path,
    truth: dict[str, Any] | None,
    *,
    losses: Told,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "json":
        told = {} if losses is None else {"losses": losses}
        path.write_text(json_text(scene_json(scene) | told))
    elif kind == "spark-dsg":
        from prior_sg.deploy.showing.dsg import spark_dsg_graph

        spark_dsg_graph(scene).save(str(path))
    else:
        map_png(scene, voxels, path, GroundTruth.from_json(truth) if truth else None)
        places_png(scene, voxels, picture_of_places(path))


def picture_of_places(path: Path) -> Path:
    """The file of the three-dimensional picture beside a map."""
    return path.with_stem(f"{path.stem}-3d")


def scene_in(database: Path, robot: str) -> Scene:
    """The scene of one robot in a database file of the store, which may be in use."""
    with open_history(database) as history:
        return history.scene(robot).message


def final_scene_difference(log: Log, path: Path) -> str:
    """How the scene at the end of a run differs from that of a store that read the same log without interruption."""
    saved = attachments(path).get("scene.msgpack")
    if saved is None:
        return "the log holds no final scene (it was not written by `run` or `demo`)"
    recorded = decode(Scene, saved)
    with undisturbed(log) as store:
        again: Scene = store.answer(SCENE, SceneRequest(robot=recorded.robot))
    again = msgspec.structs.replace(again, revision=recorded.revision)  # a store that was killed has read snapshots
    if encode(again) == encode(recorded):
        return ""
    return "final scene: " + "; ".join(message_differences(recorded, again) or ["bytes differ below the tolerance"])
