"""Reads tasks, writes the prior graph for each."""

from collections.abc import Iterator

import msgspec

from prior_sg.schemas.codec import Message
from prior_sg.schemas.priors import (
    Keep,
    Kept,
    ModelReply,
    ModelRequest,
    Prior,
    PriorClaim,
    PriorList,
    PriorRequest,
    Recall,
    Recalled,
)
from prior_sg.schemas.topics import PRIOR, PRIOR_CLAIM, PRIOR_EVIDENCE, PRIOR_REVISION, PRIORS, TASK
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.state import State, known_prior
from prior_sg.services.prior_gateway.core.update import TICK_S, update
from prior_sg.services.prior_gateway.outside import archive, asking, library, prompts
from prior_sg.services.runtime.service import Ask, Errand, Identity, Output, Service

ASK_MODEL = Errand("ASK_MODEL", ModelRequest, ModelReply, asking.open_endpoint)
RECALL = Errand("RECALL_PRIOR", Recall, Recalled, archive.open_recall)
KEEP = Errand("KEEP_PRIOR", Keep, Kept, archive.open_keep)
ERRANDS = {ModelRequest: ASK_MODEL, Recall: RECALL, Keep: KEEP}
PUBLISHED = {Prior: PRIOR, PriorClaim: PRIOR_CLAIM}


def init(cfg: Config, identity: Identity) -> State:
    """Load library and prompts. Raises ServiceError."""
    return State(identity.instance, library.load(), prompts.load(cfg.prompts))


def step(state: State, message: Message, cfg: Config) -> Iterator[Output]:
    """One input. The same task gives the same prior again, for robots that come late."""
    for output in update(state, message, cfg):
        topic = PUBLISHED.get(type(output))
        yield (topic, output) if topic is not None else Ask(ERRANDS[type(output)], output)


def answer(state: State, request: PriorRequest, cfg: Config) -> PriorList:
    """The prior of a digest, else of a task; of a task that nobody has given yet, what the library would say."""
    return known_prior(state, request, cfg)


SERVICE = Service(
    "prior_gateway",
    purpose="Answers a task with a prior graph: expected regions, objects and how they lie.",
    scope="fleet",
    config=Config,
    init=init,
    step=step,
    reads=(TASK, PRIOR, PRIOR_CLAIM, PRIOR_EVIDENCE, PRIOR_REVISION),
    writes=(PRIOR, PRIOR_CLAIM),
    answers={PRIORS: answer},
    errands=(ASK_MODEL, RECALL, KEEP),
    tick_s=TICK_S,
    replay_config=lambda cfg: msgspec.structs.replace(cfg, archive="", signing_key="", trusted_keys=""),
    beside=True,
)
