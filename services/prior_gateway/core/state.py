"""What a gateway knows, what it is making, and what the other gateways say (pure)."""

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any

from prior_sg.schemas.codec import copied
from prior_sg.schemas.priors import (
    Prior,
    PriorEvidence,
    PriorList,
    PriorRequest,
    PriorRevision,
    Recalled,
    Task,
    fault_of_task,
)
from prior_sg.services.prior_gateway.core import compose, turns
from prior_sg.services.prior_gateway.core.claims import Claims
from prior_sg.services.prior_gateway.core.config import Config

Asked = tuple[str, str, tuple[str, ...]]  # environment, task, fixed regions


@dataclass
class Conversation:
    """One conversation under way; it is at this turn."""

    dialogue: Generator[turns.Turn, str, Any]
    turn: int = 0


@dataclass
class Making:
    """A prior that is being made, or revised."""

    task: Task
    question: str
    revision: PriorRevision | None = None
    recalled: Recalled | None = None
    waiting: bool = False  # for the other gateways
    working: bool = False
    waited_ticks: int = 0
    talks: dict[str, Conversation] = field(default_factory=dict)
    drafts: dict[str, Any] = field(default_factory=dict)  # by conversation
    failures: list[str] = field(default_factory=list)


@dataclass
class Spent:
    """What revisions by the model have cost for one environment on one day."""

    day: int = -1
    calls: int = 0
    tokens: int = 0


@dataclass
class State:
    """What is known, what is being made, and what the others say."""

    instance: str
    library: compose.Library
    prompts: turns.Prompts
    priors: dict[str, Prior] = field(default_factory=dict)  # by digest, oldest first
    answers: dict[Asked, str] = field(default_factory=dict)  # digest of the prior that answers a task
    refused: dict[Asked, str] = field(default_factory=dict)
    making: dict[str, Making] = field(default_factory=dict)  # by question
    claims: Claims = field(default_factory=Claims)
    evidence: dict[Asked, dict[tuple[str, int], PriorEvidence]] = field(default_factory=dict)
    roots: dict[Asked, Prior] = field(default_factory=dict)  # what revised priors were before any revision
    spent: dict[str, Spent] = field(default_factory=dict)  # by environment
    day: int = 0  # since 1970, of the newest tick
    begun: int = 0  # rounds of conversations so far, for their names


def task_of(environment: str, task: str, regions: tuple[str, ...] | list[str]) -> Task:
    """The task that asks this, of no robot."""
    return Task(robot="library", stamp_ns=0, environment=environment, task=task, regions=list(regions))


def asked_for(of: Task | PriorRevision) -> Asked:
    """What a task or a revision asks for."""
    return of.environment, of.task, tuple(of.regions)


def asked_about(of: Prior | PriorEvidence) -> Asked:
    """What a prior answers, or what evidence speaks of."""
    return of.environment, of.task, tuple(of.vocabulary)


def known_prior(state: State, request: PriorRequest, cfg: Config) -> PriorList:
    """The prior of a digest, else of a task; of a task that nobody has given yet, what the library would say."""
    if request.digest:
        if prior := state.priors.get(request.digest):
            return PriorList(priors=[prior])
        return PriorList(priors=[], reason=f"No prior with the digest {request.digest} is known here.")
    if fault := fault_of_task(request.environment, request.task, request.regions):
        return PriorList(priors=[], reason=f"The task is refused: {fault}.")
    asked = (request.environment, request.task, tuple(request.regions))
    under_way = any(asked_for(making.task) == asked for making in state.making.values())
    if reason := state.refused.get(asked):
        return PriorList(priors=[], reason=reason, pending=under_way)
    if digest := state.answers.get(asked):
        return PriorList(priors=[state.priors[digest]], pending=under_way)
    if under_way:
        return PriorList(priors=[], reason=f"{cfg.maker} is being asked for a prior.", pending=True)
    if cfg.provider != "library":
        return PriorList(priors=[], reason="A prior is made when a robot is given the task.", pending=True)
    try:
        return PriorList(priors=[state.library.answer(task_of(*asked), cfg)])
    except compose.NoPrior as reason:
        return PriorList(priors=[], reason=str(reason), pending=True)


def prior_of_question(state: State, question: str) -> Prior | None:
    """The prior that was made for a question, if it is known."""
    return next((prior for prior in state.priors.values() if prior.provenance.question == question), None)


def prior_in_force(state: State, making: Making, cfg: Config) -> tuple[Prior, Prior]:
    """The prior before any revision, and the one in force. Raises NoPrior."""
    asked, recalled = asked_for(making.task), making.recalled
    current = state.priors.get(state.answers.get(asked, ""))
    if current is None and recalled is not None:
        current = recalled.preferred or recalled.newest
    if current is None:
        current = state.library.answer(making.task, cfg)
    root = state.roots.setdefault(asked, copied(current))
    return root, current


def spent_today(state: State, environment: str, cfg: Config) -> Spent:
    """The account of an environment for today."""
    account = state.spent.get(environment)
    if account is None or account.day != state.day:
        account = Spent(state.day)
        put(state.spent, environment, account, cfg.remembered_priors)
    return account


def too_dear(state: State, environment: str, cfg: Config) -> str:
    """Why the model is not asked any more today to revise priors of an environment; empty = it may be."""
    account, limits = spent_today(state, environment, cfg), cfg.learning
    if limits.calls_per_day and account.calls >= limits.calls_per_day:
        return f"all {limits.calls_per_day} calls of today for {environment!r} are spent"
    if limits.tokens_per_day and account.tokens >= limits.tokens_per_day:
        return f"all {limits.tokens_per_day} tokens of today for {environment!r} are spent"
    return ""


def remember(state: State, prior: Prior, cfg: Config) -> None:
    """Priors that answer a task stay; of the others the oldest are forgotten."""
    digest = prior.digest()
    state.priors.pop(digest, None)
    state.priors[digest] = prior
    for old in list(state.priors):
        if len(state.priors) <= cfg.remembered_priors:
            return
        if old != digest:
            del state.priors[old]
            state.answers = {asked: kept for asked, kept in state.answers.items() if kept != old}


def put(memory: dict, key: object, value: object, most: int) -> None:
    """Note a value as the newest; of more than `most` the oldest are forgotten."""
    memory.pop(key, None)
    memory[key] = value
    while len(memory) > most:
        del memory[next(iter(memory))]
