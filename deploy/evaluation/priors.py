"""Priors to judge with: the library's, variations of it, and priors with less or more knowledge than it has."""

import itertools
from collections.abc import Sequence

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior, PriorList, PriorRequest, RegionPrior
from prior_sg.schemas.topics import PRIORS
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner

LEAST, MOST = 1e-3, 1 - 1e-3  # probabilities stay inside, so that their logits exist
PSEUDO_COUNT = 0.1  # of pairs of regions that touch, and of those that do not


def library_prior(environment: str, task: str, names: Sequence[str]) -> Prior:
    """The gateway's prior for a fixed vocabulary. Raises EvaluationError."""
    request = PriorRequest(environment=environment, task=task, regions=list(names))
    reply: PriorList = Runner(BY_NAME["prior_gateway"]).answer(PRIORS, request)
    if not reply.priors:
        raise EvaluationError(f"no prior for the environment {environment!r}: {reply.reason}")
    return reply.priors[0]


def variations(prior: Prior, count: int, strength: float) -> list[Prior]:
    """The prior itself and `count` - 1 perturbed ones, the k-th with seed k."""
    return [prior, *(perturbed(prior, seed, strength) for seed in range(1, count))]


def perturbed(prior: Prior, seed: int, strength: float) -> Prior:
    """Another prior that might have been written for the same task; a stand-in for another generation of a language
    model, which would choose other words and other figures.

    Each region keeps its first phrase, its name; its others are drawn again from its own, with replacement, and so are
    its objects: those not drawn fall to the region's least P(o | r). Then existence, containment and adjacency get
    normal noise of standard deviation `strength` on their logits; existence sums to one again, adjacency stays
    symmetric.
    """
    rng = np.random.default_rng(seed)
    phrases = [_redrawn(rng, region.phrases) for region in prior.regions]
    containment = prior.containment.astype(float)
    for row in containment:
        listed = np.flatnonzero(row > row.min()) if len(row) else np.zeros(0, int)
        lost = np.setdiff1d(listed, listed[_draw(rng, len(listed))])
        row[lost] = row.min(initial=1.0)
    existence = _noisy(rng, np.array([region.existence for region in prior.regions]), strength)
    upper = np.triu(_noisy(rng, prior.adjacency.astype(float), strength), 1)
    adjacency = upper + upper.T + np.diag(np.diag(prior.adjacency))
    regions = [
        msgspec.structs.replace(region, phrases=words, existence=float(share))
        for region, words, share in zip(prior.regions, phrases, existence / existence.sum(), strict=True)
    ]
    return _changed(prior, regions, _noisy(rng, containment, strength), adjacency, f"perturbed with seed {seed}")


def without_structure(prior: Prior) -> Prior:
    """Uniform existence, containment and adjacency 1 / regions: only names and phrases are known (paper, "E" off)."""
    count = len(prior.regions)
    regions = [msgspec.structs.replace(region, existence=1 / count) for region in prior.regions]
    adjacency = np.full((count, count), 1 / count)
    np.fill_diagonal(adjacency, np.diag(prior.adjacency))
    containment = np.full(prior.containment.shape, 1 / max(len(prior.objects), 1))
    return _changed(prior, regions, containment, adjacency, "without structure")


def with_one_phrase(prior: Prior) -> Prior:
    """Regions are described by their name alone."""
    regions = [msgspec.structs.replace(region, phrases=[region.name]) for region in prior.regions]
    return _changed(prior, regions, prior.containment, prior.adjacency, "one phrase")


def with_radius(prior: Prior, query_radius_m: float) -> Prior:
    """Another r_Q for every region."""
    regions = [msgspec.structs.replace(region, query_radius_m=query_radius_m) for region in prior.regions]
    return _changed(prior, regions, prior.containment, prior.adjacency, f"r_Q {query_radius_m}")


def counted(prior: Prior, truth: GroundTruth, places: PlaceDelta) -> Prior:
    """Existence and adjacency counted from the ground truth (oracle).

    Existence is the share of places in regions of that name, adjacency the share of pairs of true regions with these
    two names that an edge of the place graph joins; both with PSEUDO_COUNT.
    """
    names = [region.name for region in prior.regions]
    true_ids = truth.region_of(places.positions_m)
    label_of = {region.id: names.index(region.label) for region in truth.regions if region.label in names}
    existence = np.full(len(names), PSEUDO_COUNT)
    np.add.at(existence, [label_of[i] for i in true_ids.tolist() if i in label_of], 1.0)
    region_of_place = dict(zip(places.place_ids.tolist(), true_ids.tolist(), strict=True))
    joined = {frozenset((region_of_place[a], region_of_place[b])) for a, b in places.edges.tolist()}
    touching, pairs = np.zeros((2, len(names), len(names)))
    for (one, row), (other, column) in itertools.permutations(label_of.items(), 2):
        pairs[row, column] += 1
        touching[row, column] += frozenset((one, other)) in joined
    adjacency = (touching + PSEUDO_COUNT) / (pairs + 2 * PSEUDO_COUNT)
    np.fill_diagonal(adjacency, np.diag(prior.adjacency))
    regions = [
        msgspec.structs.replace(region, existence=float(share))
        for region, share in zip(prior.regions, existence / existence.sum(), strict=True)
    ]
    return _changed(prior, regions, prior.containment, adjacency, "counted from the ground truth")


def _changed(
    prior: Prior, regions: list[RegionPrior], containment: np.ndarray, adjacency: np.ndarray, note: str
) -> Prior:
    return msgspec.structs.replace(
        prior,
        regions=regions,
        containment=containment.astype(np.float32),
        adjacency=np.clip(adjacency, LEAST, 1.0).astype(np.float32),
        provenance=msgspec.structs.replace(prior.provenance, note=note),
    )


def _draw(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, count, count) if count else np.zeros(0, int)


def _redrawn(rng: np.random.Generator, phrases: list[str]) -> list[str]:
    return [phrases[0], *(phrases[1 + i] for i in sorted(_draw(rng, len(phrases) - 1)))]


def _noisy(rng: np.random.Generator, probabilities: np.ndarray, strength: float) -> np.ndarray:
    inner = np.clip(probabilities, LEAST, MOST)
    logits = np.log(inner / (1 - inner)) + strength * rng.standard_normal(inner.shape)
    return 1 / (1 + np.exp(-logits))
