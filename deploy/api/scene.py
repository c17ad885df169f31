"""A scene graph as Python programs want it: columns of arrays, plain objects, graphs and tables."""

import importlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prior_sg.deploy.api.asking import Asking
from prior_sg.deploy.api.errors import NotInSceneError, PackageMissingError, SaveError
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.settings import DEFAULT_ROBOT
from prior_sg.schemas.answers import Answer, Difference
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.queries import Question, checked
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene as SceneMessage

Floats = NDArray[np.float32]
Ids = NDArray[np.int64]
Flags = NDArray[np.bool_]
Texts = NDArray[np.str_]
SINGULAR = {
    "ids": "id",
    "positions_m": "position_m",
    "radii_m": "radius_m",
    "region_ids": "region_id",
    "labels": "label",
    "place_counts": "place_count",
    "probabilities": "probability",
    "areas_m2": "area_m2",
}


@dataclass(frozen=True, eq=False)
class Places:
    """One row per place, sorted by id; positions in the world, metres, z up."""

    ids: Ids  # (place,)
    positions_m: Floats  # (place, 3)
    radii_m: Floats  # (place,) distance to the nearest obstacle
    region_ids: Ids  # (place,) -1 = not labelled yet
    labels: Texts  # (place,) label of the region; "" = not labelled yet
    posteriors: NDArray[np.float16]  # (place, label) columns as in Scene.labels
    unknown: NDArray[np.float16]  # (place,) mass outside the prior's regions
    predicted: Flags  # (place,) whether the label is a prediction from the surroundings

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class Regions:
    """One row per region, sorted by id."""

    ids: Ids  # (region,)
    labels: Texts  # (region,)
    place_counts: Ids  # (region,)
    probabilities: Floats  # (region,) mean posterior of the label over its places
    unknown: Floats  # (region,)
    predicted: Flags  # (region,)
    positions_m: Floats  # (region, 3) mean of its places
    areas_m2: Floats  # (region,) footprint

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class Objects:
    """One row per object, sorted by id."""

    ids: Ids  # (object,)
    labels: Texts  # (object,) "" = none of the prior's objects, or not told yet
    probabilities: Floats  # (object,)
    known: Floats  # (object,) probability that it is any of the prior's objects
    positions_m: Floats  # (object, 3) middle of its box
    min_m: Floats  # (object, 3) axis-aligned box
    max_m: Floats  # (object, 3)
    frames: Ids  # (object,) keyframes in which it was detected

    def __len__(self) -> int:
        return len(self.ids)


