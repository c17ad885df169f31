"""Reads tasks, writes the prior graph for each.

A task is looked up in the archive. What is not there the library answers at once, or a model over many turns; before a
model is asked, the gateways of the fleet agree on one that does it (`sharing`). Whatever fails ends in a prior that
says so, or in a reason. Everything slow or outside is an errand: this module only decides.
"""

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
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
    PriorList,
    PriorRequest,
    PriorRevision,
    Provenance,
    Recall,
    Recalled,
    Task,
)
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PRIOR, PRIOR_CLAIM, PRIOR_EVIDENCE, PRIOR_REVISION, PRIORS, TASK
from prior_sg.services.prior_gateway.core import compose, ensemble, learning, turns
from prior_sg.services.prior_gateway.core.claims import Claims
from prior_sg.services.prior_gateway.core.matching import match_environment, same_region
from prior_sg.services.prior_gateway.outside import archive, endpoint, library, prompts
from prior_sg.services.runtime.service import Ask, Errand, Identity, Output, Service

TICK_S = 0.5
ASK_MODEL = Errand("ASK_MODEL", ModelRequest, ModelReply, endpoint.open_endpoint)
RECALL = Errand("RECALL_PRIOR", Recall, Recalled, archive.open_recall)
KEEP = Errand("KEEP_PRIOR", Keep, Kept, archive.open_keep)

Asked = tuple[str, str, tuple[str, ...]]  # environment, task, fixed regions


@dataclass
class Talk:
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
    talks: dict[str, Talk] = field(default_factory=dict)
    drafts: dict[str, Any] = field(default_factory=dict)  # by conversation
    failures: list[str] = field(default_factory=list)


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
    begun: int = 0  # rounds of conversations so far, for their names


def init(cfg: compose.Config, identity: Identity) -> State:
    """Load library and prompts. Raises ServiceError."""
    return State(identity.instance, library.load(), prompts.load(cfg.prompts))


def step(state: State, message: Message, cfg: compose.Config) -> Iterator[Output]:
    """One input. The same task gives the same prior again, for robots that come late."""
    match message:
        case Task():
            yield from _begin(state, Making(message, compose.question_of(message, cfg, state.prompts.version)))
        case PriorRevision():
            yield from _begin_revision(state, message)
        case Recalled():
            yield from _recalled(state, message, cfg)
        case PriorClaim():
            yield from _hear(state, message)
        case Tick():
            yield from _tick(state, cfg)
        case ModelReply():
            yield from _replied(state, message, cfg)
        case Prior():
            yield from _received(state, message)
        case Kept():
            yield from _kept(state, message, cfg)
        case PriorEvidence():
            yield from _learn(state, message, cfg)


def answer(state: State, request: PriorRequest, cfg: compose.Config) -> PriorList:
    """The prior of a digest, else of a task; of a task that nobody has given yet, what the library would say."""
    if request.digest:
        if prior := state.priors.get(request.digest):
            return PriorList(priors=[prior])
        return PriorList(priors=[], reason=f"No prior with the digest {request.digest} is known here.")
    asked = (request.environment, request.task, tuple(request.regions))
    under_way = any(_asked(making.task) == asked for making in state.making.values())
    if reason := state.refused.get(asked):
        return PriorList(priors=[], reason=reason, pending=under_way)
    if digest := state.answers.get(asked):
        return PriorList(priors=[state.priors[digest]], pending=under_way)
    if under_way:
        return PriorList(priors=[], reason=f"{cfg.maker} is being asked for a prior.", pending=True)
    if cfg.provider != "library":
        return PriorList(priors=[], reason="A prior is made when a robot is given the task.", pending=True)
    try:
        return PriorList(priors=[state.library.answer(_task(*asked), cfg)])
    except compose.NoPrior as reason:
        return PriorList(priors=[], reason=str(reason), pending=True)


