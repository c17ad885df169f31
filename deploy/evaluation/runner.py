"""Runs methods over sequences and priors, and sums up."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prior_sg.deploy.evaluation.datasets import SEQUENCE, Dataset
from prior_sg.deploy.evaluation.kinds import OURS
from prior_sg.deploy.evaluation.methods import Case, Method
from prior_sg.deploy.evaluation.metrics import SCORES, Reliability, assign, beliefs_of, evaluate, reliability
from prior_sg.deploy.evaluation.object_metrics import NO_DETECTOR, OBJECT_SCORES, object_scores
from prior_sg.deploy.evaluation.perception import Perception, Report
from prior_sg.deploy.evaluation.priors import variations
from prior_sg.schemas.features import TextEmbeddings
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.scene import Scene

KEYS = (*SCORES, "seconds")
NO_LABEL = "(none)"

PerceiveOf = Callable[[Dataset, Mapping[str, Any], tuple[str, ...]], Perception]  # the names a detector is to look for


@dataclass(frozen=True)
class Outcome:
    """One method on one sequence with one prior."""

    sequence: str
    method: Method
    prior: int  # 0 = the library's
    scores: dict[str, float]  # by KEYS, and by OBJECT_SCORES where objects are judged; NaN = no such score


@dataclass(frozen=True)
class Picture:
    """What a method made of a sequence with the library's prior."""

    sequence: str
    method: Method
    scene: Scene
    voxels: VoxelMap
    calibration: Reliability
    confusion: dict[tuple[str, str], int]  # voxels by (true label, estimated label)


@dataclass(frozen=True)
class Part:
    """What an evaluation found on one sequence."""

    outcomes: tuple[Outcome, ...]
    pictures: tuple[Picture, ...]
    perceiving_s: dict[str, float]  # by part; 0 = was on disk

    def portable(self) -> "Part":
        """The same for another process: its methods are names that cannot be run."""
        return Part(
            tuple(replace(one, method=replace(one.method, run=_elsewhere)) for one in self.outcomes),
            tuple(replace(one, method=replace(one.method, run=_elsewhere)) for one in self.pictures),
            self.perceiving_s,
        )


@dataclass(frozen=True)
class Results:
    """Everything an evaluation found."""

    sequences: tuple[Dataset, ...]
    methods: tuple[Method, ...]
    outcomes: tuple[Outcome, ...]
    pictures: tuple[Picture, ...]
    perceiving_s: dict[str, dict[str, float]]  # by sequence and part; 0 = was on disk

    def mean(self, method: str, key: str, sequence: str = "") -> float:
        """Over priors, and over sequences where none is named."""
        return _summary(self._values(method, key, sequence), np.mean)

    def sd(self, method: str, key: str, sequence: str = "") -> float:
        """Standard deviation over the same values, 0 for one."""
        return _summary(self._values(method, key, sequence), np.std)

    def kinds(self) -> tuple[str, ...]:
        """Kinds of datasets, in order; none where none is a world."""
        kinds = dict.fromkeys(one.kind for one in self.sequences)
        return tuple(kinds) if set(kinds) - {SEQUENCE} else ()

    def of_kind(self, method: str, key: str, kind: str = "") -> tuple[float, float]:
        """Mean over the datasets of a kind, or all, of their means over priors, and its standard error; NaN = no such
        score, or too few datasets for an error."""
        chosen = [one.name for one in self.sequences if kind in ("", one.kind)]
        means = np.array([value for name in chosen if not math.isnan(value := self.mean(method, key, name))])
        error = float(means.std(ddof=1)) / math.sqrt(len(means)) if len(means) > 1 else math.nan
        return _summary(means.tolist(), np.mean), error

    def table(self) -> dict[str, Any]:
        """`{"sequences": {NAME: {METHOD: {...}}}, "mean": {METHOD: {...}}, "sd": {METHOD: {...}}}`; None = no score.

        Rows have KEYS, and OBJECT_SCORES where objects were judged. With worlds there is also
        `{"kinds": {KIND: {METHOD: {KEY: [MEAN, STANDARD ERROR]}}}}`.
        """
        names = [method.name for method in self.methods]
        kinds = {kind: {m: self._errors(m, kind) for m in names} for kind in self.kinds()}
        return ({"kinds": kinds} if kinds else {}) | {
            "sequences": {s.name: {m: self._row(self.mean, m, s.name) for m in names} for s in self.sequences},
            "mean": {m: self._row(self.mean, m) for m in names},
            "sd": {m: self._row(self.sd, m) for m in names},
        }

    def _errors(self, method: str, kind: str) -> dict[str, list[float | None]]:
        found = {key: self.of_kind(method, key, kind) for key in KEYS}
        return {key: [None if math.isnan(value) else value for value in pair] for key, pair in found.items()}

    def _row(self, summary: Callable[..., float], method: str, sequence: str = "") -> dict[str, float | None]:
        keys = (*KEYS, *OBJECT_SCORES) if self.judges_objects(method, sequence) else KEYS
        values = {key: summary(method, key, sequence) for key in keys}
        return {key: None if math.isnan(value) else value for key, value in values.items()}

    def _values(self, method: str, key: str, sequence: str) -> list[float]:
        found = [o.scores.get(key, math.nan) for o in self._of(method, sequence)]
        return [value for value in found if not math.isnan(value)]

    def judges_objects(self, method: str, sequence: str = "") -> bool:
        """Whether any outcome of a method has scores of its objects."""
        return any(OBJECT_SCORES[0] in outcome.scores for outcome in self._of(method, sequence))

    def _of(self, method: str, sequence: str) -> list[Outcome]:
        return [o for o in self.outcomes if o.method.name == method and sequence in ("", o.sequence)]


