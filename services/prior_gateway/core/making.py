"""The steps of making a prior: it is looked up, claimed, asked for turn by turn, kept, answered or given up (pure)."""

from collections.abc import Generator, Iterator
from typing import Any, Literal

import msgspec

from prior_sg.schemas.codec import copied
from prior_sg.schemas.priors import Keep, ModelRequest, Prior, PriorClaim, Provenance, Recall
from prior_sg.services.prior_gateway.core import compose, turns
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.state import Conversation, Making, State, asked_for, put, remember

Told = Prior | PriorClaim | Keep | ModelRequest | Recall  # to the fleet, or for somebody outside to do


def begin(state: State, making: Making) -> Iterator[Told]:
    """Look into the archive first; it may hold an imported or revised prior."""
    if making.question in state.making:
        return
    task = making.task
    state.making[making.question] = making
    yield Recall(question=making.question, environment=task.environment, task=task.task, regions=task.regions)


def claim_of(state: State, making: Making, gave_up: bool = False) -> PriorClaim:
    """How far this gateway is, for the others."""
    said: Literal["gave up", "works", "wants"] = "gave up" if gave_up else "works" if making.working else "wants"
    return PriorClaim(question=making.question, holder=state.instance, state=said)


def start(
    state: State, making: Making, dialogue: Generator[turns.Turn, str, Any], sample: int, cfg: Config
) -> Iterator[Told]:
    """A conversation with the model, with its first turn."""
    name = f"{making.question[:12]}/{state.begun}/{sample}"
    making.talks[name] = Conversation(dialogue)
    yield say(name, making.talks[name], next(dialogue), cfg)


def say(name: str, talk: Conversation, turn: turns.Turn, cfg: Config) -> ModelRequest:
    """One turn of a conversation, for somebody outside to say."""
    return ModelRequest(
        conversation=name,
        turn=talk.turn,
        messages=list(turn.messages),
        schema=msgspec.json.encode(turn.schema).decode() if turn.schema else "",
        schema_name=turn.name,
        max_tokens=cfg.synthesis.max_tokens,
    )


def provenance_of(state: State, making: Making, cfg: Config, **fields: Any) -> Provenance:
    """Who makes this prior from what; `fields` say the rest."""
    asked = {"source": cfg.maker, "detail": f"{cfg.provider} {cfg.base_url}".strip(), "prompts": state.prompts.version}
    return Provenance(**(asked | {"question": making.question} | fields))


def to_keep(making: Making, prior: Prior, state: State) -> Keep:
    """Before it is published, a prior is dated, signed and safe on disk."""
    revised = making.revision is not None
    root = state.roots.get(asked_for(making.task)) if revised else None
    return Keep(prior=prior, question=making.question, own=True, preferred=revised, root=root)


def answer(state: State, making: Making, prior: Prior, cfg: Config) -> Iterator[Told]:
    """The task has its prior."""
    state.making.pop(making.question, None)
    asked = asked_for(making.task)
    state.refused.pop(asked, None)
    remember(state, prior, cfg)
    put(state.answers, asked, prior.digest(), cfg.remembered_priors)
    yield prior


def answer_by_library(state: State, making: Making, cfg: Config, remark: str = "") -> Iterator[Told]:
    """The task has the library's prior, which says the remark; or a reason for none."""
    try:
        prior = compose.noted(
            state.library.answer(making.task, cfg), f"{remark}: this is the library's" if remark else ""
        )
    except compose.NoPrior as reason:
        state.making.pop(making.question, None)
        told = ". ".join(filter(None, (remark, str(reason))))
        put(state.refused, asked_for(making.task), told, cfg.remembered_priors)
        return
    yield from answer(state, making, prior, cfg)


def give_up(state: State, making: Making, reason: str, cfg: Config) -> Iterator[Told]:
    """Say so to the others, and take the newest kept prior or the library's, which then says why."""
    yield claim_of(state, making, gave_up=True)
    if making.revision is not None:
        del state.making[making.question]
        return
    remark = f"{cfg.model} gave no prior ({reason})"
    newest = making.recalled.newest if making.recalled else None
    if newest is None:
        yield from answer_by_library(state, making, cfg, remark)
        return
    prior = compose.noted(copied(newest), f"{remark}: this is the newest one kept, of {newest.provenance.source}")
    bare = msgspec.structs.replace(prior.provenance, question="", signer="", signature="")
    yield from answer(state, making, msgspec.structs.replace(prior, provenance=bare), cfg)