def _task(environment: str, task: str, regions: tuple[str, ...] | list[str]) -> Task:
    return Task(robot="", stamp_ns=0, environment=environment, task=task, regions=list(regions))


def _asked(of: Task | PriorRevision) -> Asked:
    return of.environment, of.task, tuple(of.regions)


def _asked_of(of: Prior | PriorEvidence) -> Asked:
    return of.environment, of.task, tuple(of.vocabulary)


def _begin(state: State, making: Making) -> Iterator[Output]:
    """Look into the archive first; it may hold an imported or revised prior."""
    if making.question in state.making:
        return
    task = making.task
    state.making[making.question] = making
    yield Ask(
        RECALL, Recall(question=making.question, environment=task.environment, task=task.task, regions=task.regions)
    )


def _begin_revision(state: State, revision: PriorRevision) -> Iterator[Output]:
    asked = _asked(revision)
    name = f"revision/{state.answers.get(asked, '')}/{asked}/{revision.by_model}"
    question = blake2b(name.encode(), digest_size=16).hexdigest()
    yield from _begin(state, Making(_task(*asked), question, revision))


def _recalled(state: State, recalled: Recalled, cfg: compose.Config) -> Iterator[Output]:
    """What the archive knows decides how to go on."""
    making = state.making.get(recalled.question)
    if making is None:
        return
    making.recalled, asked = recalled, _asked(making.task)
    if recalled.root is not None:
        state.roots.setdefault(asked, copied(recalled.root))
    known = state.evidence.setdefault(asked, {})
    for seen in recalled.evidence:
        known.setdefault((seen.robot, seen.epoch), copied(seen))
    found = recalled.preferred or recalled.exact or _of_question(state, recalled.question)
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


def _of_question(state: State, question: str) -> Prior | None:
    return next((prior for prior in state.priors.values() if prior.provenance.question == question), None)


def _answer(state: State, making: Making, prior: Prior, cfg: compose.Config) -> Iterator[Output]:
    """The task has its prior."""
    state.making.pop(making.question, None)
    asked = _asked(making.task)
    state.refused.pop(asked, None)
    _remember(state, prior, cfg)
    _put(state.answers, asked, prior.digest(), cfg.remembered_priors)
    yield PRIOR, prior


def _answer_by_library(state: State, making: Making, cfg: compose.Config, remark: str = "") -> Iterator[Output]:
    try:
        prior = compose.noted(
            state.library.answer(making.task, cfg), f"{remark}: this is the library's" if remark else ""
        )
    except compose.NoPrior as reason:
        state.making.pop(making.question, None)
        _put(state.refused, _asked(making.task), ". ".join(filter(None, (remark, str(reason)))), cfg.remembered_priors)
        return
    yield from _answer(state, making, prior, cfg)


def _claim(state: State, making: Making, gave_up: bool = False) -> Output:
    said: Literal["gave up", "works", "wants"] = "gave up" if gave_up else "works" if making.working else "wants"
    return PRIOR_CLAIM, PriorClaim(question=making.question, holder=state.instance, state=said)


def _hear(state: State, claim: PriorClaim) -> Iterator[Output]:
    """Another gateway wants to ask a model; whoever has the prior already publishes it once more."""
    if claim.holder == state.instance:
        return
    state.claims.hear(claim)
    if claim.state == "wants" and (prior := _of_question(state, claim.question)) is not None:
        yield PRIOR, prior


def _tick(state: State, cfg: compose.Config) -> Iterator[Output]:
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


def _work(state: State, making: Making, cfg: compose.Config) -> Iterator[Output]:
    """Begin the conversations, or count."""
    state.begun += 1
    if making.revision is not None:
        yield from _revise(state, making, cfg)
        return
    for sample in range(cfg.synthesis.samples):
        dialogue = turns.synthesise(making.task, state.prompts, cfg.synthesis)
        yield from _start(state, making, dialogue, sample, cfg)


