"""How a gateway comes to the prior of a task (pure).

A task is looked up in the archive. What is not there the library answers at once, or a model over many turns; before a
model is asked, the gateways of the fleet agree on one that does it (`claims`). Whatever fails ends in a prior that says
so, or in a reason. Everything slow or outside is an errand: this module only decides.
"""

from collections.abc import Generator, Iterator
from hashlib import blake2b
from typing import Any, Literal

import msgspec

from prior_sg.schemas.codec import Message, copied
from prior_sg.schemas.priors import (
    Keep,
    Kept,
    ModelReply,
    ModelRequest,
    Prior,
    PriorClaim,
    PriorEvidence,
    PriorRevision,
    Provenance,
    Recall,
    Recalled,
    Task,
    fault_of_task,
)
from prior_sg.schemas.status import Tick
from prior_sg.services.prior_gateway.core import compose, ensemble, learning, revising, turns
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.estimation import Estimate
from prior_sg.services.prior_gateway.core.matching import match_environment, same_region
from prior_sg.services.prior_gateway.core.state import (
    Conversation,
    Making,
    State,
    asked_about,
    asked_for,
    prior_in_force,
    prior_of_question,
    put,
    remember,
    spent_today,
    task_of,
    too_dear,
)
from prior_sg.services.refusals import InputRefused

TICK_S = 0.5  # between two ticks
DAY_NS = 24 * 60 * 60 * 10**9

Told = Prior | PriorClaim | Keep | ModelRequest | Recall  # to the fleet, or for somebody outside to do


def update(state: State, message: Message, cfg: Config) -> Iterator[Told]:
    """One input. The same task gives the same prior again, for robots that come late. Raises InputRefused."""
    match message:
        case Task():
            if fault := message.fault():
                raise InputRefused(fault)
            yield from _begin(state, Making(message, compose.question_of(message, cfg, state.prompts.version)))
        case PriorRevision():
            if fault := fault_of_task(message.environment, message.task, message.regions):
                raise InputRefused(fault)
            yield from _begin_revision(state, message)
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
            yield from _learn(state, message, cfg)


def _begin(state: State, making: Making) -> Iterator[Told]:
    """Look into the archive first; it may hold an imported or revised prior."""
    if making.question in state.making:
        return
    task = making.task
    state.making[making.question] = making
    yield Recall(question=making.question, environment=task.environment, task=task.task, regions=task.regions)


def _begin_revision(state: State, revision: PriorRevision) -> Iterator[Told]:
    asked = asked_for(revision)
    name = f"revision/{state.answers.get(asked, '')}/{asked}/{revision.by_model}"
    question = blake2b(name.encode(), digest_size=16).hexdigest()
    yield from _begin(state, Making(task_of(*asked), question, revision))


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
        yield _claim(state, making)
    elif found is not None:
        yield from _answer(state, making, found, cfg)
    elif cfg.provider == "library":
        yield from _answer_by_library(state, making, cfg)
    else:
        making.waiting = True
        yield _claim(state, making)


def _answer(state: State, making: Making, prior: Prior, cfg: Config) -> Iterator[Told]:
    """The task has its prior."""
    state.making.pop(making.question, None)
    asked = asked_for(making.task)
    state.refused.pop(asked, None)
    remember(state, prior, cfg)
    put(state.answers, asked, prior.digest(), cfg.remembered_priors)
    yield prior


def _answer_by_library(state: State, making: Making, cfg: Config, remark: str = "") -> Iterator[Told]:
    try:
        prior = compose.noted(
            state.library.answer(making.task, cfg), f"{remark}: this is the library's" if remark else ""
        )
    except compose.NoPrior as reason:
        state.making.pop(making.question, None)
        told = ". ".join(filter(None, (remark, str(reason))))
        put(state.refused, asked_for(making.task), told, cfg.remembered_priors)
        return
    yield from _answer(state, making, prior, cfg)


def _claim(state: State, making: Making, gave_up: bool = False) -> PriorClaim:
    said: Literal["gave up", "works", "wants"] = "gave up" if gave_up else "works" if making.working else "wants"
    return PriorClaim(question=making.question, holder=state.instance, state=said)


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
            yield _claim(state, making)
            if making.working:
                yield from _work(state, making, cfg)
        elif making.working:
            yield _claim(state, making)


