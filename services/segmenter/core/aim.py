"""What the map is segmented for: the task, the prior in force, and its concepts in the embedding space (pure)."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from prior_sg.schemas.codec import Message, copied
from prior_sg.schemas.features import TextEmbeddings, TextRequest
from prior_sg.schemas.levels import LevelPrior
from prior_sg.schemas.priors import Prior, PriorList, Task, TaskInForce, TaskRequest
from prior_sg.services import intent
from prior_sg.services.intent import Intent
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.layers.stacking import LevelInForce


@dataclass(frozen=True)
class PriorInForce:
    """The prior that the map is aligned with, and its concepts in the embedding space."""

    prior: Prior
    digest: str
    text: TextEmbeddings
    pairwise: np.ndarray  # (label, label), see border_costs
    levels: dict[str, LevelInForce]  # above the regions, by name

    @property
    def labels(self) -> list[str]:
        """Names of the prior's regions."""
        return [region.name for region in self.prior.regions]

    @property
    def existence(self) -> np.ndarray:
        """P(r | E0) (label,)."""
        return np.array([region.existence for region in self.prior.regions])

    @property
    def query_radius_m(self) -> float:
        """r_Q: the median over the regions."""
        return float(np.median([region.query_radius_m for region in self.prior.regions]))


@dataclass
class Aim:
    """Task and priors, what is in force of them, and what was asked."""

    robot: str
    intent: Intent
    in_force: PriorInForce | None = None
    texts: dict[tuple[str, ...], TextEmbeddings] = field(default_factory=dict)  # by space and concepts
    asked_text: dict[str, TextRequest] = field(default_factory=dict)  # by space
    asked_prior: bool = False
    asked_task: bool = False
    waited_ticks: int = 0  # for a prior

    @property
    def task(self) -> Task | None:
        """The newest task."""
        return self.intent.tasks.get(self.robot)

    @property
    def aligned(self) -> PriorInForce:
        """The prior in force, where there is one."""
        assert self.in_force is not None
        return self.in_force

    @property
    def wanted(self) -> tuple[str, Prior] | None:
        """The latest prior that answers the task, with its digest."""
        return intent.prior_in_force(self.intent, self.robot)

    def hear(self, message: Task | TaskInForce | Prior | PriorList) -> None:
        """Take a task or priors. From a new task on only a prior for it counts; labels stay until it is in force."""
        if intent.hear(self.intent, message):
            self.waited_ticks = 0
        if isinstance(message, PriorList):
            self.asked_prior, self.waited_ticks = False, 0

    def tick(self) -> None:
        """Half a second has passed."""
        self.waited_ticks += 1

    def take_text(self, text: TextEmbeddings, cfg: Config) -> None:
        """The reply to the text request under way in its space; it does not say which, hence never two at once."""
        asked = self.asked_text.pop(text.space, None)
        if asked is not None and len(text.embeddings) == len(asked.concepts):
            self.texts[_concept_key(text.space, asked.concepts)] = copied(text)
            while len(self.texts) > 2 * cfg.remembered_priors:  # regions and objects of each
                del self.texts[next(iter(self.texts))]

    def text_of(self, space: str, concepts: list[list[str]]) -> TextEmbeddings | None:
        """Concepts in an embedding space, if they are known there."""
        return self.texts.get(_concept_key(space, concepts))

    def switch(self, space: str, cfg: Config) -> PriorInForce | None:
        """Put the wanted prior in force once its text embeddings are there; None when nothing has changed."""
        wanted = self.wanted
        if wanted is None or self._holds(wanted[0]):
            return None
        digest, prior = wanted
        text = self.text_of(space, region_concepts(prior, cfg.object_phrases))
        if text is None:
            return None
        levels: dict[str, LevelInForce] = {
            level.name: LevelInForce(level, border_costs(level, cfg)) for level in prior.levels_above
        }
        self.in_force = PriorInForce(prior, digest, text, border_costs(prior, cfg), levels)
        return self.in_force

    def translate(self, text: TextEmbeddings | None) -> None:
        """The same prior, its concepts in another embedding space."""
        if self.in_force is not None and text is not None:
            self.in_force = replace(self.in_force, text=text)

    def requests(self, space: str, has_objects: bool, cfg: Config) -> Iterator[Message]:
        """Ask for what is missing and not asked for yet: the prior, and texts; with `has_objects`, of its objects."""
        wanted = self.wanted
        if wanted is None:
            if self.waited_ticks >= cfg.prior_wait_ticks and not self.asked_prior:
                for question in intent.prior_question(self.intent, self.robot):
                    self.asked_prior = True
                    yield question
        elif not self._holds(wanted[0]):
            yield from self.ask_text(space, region_concepts(wanted[1], cfg.object_phrases))
        elif has_objects:
            concepts = object_concepts(wanted[1])
            if concepts and self.text_of(space, concepts) is None:
                yield from self.ask_text(space, concepts)

    def ask_for_task(self) -> Iterator[TaskRequest]:
        """Once, for the task that was given before this process began."""
        if not self.asked_task:
            self.asked_task = True
            yield TaskRequest(robot=self.robot)

    def ask_text(self, space: str, concepts: list[list[str]]) -> Iterator[TextRequest]:
        """Ask for concepts in an embedding space, unless it has a question to answer already."""
        if space not in self.asked_text:
            self.asked_text[space] = TextRequest(space=space, concepts=concepts)
            yield self.asked_text[space]

    def _holds(self, digest: str) -> bool:
        return self.in_force is not None and self.in_force.digest == digest


def border_costs(prior: Prior | LevelPrior, cfg: Config) -> np.ndarray:
    """Pairwise costs (label, label), zero on the diagonal: eq. pairwise_potential without the edge's weight, and with
    the prior's adjacency against chance, see AdjacencyConfig."""
    log_adjacency = np.log(np.maximum(prior.adjacency.astype(np.float64), cfg.probability_floor))
    costs, against = -log_adjacency, cfg.adjacency
    if against.border > 0 and len(costs) > 1:
        chance = log_adjacency[~np.eye(len(costs), dtype=bool)].mean()
        costs = np.clip(against.border + against.trust * (chance - log_adjacency), against.least, against.most)
    np.fill_diagonal(costs, 0.0)
    return cfg.beta * costs


def region_concepts(prior: Prior, object_phrases: int) -> list[list[str]]:
    """The phrases that describe each region: its own, and the first phrase of its most discriminative objects.

    An object's merit for a region is P(o | r) log(P(o | r) / mean over regions of P(o | r)).
    """
    concepts = [list(region.phrases) for region in prior.regions]
    if object_phrases and prior.objects:
        containment = np.maximum(prior.containment.astype(np.float64), 1e-9)
        merit = containment * np.log(containment / containment.mean(axis=0))
        for concept, row in zip(concepts, merit, strict=True):
            best = np.argsort(-row, kind="stable")[:object_phrases]
            concept.extend(prior.objects[index].phrases[0] for index in best if row[index] > 0)
    return concepts


def object_concepts(prior: Prior) -> list[list[str]]:
    """The phrases that describe each of the prior's objects."""
    return [list(item.phrases) for item in prior.objects]


def _concept_key(space: str, concepts: list[list[str]]) -> tuple[str, ...]:
    return (space, *("\n".join(phrases) for phrases in concepts))
