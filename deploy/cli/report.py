"""What a run leaves for people: tables on the terminal, files in the output folder."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from prior_sg.deploy.evaluation.metrics import evaluate
from prior_sg.deploy.evaluation.object_metrics import NO_DETECTOR, OBJECT_SHARES, object_scores
from prior_sg.deploy.inspecting.replay import Log, message_differences, undisturbed
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.running.job import Result
from prior_sg.deploy.showing import formats
from prior_sg.deploy.showing.material import Material
from prior_sg.deploy.terminal import Table, Terminal
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.codec import decode
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.topics import SCENE
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.record import attachments

MAIN_METRICS = ("f1_s", "f1_g", "miou_s", "miou_g", "miou_s_penalised", "accuracy")


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
    outlines = GroundTruth.from_json(truth) if truth else None
    material = Material(scene, result.voxels, losses=losses, truth=outlines)
    files = {"scene.json": "json", "dsg.json": "dsg", "map.png": "png"}
    try:
        extras.require("dsg", "dsg.json")
    except extras.ExtraMissing as error:
        console.print(f"without dsg.json: {error}")
        del files["dsg.json"]
    for name, kind in files.items():
        formats.save(material, out / name, kind)
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
        if note := _note_on_names(set(scene.labels), {region["label"] for region in truth["regions"]}):
            console.print(note)
    if objects and result.counts.detectors - {NO_DETECTOR}:
        found = object_scores(scene.objects, objects, [item.name for item in result.prior.objects], result.voxels)
        shares = ", ".join(
            f"{key.removeprefix('objects_').replace('_', ' ')} {found[key]:.3f}" for key in OBJECT_SHARES
        )
        counts = f"{found['objects_found']:.0f} found, {found['objects_true']:.0f} true of the prior's and seen"
        console.print(f"objects against the ground truth: {counts}, {shares}")
        metrics |= found
    return {name: None if math.isnan(value) else value for name, value in metrics.items()}


def _note_on_names(of_task: set[str], of_truth: set[str]) -> str:
    """That scores of names say little, where the task names regions otherwise than the ground truth; else empty."""
    missing = of_truth - of_task
    if not missing:
        return ""
    if missing == of_truth:
        return "no region name of this task is in the ground truth: only f1_g and miou_g compare anything"
    return (
        f"this task has no {' and no '.join(sorted(missing))}, which the ground truth has, so names cannot match "
        "there: f1_g and miou_g compare shapes alone"
    )


def final_scene_difference(log: Log, path: Path) -> str:
    """How the scene at the end of a run differs from that of a store that read the same log without interruption; their
    revisions may, for a store that was started again asks for snapshots."""
    saved = attachments(path).get("scene.msgpack")
    if saved is None:
        return "the log holds no final scene (it was not written by `run` or `demo`)"
    recorded = decode(Scene, saved).unnumbered()
    with undisturbed(log) as store:
        again: Scene = store.answer(SCENE, SceneRequest(robot=recorded.robot)).unnumbered()
    if again == recorded:
        return ""
    return "final scene: " + "; ".join(message_differences(recorded, again) or ["bytes differ below the tolerance"])
