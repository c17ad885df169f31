"""How a gateway comes to the prior of a task (pure).

A task is looked up in the archive. What is not there the library answers at once, or a model over many turns; before a
model is asked, the gateways of the fleet agree on one that does it (`claims`). Whatever fails ends in a prior that says
so, or in a reason. Everything slow or outside is an errand: this module only decides.
"""

from collections.abc import Iterator

from prior_sg.schemas.codec import Message, copied
from prior_sg.schemas.priors import (
    Keep,
    Kept,
    ModelReply,
    Prior,
    PriorClaim,
    PriorEvidence,
    PriorRevision,
    Recalled,
    Task,
    fault_of_task,
)
from prior_sg.schemas.status import Tick
from prior_sg.services.prior_gateway.core import compose, ensemble, turns
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.experience import begin_revision, conclude_revision, learn, revise
from prior_sg.services.prior_gateway.core.making import (
    Told,
    answer,
    answer_by_library,
    begin,
    claim_of,
    give_up,
    provenance_of,
    say,
    start,
    to_keep,
)
from prior_sg.services.prior_gateway.core.matching import match_environment, same_region
from prior_sg.services.prior_gateway.core.state import (
    Making,
    State,
    asked_about,
    asked_for,
    prior_of_question,
    put,
    remember,
    spent_today,
    too_dear,
)
from prior_sg.services.refusals import InputRefused

TICK_S = 0.5  # between two ticks
DAY_NS = 24 * 60 * 60 * 10**9


def update(state: State, message: Message, cfg: Config) -> Iterator[Told]:
    """One input. The same task gives the same prior again, for robots that come late. Raises InputRefused."""
    match message:
        case Task():
            if fault := message.fault():
                raise InputRefused(fault)
            yield from begin(state, Making(message, compose.question_of(message, cfg, state.prompts.version)))
        case PriorRevision():
            if fault := fault_of_task(message.environment, message.task, message.regions):
                raise InputRefused(fault)
            yield from begin_revision(state, message)
        case Recalled():
            yield from _recalled(state, message, cfg)
        case PriorClaim():
            yield from _hear(state, message)
        case Tick():
            state.day = message.stamp_ns // DAY_NS
            yield from _tick(state, cfg)
        case ModelReply():
            yield from _replied(state, message, cfg)
        case Prior():
            yield from _received(state, message)
        case Kept():
            yield from _kept(state, message, cfg)
        case PriorEvidence():
            yield from learn(state, message, cfg)


def _recalled(state: State, recalled: Recalled, cfg: Config) -> Iterator[Told]:
    """What the archive knows decides how to go on."""
    making = state.making.get(recalled.question)
    if making is None:
        return
    making.recalled, asked = recalled, asked_for(making.task)
    if recalled.root is not None:
        state.roots.setdefault(asked, copied(recalled.root))
    known = state.evidence.setdefault(asked, {})
    for seen in recalled.evidence:
        known.setdefault((seen.robot, seen.epoch), copied(seen))
    found = recalled.preferred or recalled.exact or prior_of_question(state, recalled.question)
    if making.revision is not None:
        making.waiting = True
        yield claim_of(state, making)
    elif found is not None:
        yield from answer(state, making, found, cfg)
    elif cfg.provider == "library":
        yield from answer_by_library(state, making, cfg)
    else:
        making.waiting = True
        yield claim_of(state, making)


def _hear(state: State, claim: PriorClaim) -> Iterator[Told]:
    """Another gateway wants to ask a model; whoever has the prior already publishes it once more."""
    if claim.holder == state.instance:
        return
    state.claims.hear(claim)
    if claim.state == "wants" and (prior := prior_of_question(state, claim.question)) is not None:
        yield prior


def _tick(state: State, cfg: Config) -> Iterator[Told]:
    """Claims are renewed, and whoever's turn it is begins."""
    state.claims.tick(max(1, round(cfg.lease_s / TICK_S)))
    for making in list(state.making.values()):
        if making.waiting:
            making.waited_ticks += 1
            making.working = state.claims.may_work(making.question, state.instance, making.waited_ticks)
            making.waiting = not making.working
            yield claim_of(state, making)
            if making.working:
                yield from _work(state, making, cfg)
        elif making.working:
            yield claim_of(state, making)