class Scene(Asking):
    """One robot's scene graph at one moment. `message` is what the store sent; everything else follows from it, and
    from `prior`, the one its regions follow, where it is at hand: `find` knows by it what labels mean.
    """

    def __init__(self, message: SceneMessage, prior: Prior | None = None) -> None:
        self.message, self.prior = message, prior

    def __repr__(self) -> str:
        counts = Counter(region.label for region in self.message.regions)
        regions = ", ".join(f"{count} × {label}" if count > 1 else label for label, count in sorted(counts.items()))
        task = f"{self.task!r} in {self.environment!r}" if self.task else "no task"
        return (
            f"<Scene of {self.robot}, {task}: {len(self.places)} places, {len(self.edges)} edges, "
            f"{len(self.regions)} regions ({regions or 'none'}), {len(self.objects)} objects>"
        )

    @classmethod
    def read(cls, path: str | Path, robot: str = DEFAULT_ROBOT) -> "Scene":
        """The scene in a run's folder, scene.json, scene.sqlite, log.mcap or a file of Spark-DSG. Raises Error."""
        from prior_sg.deploy.showing.reading import read_material

        found = read_material(path, robot)
        return cls(found.scene, found.prior)

    def save(self, path: str | Path, format: str = "") -> None:
        """Write it in a format of docs/exports.md, which the path's ending names unless `format` does. Raises Error."""
        from prior_sg.deploy.showing import formats
        from prior_sg.deploy.showing.material import Material

        formats.save(Material(self.message), Path(path), format)

    @property
    def robot(self) -> str:
        """Whose scene it is."""
        return self.message.robot

    @property
    def task(self) -> str:
        """The task that the regions follow; empty before the first."""
        return self.message.task

    @property
    def environment(self) -> str:
        """What kind of place it is, in the words of whoever gave the task."""
        return self.message.environment

    @property
    def stamp_ns(self) -> int:
        """Time of the newest frame it rests on."""
        return self.message.stamp_ns

    @property
    def revision(self) -> int:
        """Which one of the store it is; -1 where nothing is stored."""
        return self.message.revision

    @property
    def labels(self) -> tuple[str, ...]:
        """The regions that the prior knows: the columns of all posteriors."""
        return tuple(self.message.labels)

    @property
    def edges(self) -> Ids:
        """Pairs of place ids (edge, 2) between which the robot can move."""
        return self.message.edges

    @property
    def clearances_m(self) -> Floats:
        """Smallest distance to an obstacle along each edge (edge,)."""
        return self.message.clearances_m

    @property
    def trajectory_m(self) -> Floats:
        """Camera centres of the keyframes (frame, 3), in order of time."""
        return self.message.trajectory

    @cached_property
    def places(self) -> Places:
        """All places as columns."""
        found, names = self.message, {region.id: region.label for region in self.message.regions}
        return Places(
            ids=found.place_ids,
            positions_m=found.positions_m,
            radii_m=found.radii_m,
            region_ids=found.place_regions,
            labels=np.array([names.get(number, "") for number in found.place_regions.tolist()], np.str_),
            posteriors=found.posteriors,
            unknown=found.unknown,
            predicted=np.isin(found.place_ids, found.predicted_ids),
        )

    @cached_property
    def regions(self) -> Regions:
        """All regions as columns; `region` gives one with its outline, ways out and objects."""
        found = self.message.regions
        return Regions(
            ids=np.array([region.id for region in found], np.int64),
            labels=np.array([region.label for region in found], np.str_),
            place_counts=np.array([region.place_count for region in found], np.int64),
            probabilities=np.array([region.probability for region in found], np.float32),
            unknown=np.array([region.unknown for region in found], np.float32),
            predicted=np.array([region.predicted for region in found], np.bool_),
            positions_m=_points([region.position_m for region in found]),
            areas_m2=np.array([region.area_m2 for region in found], np.float32),
        )

    @cached_property
    def objects(self) -> Objects:
        """All objects as columns."""
        found = self.message.objects
        return Objects(
            ids=np.array([item.id for item in found], np.int64),
            labels=np.array([item.label for item in found], np.str_),
            probabilities=np.array([item.probability for item in found], np.float32),
            known=np.array([item.known for item in found], np.float32),
            positions_m=_points([item.position_m for item in found]),
            min_m=_points([item.min_m for item in found]),
            max_m=_points([item.max_m for item in found]),
            frames=np.array([item.frames for item in found], np.int64),
        )

    def region(self, label_or_id: str | int) -> Region:
        """The region of an id, or the largest of a label by its footprint. Raises NotInSceneError."""
        found = [region for region in self.message.regions if label_or_id in (region.id, region.label)]
        if not found:
            there = ", ".join(f"{region.id} {region.label}" for region in self.message.regions) or "no regions yet"
            raise NotInSceneError(f"the scene has no region {label_or_id!r}; it has: {there}")
        return max(found, key=lambda region: region.area_m2)

    def ask(self, *questions: Question) -> list[Answer]:
        """Answers to questions of `prior_sg.schemas.queries`, in their order."""
        from prior_sg.services.scene_store.core.queries.answering import answer

        return [answer(self._index, checked(question)) for question in questions]

    def difference(self, older: "Scene") -> Difference:
        """What is new, gone and renamed since another scene of the same robot."""
        from prior_sg.services.scene_store.core.queries.changes import difference

        return difference(older._index, self._index)

    def prior_of(self, digest: str) -> Prior | None:
        """The prior of a digest, where it is at hand."""
        return self.prior if self.prior is not None and self.prior.digest() == digest else None

    def embed(self, space: str, phrases: Sequence[str]) -> np.ndarray[Any, Any]:
        """Unit vectors (phrase, dim) by the text side of the space, which is loaded here. Raises PriorSgError."""
        from prior_sg.deploy.api.embedding import embed_here

        return embed_here(space, phrases)

    @cached_property
    def _index(self) -> Any:
        from prior_sg.services.scene_store.core.queries.index import Index

        return Index(self.message)

    def to_dict(self) -> dict[str, Any]:
        """Everything as dictionaries, lists, numbers and text, in the layout of scene.json."""
        from prior_sg.deploy.showing.export import scene_json

        return scene_json(self.message)

    def to_json(self, path: str | Path | None = None) -> str:
        """The same as JSON, also written to a file when one is named. Raises SaveError."""
        text = json_text(self.to_dict())
        if path is not None:
            try:
                Path(path).write_text(text)
            except OSError as error:
                raise SaveError(f"cannot write {path} ({error.strerror}); choose another file") from error
        return text

    def to_text(self, budget_tokens: int = 2000) -> str:
        """In few words, for language models: the most useful first, what is left out said, and never more than so many
        tokens, counted cautiously without a tokenizer. Raises ValueError below 200 and above 100 000.
        """
        from prior_sg.deploy.showing.text import scene_text

        return scene_text(self.message, budget_tokens)

    def to_networkx(self) -> Any:
        """An undirected networkx.Graph. Nodes are ("place", id), ("region", id) and ("object", id), their columns are
        attributes; edges have `kind`: "way" between places and between adjacent regions, "in" from a place or an object
        to its region. Raises PackageMissingError.
        """
        graph = _package("networkx", "Scene.to_networkx").Graph(robot=self.robot, task=self.task)
        for kind, table in (("place", self.places), ("region", self.regions), ("object", self.objects)):
            for row in _rows(table):
                graph.add_node((kind, row.pop("id")), **row)
        for (a, b), clearance_m in zip(self.edges.tolist(), self.clearances_m.tolist(), strict=True):
            graph.add_edge(("place", a), ("place", b), kind="way", clearance_m=clearance_m)
        for place, region in zip(self.places.ids.tolist(), self.places.region_ids.tolist(), strict=True):
            if region != NO_REGION:
                graph.add_edge(("place", place), ("region", region), kind="in")
        for region in self.message.regions:
            ways = [(("region", other), "way") for other in region.neighbour_ids]
            for other, kind in [*ways, *((("object", item), "in") for item in region.object_ids)]:
                if other in graph:
                    graph.add_edge(("region", region.id), other, kind=kind)
        return graph

    def to_pandas(self) -> dict[str, Any]:
        """DataFrames `places`, `regions`, `objects` (one row each, indexed by id) and `edges`. Points become columns
        x_m, y_m, z_m; of posteriors there is the label's probability. Raises PackageMissingError.
        """
        frame = _package("pandas", "Scene.to_pandas").DataFrame
        tables = {
            name: frame.from_records([flat_row(row) for row in _rows(table)], columns=list(_columns(table))).set_index(
                "id"
            )
            for name, table in (("places", self.places), ("regions", self.regions), ("objects", self.objects))
        }
        tables["places"]["probability"] = self._label_probabilities()
        a, b = self.edges.T
        return tables | {"edges": frame({"a": a, "b": b, "clearance_m": self.clearances_m})}

    def _label_probabilities(self) -> Floats:
        """Of each place, the posterior of its region's label; not a number where it has none (place,)."""
        found = np.full(len(self.places), np.nan, np.float32)
        for column, label in enumerate(self.labels):
            rows = self.places.labels == label
            found[rows] = self.places.posteriors[rows, column]
        return found


