"""Priors as JSON that people read and write; matrices by name, probabilities as decimals."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.errors import UserError
from prior_sg.schemas.levels import Entry, LevelPrior, NamedLevel
from prior_sg.schemas.priors import Counts, ObjectPrior, Prior, Provenance, RegionPrior, Spread
from prior_sg.services.errors import reason_of

FORMAT = "prior-sg prior 1"
Rows = Mapping[str, Mapping[str, float]]


class PriorError(UserError):
    """What was asked of a prior cannot be done; the message says what to do instead."""


class LevelFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One level above the regions; `parents` by child, which is a region or an entry of the level below."""

    name: NamedLevel
    task: str = ""
    entries: list[Entry]
    parents: dict[str, dict[str, float]]
    adjacency: dict[str, dict[str, float]]


class PriorFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A prior as people read and write it; matrices by name, probabilities as decimals."""

    format: str
    environment: str
    task: str
    vocabulary: list[str]
    regions: list[RegionPrior]
    objects: list[ObjectPrior]
    containment: dict[str, dict[str, float]]
    adjacency: dict[str, dict[str, float]]
    provenance: Provenance
    spread: dict[str, Any] | None = None
    tested: list[float] | None = None
    tested_looks: float | None = None
    levels: list[LevelFile] = []  # from below; files from before these were written have none


def write(prior: Prior, path: Path) -> None:
    """Write as JSON. Raises PriorError."""
    spread = None
    if prior.spread is not None:
        spread = {name: np.asarray(getattr(prior.spread, name)).tolist() for name in Spread.__struct_fields__}
    file = PriorFile(
        format=FORMAT,
        environment=prior.environment,
        task=prior.task,
        vocabulary=prior.vocabulary,
        regions=prior.regions,
        objects=prior.objects,
        containment=containment(prior),
        adjacency=adjacency(prior),
        provenance=prior.provenance,
        spread=spread,
        tested=None if prior.tested is None else prior.tested.regions.tolist(),
        tested_looks=None if prior.tested is None else prior.tested.looks,
        levels=_level_files(prior),
    )
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(file), indent=1) + b"\n")
    except OSError as error:
        raise PriorError(f"cannot write {path} ({error.strerror}); choose another file with --out") from error


def read(path: Path) -> Prior:
    """Read JSON, with every check that a model's answer meets. Raises PriorError."""
    try:
        file = msgspec.json.decode(path.read_bytes(), type=PriorFile)
        if file.format != FORMAT:
            raise ValueError(f"its format is {file.format!r}, not {FORMAT!r}")
        regions = [region.name for region in file.regions]
        spread = None
        if file.spread is not None:
            spread = Spread(**{name: np.array(values, np.float32) for name, values in file.spread.items()})
        return Prior(
            environment=file.environment,
            task=file.task,
            vocabulary=file.vocabulary,
            regions=file.regions,
            objects=file.objects,
            containment=_matrix(file.containment, regions, [item.name for item in file.objects]),
            adjacency=_matrix(file.adjacency, regions, regions),
            provenance=file.provenance,
            spread=spread,
            tested=None
            if file.tested is None
            else Counts(regions=np.array(file.tested, np.float32), looks=file.tested_looks),
            levels=_levels(file.levels, regions),
        )
    except (OSError, msgspec.MsgspecError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise PriorError(f"{path} is no usable prior: {reason_of(error)}") from error


def existence(prior: Prior) -> Rows:
    """P(r) by region."""
    return {region.name: {"share": region.existence} for region in prior.regions}


def containment(prior: Prior) -> dict[str, dict[str, float]]:
    """P(o | r) by region, then object."""
    return _rows(_regions(prior), [item.name for item in prior.objects], prior.containment)


def adjacency(prior: Prior) -> dict[str, dict[str, float]]:
    """P(ri - rj) by region, then region."""
    return _rows(_regions(prior), _regions(prior), prior.adjacency)


def _rows(names: list[str], columns: list[str], matrix: np.ndarray) -> dict[str, dict[str, float]]:
    """By name; decimals as short as they can be and still give the same 32-bit number."""
    return {
        name: {column: float(str(value)) for column, value in zip(columns, row, strict=True)}
        for name, row in zip(names, matrix.astype(np.float32), strict=True)
    }


def _level_files(prior: Prior) -> list[LevelFile]:
    files, children = [], _regions(prior)
    for level in prior.levels:
        parents = _rows(children, level.names, level.parents)
        touching = _rows(level.names, level.names, level.adjacency)
        files.append(
            LevelFile(name=level.name, task=level.task, entries=level.entries, parents=parents, adjacency=touching)
        )
        children = level.names
    return files


def _levels(files: list[LevelFile], children: list[str]) -> list[LevelPrior]:
    """Of files from below, the first above these regions."""
    levels = []
    for file in files:
        names = [entry.name for entry in file.entries]
        levels.append(
            LevelPrior(
                name=file.name,
                task=file.task,
                entries=file.entries,
                parents=_matrix(file.parents, children, names),
                adjacency=_matrix(file.adjacency, names, names),
            )
        )
        children = names
    return levels


def _regions(prior: Prior) -> list[str]:
    return [region.name for region in prior.regions]


def _matrix(rows: Rows, names: list[str], columns: list[str]) -> np.ndarray:
    if missing := [f"{row}, {column}" for row in names for column in columns if column not in rows.get(row, {})]:
        raise ValueError(f"a matrix lacks {missing[0]}")
    unknown = [row for row in rows if row not in names] + [c for row in names for c in rows[row] if c not in columns]
    if unknown:
        raise ValueError(f"a matrix has {unknown[0]!r}, which the prior does not name")
    return np.array([[rows[row][column] for column in columns] for row in names], np.float32).reshape(
        len(names), len(columns)
    )
