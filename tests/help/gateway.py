"""The gateway's step with its errands run on the spot: what a host does, without a bus."""

import asyncio
from functools import partial

from prior_sg.schemas.priors import Prior, Recall, Recalled
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PRIOR
from prior_sg.services.prior_gateway import service
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity


class Gateway:
    """`found` overrides what the archive recalls; without it the archive of the config is used."""

    def __init__(self, cfg: Config, found: dict | None = None, instance: str = "g1") -> None:
        identity = Identity("*", instance, 1)
        errands = {errand: partial(self.do, errand.open(cfg, identity)) for errand in service.SERVICE.errands}
        self.cfg, self.found, self.published = cfg, found, []
        self.runner = Runner(service.SERVICE, cfg, identity, errands)
        self.state = self.runner.state

    def feed(self, *messages) -> list[Prior]:
        """Feed messages and everything that follows from them; the priors published."""
        published = self.runner.feed(*messages)
        self.published += published
        return [message for topic, message in published if topic is PRIOR]

    def do(self, errand, request):
        if isinstance(request, Recall) and self.found is not None:
            return Recalled(question=request.question, **self.found)
        return asyncio.run(errand(request))

    def settle(self) -> list[Prior]:
        """Enough ticks for a claim to be heard."""
        return self.feed(*[Tick(stamp_ns=n) for n in range(4)])