def _points(points: list[tuple[float, float, float]]) -> Floats:
    return np.array(points, np.float32).reshape(-1, 3)


def _rows(table: Places | Regions | Objects) -> Iterator[dict[str, Any]]:
    """Each row as plain Python, without posteriors, which are as many as labels."""
    names = [field.name for field in fields(table) if field.name != "posteriors"]
    for values in zip(*(getattr(table, name).tolist() for name in names), strict=True):
        yield dict(zip((SINGULAR.get(name, name) for name in names), values, strict=True))


def _columns(table: Places | Regions | Objects) -> Iterator[str]:
    """Names of the columns of a flat row."""
    for field in fields(table):
        if field.name != "posteriors":
            yield from _flat_names(SINGULAR.get(field.name, field.name), getattr(table, field.name).ndim == 2)


def flat_rows(table: Places | Regions | Objects) -> tuple[list[str], Iterator[list[Any]]]:
    """Names of a table's columns and its rows, points as three columns each; without posteriors."""
    return list(_columns(table)), (list(flat_row(row).values()) for row in _rows(table))


def flat_row(row: dict[str, Any]) -> dict[str, Any]:
    """Points as three numbers."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        point = isinstance(value, list)
        flat |= dict(zip(_flat_names(name, point), value if point else [value], strict=True))
    return flat


def _flat_names(name: str, point: bool) -> list[str]:
    """position_m becomes x_m, y_m, z_m; min_m becomes min_x_m and so on."""
    prefix = "" if name == "position_m" else name.removesuffix("m")
    return [f"{prefix}{axis}_m" for axis in "xyz"] if point else [name]


def _package(name: str, user: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise PackageMissingError(f"{user} needs {name}: run `pip install {name}`") from error