def _work(state: State, making: Making, cfg: Config) -> Iterator[Told]:
    """Begin the conversations, or count."""
    state.begun += 1
    if making.revision is not None:
        yield from revise(state, making, cfg)
        return
    for sample in range(cfg.synthesis.samples):
        dialogue = turns.synthesise(making.task, state.prompts, cfg.synthesis)
        yield from start(state, making, dialogue, sample, cfg)


def _replied(state: State, reply: ModelReply, cfg: Config) -> Iterator[Told]:
    """The next turn of a conversation, or its end; after the last one, the prior."""
    making = next((making for making in state.making.values() if reply.conversation in making.talks), None)
    if making is None or making.talks[reply.conversation].turn != reply.turn:
        return
    talk = making.talks[reply.conversation]
    if making.revision is not None:
        account = spent_today(state, making.task.environment, cfg)
        account.calls, account.tokens = account.calls + 1, account.tokens + reply.tokens_in + reply.tokens_out
    try:
        if reply.failure:
            raise turns.Unusable(reply.reason)
        turn = talk.dialogue.send(reply.text)
        if making.revision is not None and (dear := too_dear(state, making.task.environment, cfg)):
            turn = talk.dialogue.throw(turns.Unusable(dear))  # ends with what there is, or raises it
        talk.turn += 1
        yield say(reply.conversation, talk, turn, cfg)
        return
    except StopIteration as end:
        making.drafts[reply.conversation] = end.value
    except turns.Unusable as why:
        making.failures.append(str(why))
    del making.talks[reply.conversation]
    if not making.talks:
        yield from _conclude(state, making, cfg)


def _conclude(state: State, making: Making, cfg: Config) -> Iterator[Told]:
    """All conversations have ended: the mean of what they brought, or what there is instead."""
    drafts = [making.drafts[name] for name in sorted(making.drafts)]
    if not drafts:
        yield from give_up(state, making, making.failures[0], cfg)
        return
    if making.revision is not None:
        yield from conclude_revision(state, making, drafts[0], cfg)
        return
    try:
        yield to_keep(making, _combined(state, making, drafts, cfg), state)
    except ValueError as error:  # the mean of valid generations can be too large to be a prior
        yield from give_up(state, making, f"its prior cannot be used: {error}", cfg)


def _combined(state: State, making: Making, drafts: list[turns.Draft], cfg: Config) -> Prior:
    own = match_environment(making.task.environment, state.library.environments)
    known = [*([own] if own else []), *(e for e in state.library.environments if e is not own)]
    note = f"mean of {len(drafts)} generations"
    if making.failures:
        note += f"; {len(making.failures)} more failed ({making.failures[0]})"
    made = provenance_of(state, making, cfg, note=note, samples=len(drafts))
    return ensemble.combine(
        making.task,
        drafts,
        lambda one, other: same_region(one, other, known),
        lambda name: compose.phrases_of(name, cfg),
        made,
    )


def _kept(state: State, kept: Kept, cfg: Config) -> Iterator[Told]:
    """An own prior is published; another's answers the task it was waited for, or replaces its parent."""
    if (prior := kept.prior) is None:
        return
    prior, making = copied(prior), state.making.get(kept.question)
    if making is not None and making.working and prior.provenance.made_by == state.instance:
        yield from answer(state, making, prior, cfg)
        return
    remember(state, prior, cfg)
    asked = asked_about(prior)
    if making is not None and not making.working:
        del state.making[kept.question]
        put(state.answers, asked, prior.digest(), cfg.remembered_priors)
    elif prior.provenance.parent_digest and state.answers.get(asked) == prior.provenance.parent_digest:
        state.answers[asked] = prior.digest()


def _received(state: State, prior: Prior) -> Iterator[Told]:
    """A prior of another gateway is checked and kept; what a library says every gateway can say itself."""
    if prior.digest() not in state.priors and prior.provenance.question:
        yield Keep(prior=copied(prior), question=prior.provenance.question)