def _start(
    state: State, making: Making, dialogue: Generator[turns.Turn, str, Any], sample: int, cfg: compose.Config
) -> Iterator[Output]:
    name = f"{making.question[:12]}/{state.begun}/{sample}"
    making.talks[name] = Talk(dialogue)
    yield _say(name, making.talks[name], next(dialogue), cfg)


def _say(name: str, talk: Talk, turn: turns.Turn, cfg: compose.Config) -> Ask:
    request = ModelRequest(
        conversation=name,
        turn=talk.turn,
        messages=list(turn.messages),
        schema=msgspec.json.encode(turn.schema).decode() if turn.schema else "",
        schema_name=turn.name,
        max_tokens=cfg.synthesis.max_tokens,
    )
    return Ask(ASK_MODEL, request)


def _replied(state: State, reply: ModelReply, cfg: compose.Config) -> Iterator[Output]:
    """The next turn of a conversation, or its end; after the last one, the prior."""
    making = next((making for making in state.making.values() if reply.conversation in making.talks), None)
    if making is None or making.talks[reply.conversation].turn != reply.turn:
        return
    talk = making.talks[reply.conversation]
    try:
        if reply.failure:
            raise turns.Unusable(reply.reason)
        turn = talk.dialogue.send(reply.text)
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


def _conclude(state: State, making: Making, cfg: compose.Config) -> Iterator[Output]:
    """All conversations have ended: the mean of what they brought, or what there is instead."""
    drafts = [making.drafts[name] for name in sorted(making.drafts)]
    if not drafts:
        yield from _give_up(state, making, making.failures[0], cfg)
        return
    if making.revision is not None:
        _, prior = _current(state, making, cfg)
        made = _provenance(
            state, making, cfg, parent_digest=prior.digest(), note="revised by the model from what was observed"
        )
        yield _keep(making, learning.corrected(prior, drafts[0], made), state)
        return
    try:
        yield _keep(making, _combined(state, making, drafts, cfg), state)
    except ValueError as error:  # the mean of valid generations can be too large to be a prior
        yield from _give_up(state, making, f"its prior cannot be used: {error}", cfg)


def _combined(state: State, making: Making, drafts: list[turns.Draft], cfg: compose.Config) -> Prior:
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


def _provenance(state: State, making: Making, cfg: compose.Config, **fields: Any) -> Provenance:
    """Who makes this prior from what; `fields` say the rest."""
    asked = {"source": cfg.maker, "detail": f"{cfg.provider} {cfg.base_url}".strip(), "prompts": state.prompts.version}
    return Provenance(**(asked | {"question": making.question} | fields))


def _keep(making: Making, prior: Prior, state: State) -> Ask:
    """Before it is published, a prior is dated, signed and safe on disk."""
    revised = making.revision is not None
    root = state.roots.get(_asked(making.task)) if revised else None
    return Ask(KEEP, Keep(prior=prior, question=making.question, own=True, preferred=revised, root=root))


def _kept(state: State, kept: Kept, cfg: compose.Config) -> Iterator[Output]:
    """An own prior is published; another's answers the task it was waited for, or replaces its parent."""
    if (prior := kept.prior) is None:
        return
    prior, making = copied(prior), state.making.get(kept.question)
    if making is not None and making.working and prior.provenance.made_by == state.instance:
        yield from _answer(state, making, prior, cfg)
        return
    _remember(state, prior, cfg)
    asked = _asked_of(prior)
    if making is not None and not making.working:
        del state.making[kept.question]
        _put(state.answers, asked, prior.digest(), cfg.remembered_priors)
    elif prior.provenance.parent_digest and state.answers.get(asked) == prior.provenance.parent_digest:
        state.answers[asked] = prior.digest()


def _received(state: State, prior: Prior) -> Iterator[Output]:
    """A prior of another gateway is checked and kept; what a library says every gateway can say itself."""
    if prior.digest() not in state.priors and prior.provenance.question:
        yield Ask(KEEP, Keep(prior=copied(prior), question=prior.provenance.question))


