"""The report as one HTML page that needs nothing else: tables, pictures, plots."""

import base64
import math
from collections.abc import Callable, Sequence
from html import escape

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.evaluation.kinds import SWEEPS
from prior_sg.deploy.evaluation.methods import Method
from prior_sg.deploy.evaluation.metrics import Reliability
from prior_sg.deploy.evaluation.object_metrics import OBJECT_COUNTS, OBJECT_SCORES, TOLERANCE_M
from prior_sg.deploy.evaluation.plots import Point, line_plot
from prior_sg.deploy.evaluation.runner import KEYS, NO_LABEL, Dataset, Picture, Results
from prior_sg.deploy.showing.map import draw_map
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene
from prior_sg.services.segmenter.core.regions.components import footprint_m2

PICTURE_WIDTH_PX = 900
FOOTPRINT_CELL_M = 0.1
LESS_IS_BETTER = ("ece", "risk_half", "seconds")
PICTURED = ("method", "oracle")  # groups whose scenes are drawn and whose errors are listed
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2328; margin: 2rem auto; max-width: 1240px; padding: 0 1rem; }
h1 { font-size: 1.7rem; } h2 { margin-top: 2.6rem; border-bottom: 1px solid #d0d5db; } h3 { margin-bottom: .4rem; }
table { border-collapse: collapse; margin: .6rem 0 1.2rem; font-variant-numeric: tabular-nums; }
th, td { padding: .22rem .5rem; text-align: right; border-bottom: 1px solid #eef0f3; vertical-align: top; }
td:first-child { white-space: nowrap; } th { vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; } th { color: #4b525c; font-weight: 600; }
td.about { text-align: left; color: #6b7280; } small { color: #6b7280; font-weight: 400; white-space: nowrap; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(560px, 1fr)); gap: .8rem; }
.pictures img { width: 100%; border: 1px solid #d0d5db; } svg text { font: 12px system-ui, sans-serif; }
.plots { display: flex; flex-wrap: wrap; gap: 1rem; } details { margin: .3rem 0; } .matrix td { min-width: 3rem; }
"""


def page(results: Results, settings: dict[str, str]) -> str:
    """The whole page; `settings` are shown as they are."""
    groups = list(dict.fromkeys(method.group for method in results.methods))
    sections = [_scores(results, group) for group in groups if group not in SWEEPS]
    sections += [_sweep(results, group) for group in groups if group in SWEEPS]
    sections += [_objects(results), _pictures(results), _calibration(results), _confusions(results), _timing(results)]
    listed = "".join(
        f"<tr><td>{escape(key)}</td><td class=about>{escape(text)}</td></tr>" for key, text in settings.items()
    )
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><title>prior-sg evaluation</title>"
        f"<style>{STYLE}</style><body><h1>Evaluation</h1><table>{listed}</table>{''.join(sections)}</body></html>\n"
    )


def _scores(results: Results, group: str) -> str:
    """One table over all sequences, and one for each, of a group's methods; ours leads the derived groups."""
    methods = [m for m in results.methods if m.group == group]
    if group != "method":
        methods = [m for m in results.methods if m.group == "method"][:1] + methods
    title = {"method": "Methods", "ablation": "Ablations", "oracle": "Oracles"}[group]
    abouts = "".join(f"<tr><td>{escape(m.name)}</td><td class=about>{escape(m.about)}</td></tr>" for m in methods)
    tables = [f"<h3>all sequences, mean ± sd over sequences and priors</h3>{_table(results, methods, '')}"]
    tables += [f"<h3>{escape(s.name)}</h3>{_table(results, methods, s.name)}" for s in results.sequences]
    return f"<h2>{title}</h2><table>{abouts}</table>{''.join(tables)}"


def _table(results: Results, methods: Sequence[Method], sequence: str) -> str:
    head = "".join(f"<th>{key.replace('_', '_<wbr>')}</th>" for key in KEYS)
    best = {key: _best(key, [results.mean(m.name, key, sequence) for m in methods]) for key in KEYS}
    rows = []
    for method in methods:
        cells = []
        for key in KEYS:
            mean, sd = results.mean(method.name, key, sequence), results.sd(method.name, key, sequence)
            shown = "–" if math.isnan(mean) else f"{mean:.3f}" + (f"<br><small>±{sd:.3f}</small>" if sd else "")
            cells.append(f"<td>{f'<b>{shown}</b>' if mean == best[key] else shown}</td>")
        rows.append(f"<tr><td>{escape(method.name)}</td>{''.join(cells)}</tr>")
    return f"<table><tr><th>method</th>{head}</tr>{''.join(rows)}</table>"


def _objects(results: Results) -> str:
    """Objects against the ground truth's, where it names them."""
    judged = [(m, s) for m in results.methods for s in results.sequences if results.judges_objects(m.name, s.name)]
    if not judged:
        return ""
    rows = []
    for method, sequence in judged:
        values = {key: results.mean(method.name, key, sequence.name) for key in OBJECT_SCORES}
        shown = ["–" if math.isnan(v) else f"{v:.4g}" if k in OBJECT_COUNTS else f"{v:.3f}" for k, v in values.items()]
        cells = "".join(f"<td>{cell}</td>" for cell in shown)
        rows.append(f"<tr><td>{escape(sequence.name)}: {escape(method.name)}</td>{cells}</tr>")
    head = "".join(f"<th>{key.removeprefix('objects_').replace('_', ' ')}</th>" for key in OBJECT_SCORES)
    about = f"One-to-one, the middle of a found box at most {TOLERANCE_M} m from the true box; mean over priors."
    return f"<h2>Objects</h2><p>{about}</p><table><tr><th></th>{head}</tr>{''.join(rows)}</table>"


def _best(key: str, values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    pick: Callable[[list[float]], float] = min if key in LESS_IS_BETTER else max
    return pick(known) if known else float("nan")


def _sweep(results: Results, kind: str) -> str:
    """F1 and mIoU over the values of one setting, a line for each sequence and one for their mean."""
    methods = [m for m in results.methods if m.group == kind]
    names = [str(m.value).removeprefix("conse/").split("/", maxsplit=1)[0] for m in methods]
    plots = []
    for key in ("f1_s", "miou_s", "f1_g"):
        series: dict[str, list[Point]] = {}
        for sequence in ("", *(s.name for s in results.sequences)):
            series[sequence or "mean"] = [(i, results.mean(m.name, key, sequence)) for i, m in enumerate(methods)]
        plots.append(line_plot(series, kind, key, x_names=names))
    return f"<h2>Sweep of {escape(kind)}</h2>{_table(results, methods, '')}<div class=plots>{''.join(plots)}</div>"


def _pictures(results: Results) -> str:
    sections = []
    for sequence in results.sequences:
        shown = [p for p in results.pictures if p.sequence == sequence.name and p.method.group in PICTURED]
        if not shown:
            continue
        labels = sorted({r.label for r in sequence.truth.regions} | {r.label for p in shown for r in p.scene.regions})
        true = true_scene(shown[0].scene, sequence.truth)
        images = [_image("ground truth", true, shown[0].voxels, sequence, labels)]
        images += [_image(p.method.name, p.scene, p.voxels, sequence, labels) for p in shown]
        sections.append(f"<h3>{escape(sequence.name)}</h3><div class=pictures>{''.join(images)}</div>")
    return f"<h2>Seen from above</h2>{''.join(sections)}"


def _image(title: str, scene: Scene, voxels: VoxelMap, sequence: Dataset, labels: list[str]) -> str:
    """One picture, in colours that all pictures of the sequence share."""
    named = [region for region in scene.regions if region.label]
    kept = np.isin(scene.place_regions, [region.id for region in named])
    drawn = msgspec.structs.replace(
        scene,
        task=title,
        environment=sequence.name,
        labels=[label for label in labels if label],
        regions=named,
        place_regions=np.where(kept, scene.place_regions, NO_REGION),
    )
    image = cv2.imdecode(
        np.frombuffer(draw_map(drawn, voxels, [r.polygon_m for r in sequence.truth.regions]), np.uint8),
        cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION,
    )
    assert image is not None
    scale = PICTURE_WIDTH_PX / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    data = base64.b64encode(cv2.imencode(".png", small, (cv2.IMWRITE_PNG_COMPRESSION, 9))[1].tobytes()).decode()
    return f'<img alt="{escape(sequence.name)}: {escape(title)}" src="data:image/png;base64,{data}">'


def true_scene(scene: Scene, truth: GroundTruth) -> Scene:
    """The same places with the ground truth's regions, and without the objects that were found."""
    ids = truth.region_of(scene.positions_m)
    regions = []
    for region in truth.regions:
        rows = np.flatnonzero(ids == region.id)
        if len(rows):
            x, y, z = scene.positions_m[rows].mean(axis=0).tolist()
            area_m2 = footprint_m2(scene.positions_m[rows].astype(float), scene.radii_m[rows], FOOTPRINT_CELL_M)
            entry = Region(
                id=region.id,
                label=region.label,
                place_count=len(rows),
                probability=1.0,
                position_m=(x, y, z),
                area_m2=area_m2,
            )
            regions.append(entry)
    return msgspec.structs.replace(scene, regions=regions, place_regions=ids, objects=[])


def _calibration(results: Results) -> str:
    """Accuracy over confidence, all sequences together, for methods that hold beliefs."""
    believed, risky = {}, {}
    for method in results.methods:
        tables = [p.calibration for p in results.pictures if p.method.name == method.name]
        if method.group in PICTURED and sum(table.volumes.sum() for table in tables):
            believed[method.name], risky[method.name] = reliability_points(tables), risk_points(tables)
    return (
        "<h2>Calibration</h2><p>Share of the volume that is labelled right, over the posterior of its label; and the "
        "share that is labelled wrong when only what is believed most firmly is taken, over how much that is.</p>"
        f'<div class="plots">{line_plot(believed, "confidence", "accuracy", diagonal=True)}'
        f"{line_plot(risky, 'coverage', 'risk')}</div>"
    )


def reliability_points(tables: Sequence[Reliability]) -> list[Point]:
    """(confidence, accuracy) of each bin that holds anything, the tables together."""
    volumes = np.sum([table.volumes for table in tables], axis=0)
    confidence = np.sum([table.volumes * table.confidence for table in tables], axis=0)
    accuracy = np.sum([table.volumes * table.accuracy for table in tables], axis=0)
    filled = np.flatnonzero(volumes)
    return [(float(confidence[b] / volumes[b]), float(accuracy[b] / volumes[b])) for b in filled]


def risk_points(tables: Sequence[Reliability]) -> list[Point]:
    """(coverage, risk) when the bins of highest confidence are taken first, the tables together."""
    volumes = np.sum([table.volumes for table in tables], axis=0)[::-1]
    wrong = np.sum([table.volumes * (1 - table.accuracy) for table in tables], axis=0)[::-1]
    taken, missed = np.cumsum(volumes), np.cumsum(wrong)
    return [(float(taken[b] / taken[-1]), float(missed[b] / taken[b])) for b in np.flatnonzero(volumes)]


def _confusions(results: Results) -> str:
    shown = [p for p in results.pictures if p.method.group in PICTURED]
    tables = [
        f"<details{' open' if p.method is results.methods[0] else ''}><summary>{escape(p.sequence)}: "
        f"{escape(p.method.name)}</summary>{_confusion(p)}</details>"
        for p in shown
    ]
    return f"<h2>Confusions</h2><p>Share of each true label's volume, in percent.</p>{''.join(tables)}"


def _confusion(picture: Picture) -> str:
    truths = sorted({true for true, _ in picture.confusion})
    estimates = sorted({e for _, e in picture.confusion} | set(truths), key=lambda name: (name == NO_LABEL, name))
    rows = []
    for true in truths:
        volumes = [picture.confusion.get((true, estimate), 0) for estimate in estimates]
        cells = []
        for estimate, volume in zip(estimates, volumes, strict=True):
            share = volume / sum(volumes)
            hue = "89,161,79" if estimate == true else "225,87,89"
            cells.append(f'<td style="background:rgba({hue},{share:.2f})">{100 * share:.0f}</td>')
        rows.append(f"<tr><td>{escape(true)}</td>{''.join(cells)}</tr>")
    head = "".join(f"<th>{escape(name)}</th>" for name in estimates)
    return f"<table class=matrix><tr><th>true \\ estimated</th>{head}</tr>{''.join(rows)}</table>"


def _timing(results: Results) -> str:
    """Seconds of perceiving, then of each method."""
    sequences = [s.name for s in results.sequences]
    head = "".join(f"<th>{escape(name)}</th>" for name in sequences)
    rows = []
    for part in ("places", "features"):
        seconds = [results.perceiving_s.get(name, {}).get(part, 0.0) for name in sequences]
        cells = "".join(f"<td>{f'{s:.1f}' if s else 'on disk'}</td>" for s in seconds)
        rows.append(f"<tr><td>{part} (shared by all methods)</td>{cells}</tr>")
    for method in results.methods:
        cells = "".join(f"<td>{results.mean(method.name, 'seconds', name):.2f}</td>" for name in sequences)
        rows.append(f"<tr><td>{escape(method.name)}</td>{cells}</tr>")
    return f"<h2>Seconds</h2><table><tr><th></th>{head}</tr>{''.join(rows)}</table>"