def _work(state: State, making: Making, cfg: Config) -> Iterator[Told]:
    """Begin the conversations, or count."""
    state.begun += 1
    if making.revision is not None:
        yield from _revise(state, making, cfg)
        return
    for sample in range(cfg.synthesis.samples):
        dialogue = turns.synthesise(making.task, state.prompts, cfg.synthesis)
        yield from _start(state, making, dialogue, sample, cfg)


def _start(
    state: State, making: Making, dialogue: Generator[turns.Turn, str, Any], sample: int, cfg: Config
) -> Iterator[Told]:
    name = f"{making.question[:12]}/{state.begun}/{sample}"
    making.talks[name] = Conversation(dialogue)
    yield _say(name, making.talks[name], next(dialogue), cfg)


def _say(name: str, talk: Conversation, turn: turns.Turn, cfg: Config) -> ModelRequest:
    return ModelRequest(
        conversation=name,
        turn=talk.turn,
        messages=list(turn.messages),
        schema=msgspec.json.encode(turn.schema).decode() if turn.schema else "",
        schema_name=turn.name,
        max_tokens=cfg.synthesis.max_tokens,
    )


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
        yield _say(reply.conversation, talk, turn, cfg)
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
        yield from _give_up(state, making, making.failures[0], cfg)
        return
    if making.revision is not None:
        yield from _conclude_revision(state, making, drafts[0], cfg)
        return
    try:
        yield _keep(making, _combined(state, making, drafts, cfg), state)
    except ValueError as error:  # the mean of valid generations can be too large to be a prior
        yield from _give_up(state, making, f"its prior cannot be used: {error}", cfg)


def _conclude_revision(state: State, making: Making, found: revising.Revision, cfg: Config) -> Iterator[Told]:
    """What the model has revised, as a statement that observations outvote as they do any prior's; regions that it
    added belong to the prior before any revision, too, so that maps revise them from now on."""
    root, current = prior_in_force(state, making, cfg)
    note = "revised by the model from what was observed"
    if found.additions:
        note += ", with " + " and ".join(
            f"{one.name} as a part of {one.splits}" if one.splits else f"{one.name} as a new region"
            for one in found.additions
        )

    def with_name(name: str) -> list[str]:
        return compose.phrases_of(name, cfg)

    made = _provenance(state, making, cfg, **_parents(state, making, root, current))
    made = msgspec.structs.replace(made, note="; ".join(filter(None, (note, found.remark))))
    stated = revising.applied(root, found, with_name, made)
    for addition in found.additions:
        root = revising.extended(root, addition, with_name)
    asked = asked_for(making.task)
    state.roots[asked] = root
    seen = learning.estimate(stated, state.evidence.get(asked, {}).values(), cfg.learning)
    yield _keep(making, learning.revised(stated, seen.totals, cfg.learning.strength, made, seen.looks), state)


def _parents(state: State, making: Making, root: Prior, current: Prior) -> dict[str, Any]:
    """Where a revised prior comes from, for its provenance."""
    robots = {seen.robot for seen in state.evidence.get(asked_for(making.task), {}).values()}
    return {"parent_digest": current.digest(), "root_digest": root.digest(), "contributors": sorted(robots)}


def _combined(state: State, making: Making, drafts: list[turns.Draft], cfg: Config) -> Prior:
    own = match_environment(making.task.environment, state.library.environments)
    known = [*([own] if own else []), *(e for e in state.library.environments if e is not own)]
    note = f"mean of {len(drafts)} generations"
    if making.failures:
        note += f"; {len(making.failures)} more failed ({making.failures[0]})"
    made = _provenance(state, making, cfg, note=note, samples=len(drafts))
    return ensemble.combine(
        making.task,
        drafts,
        lambda one, other: same_region(one, other, known),
        lambda name: compose.phrases_of(name, cfg),
        made,
    )


def _provenance(state: State, making: Making, cfg: Config, **fields: Any) -> Provenance:
    """Who makes this prior from what; `fields` say the rest."""
    asked = {"source": cfg.maker, "detail": f"{cfg.provider} {cfg.base_url}".strip(), "prompts": state.prompts.version}
    return Provenance(**(asked | {"question": making.question} | fields))


def _keep(making: Making, prior: Prior, state: State) -> Keep:
    """Before it is published, a prior is dated, signed and safe on disk."""
    revised = making.revision is not None
    root = state.roots.get(asked_for(making.task)) if revised else None
    return Keep(prior=prior, question=making.question, own=True, preferred=revised, root=root)