def _give_up(state: State, making: Making, reason: str, cfg: compose.Config) -> Iterator[Output]:
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


def _learn(state: State, seen: PriorEvidence, cfg: compose.Config) -> Iterator[Output]:
    """Keep what a map has shown; only where the settings allow it, that alone revises the prior."""
    asked = _asked_of(seen)
    known = state.evidence.setdefault(asked, {})
    _put(known, (seen.robot, seen.epoch), copied(seen), cfg.learning.kept_maps)
    yield Ask(KEEP, Keep(evidence=seen))
    digest = state.answers.get(asked)
    if not cfg.learning.automatic or digest is None or len(known) < cfg.learning.least_maps:
        return
    current = state.priors[digest]
    root = state.roots.get(asked, current)
    after = learning.revised(root, learning.totals(root, known.values()), cfg.learning.strength, current.provenance)
    if learning.largest_change(current, after) >= cfg.learning.least_change:
        environment, task, regions = asked
        yield from _begin_revision(state, PriorRevision(environment=environment, task=task, regions=list(regions)))


def _current(state: State, making: Making, cfg: compose.Config) -> tuple[Prior, Prior]:
    """The prior before any revision, and the one in force. Raises NoPrior."""
    asked, recalled = _asked(making.task), making.recalled
    current = state.priors.get(state.answers.get(asked, ""))
    if current is None and recalled is not None:
        current = recalled.preferred or recalled.newest
    if current is None:
        current = state.library.answer(making.task, cfg)
    root = state.roots.setdefault(asked, copied(current))
    return root, current


def _revise(state: State, making: Making, cfg: compose.Config) -> Iterator[Output]:
    """Count, or ask the model about the largest disagreements."""
    assert making.revision is not None
    try:
        root, current = _current(state, making, cfg)
    except compose.NoPrior:
        yield from _give_up(state, making, "there is no prior to revise", cfg)
        return
    seen = learning.totals(root, state.evidence.get(_asked(making.task), {}).values())
    if not seen.maps:
        yield from _give_up(state, making, "nothing has been observed", cfg)
        return
    if not making.revision.by_model:
        note = (
            f"revised by counting in {seen.maps} map{'s' if seen.maps != 1 else ''}, strength {cfg.learning.strength:g}"
        )
        before = root.provenance
        made = _provenance(
            state, making, cfg, note=note, parent_digest=current.digest(), source=before.source, detail=before.detail
        )
        yield _keep(making, learning.revised(root, seen, cfg.learning.strength, made), state)
        return
    lines, form = learning.told(learning.disagreements(current, seen, cfg.learning.told))
    if cfg.provider == "library" or not form:
        yield from _give_up(state, making, "there is no model, or nothing to disagree about", cfg)
        return
    talk = turns.Talk(state.prompts, cfg.synthesis)
    yield from _start(state, making, turns.revise(current, lines, form, talk), 0, cfg)


def _remember(state: State, prior: Prior, cfg: compose.Config) -> None:
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


def _put(memory: dict, key: object, value: object, most: int) -> None:
    memory.pop(key, None)
    memory[key] = value
    while len(memory) > most:
        del memory[next(iter(memory))]


SERVICE = Service(
    "prior_gateway",
    purpose="Answers a task with a prior graph: expected regions, objects and how they lie.",
    scope="fleet",
    config=compose.Config,
    init=init,
    step=step,
    reads=(TASK, PRIOR, PRIOR_CLAIM, PRIOR_EVIDENCE, PRIOR_REVISION),
    writes=(PRIOR, PRIOR_CLAIM),
    answers={PRIORS: answer},
    errands=(ASK_MODEL, RECALL, KEEP),
    tick_s=TICK_S,
    replay_config=lambda cfg: msgspec.structs.replace(cfg, archive="", signing_key="", trusted_keys=""),
)
