"""The methods that are compared: ours, its ablations and sweeps, and the baselines."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.evaluation import oracles, priors
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.kinds import BASELINES, ORACLES, OURS, SWEEPS
from prior_sg.deploy.evaluation.perception import Perception
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.features import Pyramid, TextEmbeddings
from prior_sg.schemas.objects import Detections
from prior_sg.schemas.priors import Prior, Task
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import DETECTIONS, PLACE_DELTA, PRIOR, PYRAMID, SCENE, TASK, TEXT
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core.aim import region_concepts
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts import REGISTRY
from prior_sg.services.segmenter.core.inference import see_objects
from prior_sg.services.segmenter.core.state import State

NEVER_M, ANY_SCALE = 1e6, 1e9
WORTHLESS = 2.0  # more than crops can tell, which is a share


@dataclass(frozen=True)
class Case:
    """One sequence with one prior."""

    perception: Perception
    prior: Prior
    truth: GroundTruth
    objects: tuple[TrueObject, ...] = ()  # empty where the ground truth names none


@dataclass(frozen=True)
class Method:
    """Something that turns a case into a scene."""

    name: str
    run: Callable[[Case], Scene]
    about: str = ""
    group: str = "method"  # or ablation, oracle, and the names of SWEEPS
    features: Mapping[str, Any] = field(default_factory=dict)  # settings of the feature pyramid that differ
    value: float | str = ""  # of a sweep


@dataclass(frozen=True)
class Variant:
    """Our method with parts of it changed or taken away."""

    config: Config
    prior: Callable[[Case], Prior] = lambda case: case.prior
    pyramids: Callable[[Case], Sequence[Pyramid]] = lambda case: case.perception.pyramids
    detections: Callable[[Case], Sequence[Detections]] = lambda case: case.perception.detections
    text: Callable[[TextEmbeddings], TextEmbeddings] = lambda text: text
    seen: Callable[[Case, State], None] = lambda case, state: None  # may change what the segmenter has seen

    def run(self, case: Case) -> Scene:
        """Places, all pyramids and detections, then task and prior; the field is solved when all that is known."""
        prior, perception = self.prior(case), case.perception
        config = msgspec.structs.replace(self.config, space=perception.space)
        robot = perception.places.robot
        with labelling(config, robot, lambda concepts: self.text(perception.text(concepts))) as pipeline:
            pipeline.publish(PLACE_DELTA, perception.places)
            for pyramid in self.pyramids(case):
                pipeline.publish(PYRAMID, pyramid)
            for detections in self.detections(case):
                pipeline.publish(DETECTIONS, detections)
            segmenter = pipeline.of("segmenter")
            self.seen(case, segmenter.state)
            put_in_force(pipeline, robot, prior)
            for stamp_ns in (1, 2):
                pipeline.feed(segmenter, Tick(stamp_ns=stamp_ns))
            return scene_of(pipeline, robot)


def labelling(config: Config, robot: str, text: Callable[[list[list[str]]], TextEmbeddings]) -> Pipeline:
    """A segmenter and a store in memory; questions for text are answered by a function of the concepts."""
    segmenter, store = BY_NAME["segmenter"], BY_NAME["scene_store"]
    identity = Identity(robot, "segmenter", 1)
    return Pipeline(
        (
            Runner(segmenter, config, identity, {TEXT: lambda request: text(request.concepts)}),
            Runner(store, store.config(path=":memory:")),
        )
    )


def put_in_force(pipeline: Pipeline, robot: str, prior: Prior) -> None:
    """Give a robot the task of a prior, and the prior."""
    task = Task(robot=robot, stamp_ns=0, environment=prior.environment, task=prior.task, regions=prior.vocabulary)
    pipeline.publish(TASK, task)
    pipeline.publish(PRIOR, prior)


def scene_of(pipeline: Pipeline, robot: str) -> Scene:
    """What the store holds of a robot."""
    scene: Scene = pipeline.of("scene_store").answer(SCENE, SceneRequest(robot=robot))
    return scene


def ours(config: Config) -> Method:
    """The product as configured."""
    return Method(OURS, Variant(config).run, "the segmenter as configured")


def ablations(config: Config) -> list[Method]:
    """Experts switched on one by one (the paper's table), then single parts taken away."""

    def bare(case: Case) -> Prior:
        return priors.with_one_phrase(case.prior)

    def but(part: str, **changes: Any) -> Variant:
        """Ours with a part's settings changed."""
        changed = msgspec.structs.replace(getattr(config, part), **changes)
        return at(**{part: changed})

    def at(**changes: Any) -> Variant:
        return Variant(msgspec.structs.replace(config, **changes))

    unscaled = but("kernel", gamma=ANY_SCALE)
    parts = {
        "no sharing": (but("sharing", steps=0), "each place is compared with the regions for itself"),
        "no balance": (but("balance", limit=0.0), "labels that the encoder favours everywhere are not corrected"),
        "no adaptation": (but("adaptation", weight=0.0), "regions are recognised by their text alone"),
        "crops mix": (but("unmixing", rounds=0), "crops are not told apart into places"),
        "always corrected": (
            but("information", least=WORTHLESS, full=WORTHLESS + 1),
            "the map corrects looks whatever they are worth, and crops are not told apart",
        ),
        "regions are free": (at(region_cost=0.0), "no region has to pay for itself"),
        "borders as in the paper": (but("adjacency", border=0.0), "-log P of the prior, not against chance"),
        "equally sure": (at(informed=0.0), "beliefs are as sure whatever crops tell"),
        "no pairwise term": (at(beta=0.0), "beta = 0"),
        "doors are open": (at(edge_clearance_m=0.0), "narrow ways bind places as firmly as wide ones"),
        "sought objects speak": (
            but("tracking", unprompted_weight=0.0),
            "not those of a detector that does not know the prior's",
        ),
        "no scale trust": (unscaled, "crops of any scale count alike"),
        "no occlusion test": (but("kernel", occlusion_tolerance_m=NEVER_M), "hidden places count as seen"),
        "global feature": (
            without_pyramid(config)["global feature"],
            "only the pyramid's largest crops, which show nearly the whole image",
        ),
        "one phrase": (Variant(config, prior=bare), "each region is described by its name alone"),
        "raw similarity": (Variant(config, text=raw_similarity), "similarities are not standardised per concept"),
    }
    rows = [Method(name, variant.run, about, "ablation") for name, (variant, about) in parts.items()]
    return expert_rows(config) + rows


def without_pyramid(config: Config) -> dict[str, Variant]:
    """Ours with nothing but each pyramid's largest crops: at any distance alike, and with scale trust as configured."""

    def large(case: Case) -> list[Pyramid]:
        return [oracles.top_layer(pyramid) for pyramid in case.perception.pyramids]

    kernel = msgspec.structs.replace(config.kernel, gamma=ANY_SCALE)
    unscaled = msgspec.structs.replace(config, kernel=kernel)
    return {"global feature": Variant(unscaled, pyramids=large), "no pyramid": Variant(config, pyramids=large)}


def expert_rows(config: Config) -> list[Method]:
    """Every set of registered experts with the visual one; without E the prior's structure is uniform.

    Experts that rest on containment have nothing to say without E (paper, Ablation Studies) and are left out.
    """
    weights = {name: config.experts.get(name, Config().experts.get(name, 1.0)) for name in REGISTRY}
    others = [name for name in REGISTRY if name not in ("visual", "environment")]
    rows = []
    for size, structure in itertools.product(range(len(others) + 1), (False, True)):
        for extra in itertools.combinations(others, size):
            if not structure and any(name in ("object", "contents") for name in extra):
                continue
            chosen = ("visual", *(["environment"] if structure else []), *extra)
            variant = Variant(msgspec.structs.replace(config, experts={name: weights[name] for name in chosen}))
            if not structure:
                variant = replace(variant, prior=lambda case: priors.without_structure(case.prior))
            letters = "+".join(name[0].upper() for name in chosen)
            rows.append(Method(letters, variant.run, "experts: " + ", ".join(chosen), "ablation"))
    return rows


def raw_similarity(text: TextEmbeddings) -> TextEmbeddings:
    """One mean and spread for all concepts, so that standardising only shifts and scales."""
    ones = np.ones_like(text.background_mean)
    return msgspec.structs.replace(
        text, background_mean=ones * text.background_mean.mean(), background_std=ones * text.background_std.mean()
    )


def oracle(config: Config, name: str) -> Method:
    """Our method with one part replaced by the truth; `name` is one of ORACLES."""
    variants = {
        "features": Variant(config, pyramids=lambda case: _true_pyramids(case, config.object_phrases)),
        "places": Variant(config, seen=lambda case, state: _see_truth(case, state, config.object_phrases)),
        "objects": Variant(
            config,
            detections=lambda case: () if case.objects else case.perception.detections,
            seen=lambda case, state: _see_true_objects(case, state, config),
        ),
        "prior": Variant(config, prior=lambda case: priors.counted(case.prior, case.truth, case.perception.places)),
    }
    return Method(f"oracle {name}", variants[name].run, ORACLES[name], "oracle")


def _concepts(case: Case, object_phrases: int) -> dict[str, np.ndarray]:
    text = case.perception.text(region_concepts(case.prior, object_phrases))
    return dict(zip([region.name for region in case.prior.regions], text.embeddings, strict=True))


def _true_pyramids(case: Case, object_phrases: int) -> list[Pyramid]:
    concepts = _concepts(case, object_phrases)
    return [oracles.true_features(pyramid, case.truth, concepts) for pyramid in case.perception.pyramids]


def _see_truth(case: Case, state: State, object_phrases: int) -> None:
    """Observed places inside a true region are as if its text had been seen there."""
    labels = {region.id: region.label for region in case.truth.regions}
    concepts, graph = _concepts(case, object_phrases), state.map.graph
    names = [labels.get(region, "") for region in case.truth.region_of(graph.positions_m).tolist()]
    rows = [row for row, name in enumerate(names) if name in concepts]
    if rows:
        state.seen.pretend(graph.ids[rows], np.array([concepts[names[row]] for row in rows]))


def _see_true_objects(case: Case, state: State, config: Config) -> None:
    if case.objects:
        see_objects(state, oracles.seen_objects(case.objects, case.prior, case.perception.voxels), config)


def sweep(config: Config, kind: str) -> list[Method]:
    """Our method over the values of one setting."""
    rows = []
    for value in SWEEPS[kind]:
        features = {"crop": {"smallest_crop_px": value}, "encoder": {"space": value}}.get(kind, {})
        variant = Variant(config)
        if kind == "radius":
            variant = Variant(config, prior=lambda case, value=value: priors.with_radius(case.prior, value))  # type: ignore[misc]
        rows.append(Method(f"{kind} {value}", variant.run, f"ours with {kind} {value}", kind, features, value))
    return rows


def baseline(name: str, object_phrases: int = 0, changes: Mapping[str, str] | None = None) -> Method:
    """A method of others, with its tuned settings and `changes` to them, on the same places, crops and concepts.

    Baselines hold no beliefs, so their scenes have no posteriors. Raises EvaluationError for a name that is not known.
    """
    from prior_sg.deploy.evaluation.baselines import common

    module = _baseline_module(name)
    config = _changed(name, module.TUNED, changes or {})

    def run(case: Case) -> Scene:
        perception, prior = case.perception, case.prior
        inputs = common.Inputs.of(
            perception.places,
            perception.pyramids,
            [region.name for region in prior.regions],
            perception.text(region_concepts(prior, object_phrases)),
            perception.voxels,
            query_radius_m=float(np.median([region.query_radius_m for region in prior.regions])),
        )
        answer = module.segment(inputs, config)
        scene = common.to_scene(inputs, answer.labels, answer.regions)
        return msgspec.structs.replace(scene, posteriors=np.zeros((len(scene.place_ids), 0), np.float16))

    return Method(name, run, (module.__doc__ or "").strip().splitlines()[0])


def _changed(name: str, tuned: Any, changes: Mapping[str, str]) -> Any:
    """A baseline's settings with some others, read as their field's type. Raises EvaluationError."""
    values = asdict(tuned)
    for field_name in changes:
        if field_name not in values:
            raise EvaluationError(f"{name} has no setting {field_name!r}: choose from {', '.join(values)}")
    try:
        return msgspec.convert({**values, **changes}, type(tuned), strict=False)
    except msgspec.ValidationError as error:
        raise EvaluationError(f"{name}: {error}") from error


def _baseline_module(name: str) -> ModuleType:
    from prior_sg.deploy.evaluation.baselines import argmax, clio, hovsg, hydra

    modules = {"clio": clio, "hovsg": hovsg, "hydra": hydra, "argmax": argmax}
    if name not in modules:
        raise EvaluationError(f"there is no method {name!r}: choose from {', '.join((OURS, *BASELINES))}")
    return modules[name]