def _kept(state: State, kept: Kept, cfg: Config) -> Iterator[Told]:
    """An own prior is published; another's answers the task it was waited for, or replaces its parent."""
    if (prior := kept.prior) is None:
        return
    prior, making = copied(prior), state.making.get(kept.question)
    if making is not None and making.working and prior.provenance.made_by == state.instance:
        yield from _answer(state, making, prior, cfg)
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


def _give_up(state: State, making: Making, reason: str, cfg: Config) -> Iterator[Told]:
    """Say so to the others, and take the newest kept prior or the library's, which then says why."""
    yield _claim(state, making, gave_up=True)
    if making.revision is not None:
        del state.making[making.question]
        return
    remark = f"{cfg.model} gave no prior ({reason})"
    newest = making.recalled.newest if making.recalled else None
    if newest is None:
        yield from _answer_by_library(state, making, cfg, remark)
        return
    prior = compose.noted(copied(newest), f"{remark}: this is the newest one kept, of {newest.provenance.source}")
    bare = msgspec.structs.replace(prior.provenance, question="", signer="", signature="")
    yield from _answer(state, making, msgspec.structs.replace(prior, provenance=bare), cfg)


def _learn(state: State, seen: PriorEvidence, cfg: Config) -> Iterator[Told]:
    """Keep what a map has shown; only where the settings allow it, that alone revises the prior."""
    asked = asked_about(seen)
    known = state.evidence.setdefault(asked, {})
    put(known, (seen.robot, seen.epoch), copied(seen), cfg.learning.kept_maps)
    yield Keep(evidence=seen)
    digest = state.answers.get(asked)
    if not cfg.learning.automatic or digest is None or len(known) < cfg.learning.least_maps:
        return
    current = state.priors[digest]
    root, limits = state.roots.get(asked, current), cfg.learning
    seen_so_far = learning.estimate(root, known.values(), limits)
    after = learning.revised(root, seen_so_far.totals, limits.strength, current.provenance, seen_so_far.looks)
    if learning.largest_change(current, after) >= limits.least_change:
        environment, task, regions = asked
        by_model = limits.by_model and cfg.provider != "library" and not too_dear(state, environment, cfg)
        yield from _begin_revision(
            state, PriorRevision(environment=environment, task=task, regions=list(regions), by_model=by_model)
        )


def _revise(state: State, making: Making, cfg: Config) -> Iterator[Told]:
    """Count, or ask the model about the largest disagreements."""
    assert making.revision is not None
    try:
        root, current = prior_in_force(state, making, cfg)
    except compose.NoPrior:
        yield from _give_up(state, making, "there is no prior to revise", cfg)
        return
    known = state.evidence.get(asked_for(making.task), {})
    seen = learning.estimate(root, known.values(), cfg.learning)
    if not seen.totals.maps:
        yield from _give_up(state, making, "nothing has been observed", cfg)
        return
    if making.revision.by_model:
        yield from _ask_about(state, making, (root, current), seen, cfg)
        return
    robots = len({one.robot for one in known.values()})
    note = f"revised by counting in {counted(len(known), 'map')} of {counted(robots, 'robot')}"
    before = root.provenance
    made = _provenance(
        state,
        making,
        cfg,
        note=f"{note}, strength {cfg.learning.strength:g}",
        source=before.source,
        detail=before.detail,
        **_parents(state, making, root, current),
    )
    yield _keep(making, learning.revised(root, seen.totals, cfg.learning.strength, made, seen.looks), state)


def _ask_about(
    state: State, making: Making, priors: tuple[Prior, Prior], seen: Estimate, cfg: Config
) -> Iterator[Told]:
    """Show the model what was expected and what was observed, if it may still be asked today. `priors` are that before
    any revision and the one in force."""
    root, current = priors
    lines, form = learning.told(learning.disagreements(current, seen.totals, cfg.learning.told))
    strange = ("", []) if making.task.regions else learning.unexplained(root, seen)
    if cfg.provider == "library" or not (form or strange[0]):
        yield from _give_up(state, making, "there is no model, or nothing to disagree about", cfg)
        return
    if dear := too_dear(state, making.task.environment, cfg):
        yield from _give_up(state, making, dear, cfg)
        return
    talk = turns.Talk(state.prompts, cfg.synthesis)
    yield from _start(state, making, revising.revision(current, lines, form, strange, talk), 0, cfg)


def counted(number: int, what: str) -> str:
    """Such as "1 map" or "3 maps"."""
    return f"{number} {what}{'s' if number != 1 else ''}"
