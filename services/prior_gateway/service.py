"""Reads tasks, writes the prior graph for each."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from schemas.codec import Message
from schemas.priors import Prior, PriorList, PriorRequest, Task
from schemas.topics import PRIOR, PRIORS, TASK
from services.prior_gateway import core, library
from services.runtime.service import Identity, Output, Service

Asked = tuple[str, str, tuple[str, ...]]  # environment, task, fixed regions


@dataclass
class State:
    """Providers in the order of asking, what they gave by digest (oldest first), and what nobody could give."""

    providers: tuple[core.Provider, ...]
    priors: dict[str, Prior] = field(default_factory=dict)
    refused: dict[Asked, str] = field(default_factory=dict)


def init(cfg: core.Config, identity: Identity) -> State:
    """Load the library."""
    return State(providers=(library.load(),))


def step(state: State, message: Message, cfg: core.Config) -> Iterator[Output]:
    """Answer a task. The same task gives the same prior again, for robots that come late."""
    if not isinstance(message, Task):
        return
    asked = (message.environment, message.task, tuple(message.regions))
    try:
        prior = core.first_answer(state.providers, message, cfg)
    except core.NoPrior as reason:
        _remember(state.refused, asked, str(reason), cfg)
        return
    state.refused.pop(asked, None)
    _remember(state.priors, prior.digest(), prior, cfg)
    yield PRIOR, prior


def answer(state: State, request: PriorRequest, cfg: core.Config) -> PriorList:
    """The prior of a digest made here, else for an environment, task and regions, asked for before or not."""
    if request.digest:
        if prior := state.priors.get(request.digest):
            return PriorList(priors=[prior])
        return PriorList(priors=[], reason=f"No prior with the digest {request.digest} was made here.")
    asked = (request.environment, request.task, tuple(request.regions))
    if reason := state.refused.get(asked):
        return PriorList(priors=[], reason=reason)
    task = Task(robot="", stamp_ns=0, environment=request.environment, task=request.task, regions=request.regions)
    try:
        return PriorList(priors=[core.first_answer(state.providers, task, cfg)])
    except core.NoPrior as reason:
        return PriorList(priors=[], reason=str(reason))


def _remember(memory: dict, key: object, value: object, cfg: core.Config) -> None:
    memory.pop(key, None)
    memory[key] = value
    while len(memory) > cfg.remembered_priors:
        del memory[next(iter(memory))]


SERVICE = Service(
    "prior_gateway",
    purpose="Answers a task with a prior graph: expected regions, objects and how they lie.",
    scope="fleet",
    config=core.Config,
    init=init,
    step=step,
    reads=(TASK,),
    writes=(PRIOR,),
    answers={PRIORS: answer},
)