def run(
    sequences: Sequence[Dataset],
    methods: Sequence[Method],
    perceive: PerceiveOf,
    report: Report,
    *,
    priors: int = 1,
    strength: float = 0.5,
) -> Results:
    """Every method on every sequence with every prior, each prior a variation of the library's."""
    parts = [run_one(one, methods, perceive, report, priors=priors, strength=strength) for one in sequences]
    return joined(sequences, methods, parts)


def run_one(
    sequence: Dataset,
    methods: Sequence[Method],
    perceive: PerceiveOf,
    report: Report,
    *,
    priors: int = 1,
    strength: float = 0.5,
) -> Part:
    """Every method on one sequence with every prior."""
    outcomes: list[Outcome] = []
    pictures: list[Picture] = []
    perceptions: dict[str, Perception] = {}
    named = tuple(item.name for item in sequence.prior.objects)
    for done, method in enumerate(methods):
        report(f"{sequence.name}: {method.name}", done, len(methods))
        key = repr(sorted(method.features.items()))
        if key not in perceptions:
            perceptions[key] = perceive(sequence, method.features, named)
        for index, prior in enumerate(variations(sequence.prior, priors, strength)):
            outcome, picture = judge(method, Case(perceptions[key], prior, sequence.truth, sequence.objects), index)
            outcomes.append(outcome)
            pictures += [picture] if index == 0 else []
    report(sequence.name, len(methods), len(methods))
    first = next(iter(perceptions.values()), None)
    return Part(tuple(outcomes), tuple(pictures), first.seconds if first else {})


def joined(sequences: Sequence[Dataset], methods: Sequence[Method], parts: Sequence[Part]) -> Results:
    """The parts of all sequences, in their order, as one; methods that came from other processes become these."""
    known = {method.name: method for method in methods}
    return Results(
        tuple(sequences),
        tuple(methods),
        tuple(replace(one, method=known[one.method.name]) for part in parts for one in part.outcomes),
        tuple(replace(one, method=known[one.method.name]) for part in parts for one in part.pictures),
        {sequence.name: part.perceiving_s for sequence, part in zip(sequences, parts, strict=True)},
    )


def judge(method: Method, case: Case, prior: int = 0) -> tuple[Outcome, Picture]:
    """Run a method on a case and compare with the truth; `seconds` is the method's own time, without the encoder's."""
    encoding_s = 0.0

    def text(concepts: Sequence[Sequence[str]]) -> TextEmbeddings:
        nonlocal encoding_s
        asked_s = time.perf_counter()
        reply = case.perception.text(concepts)
        encoding_s += time.perf_counter() - asked_s
        return reply

    started_s = time.perf_counter()
    scene = method.run(replace(case, perception=replace(case.perception, text=text)))
    seconds = time.perf_counter() - started_s - encoding_s
    name, voxels = case.perception.name, case.perception.voxels
    scores = evaluate(scene, voxels, case.truth) | {"seconds": seconds}
    if method.name == OURS and case.objects and any(d.detector != NO_DETECTOR for d in case.perception.detections):
        names = [item.name for item in case.prior.objects]
        scores |= object_scores(scene.objects, case.objects, names, voxels)
    assignment = assign(scene, voxels, case.truth)
    labels = {region.id: region.label or NO_LABEL for region in scene.regions}
    true_labels = {region.id: region.label for region in case.truth.regions}
    confusion: dict[tuple[str, str], int] = {}
    rows = zip(
        assignment.true_ids.tolist(), assignment.estimated_ids.tolist(), assignment.volumes.tolist(), strict=True
    )
    for true_id, estimated_id, volume in rows:
        pair = (true_labels[true_id], labels.get(estimated_id, NO_LABEL))
        confusion[pair] = confusion.get(pair, 0) + volume
    calibration = reliability(beliefs_of(scene, assignment, case.truth))
    return Outcome(name, method, prior, scores), Picture(name, method, scene, voxels, calibration, confusion)


def _elsewhere(case: Case) -> Scene:
    raise RuntimeError("this method ran in another process")


def _summary(values: list[float], summary: Callable[..., Any]) -> float:
    return float(summary(values)) if values else float("nan")
