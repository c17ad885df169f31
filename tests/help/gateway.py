"""The gateway's step with its errands run on the spot: what a host does, without a bus."""

import asyncio

from prior_sg.schemas.priors import Keep, ModelRequest, Prior, Recall, Recalled
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PRIOR
from prior_sg.services.prior_gateway import service
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside.archive import open_keep, open_recall
from prior_sg.services.prior_gateway.outside.endpoint import open_endpoint
from prior_sg.services.runtime.service import Ask, Identity


class Gateway:
    """`found` overrides what the archive recalls; without it the archive of the config is used."""

    def __init__(self, cfg: Config, found: dict | None = None, instance: str = "g1") -> None:
        identity = Identity("*", instance, 1)
        self.cfg, self.found, self.published = cfg, found, []
        self.state = service.init(cfg, identity)
        self.errands = {
            ModelRequest: open_endpoint(cfg, identity),
            Recall: open_recall(cfg, identity),
            Keep: open_keep(cfg, identity),
        }

    def feed(self, *messages) -> list[Prior]:
        """Feed messages and everything that follows from them; the priors published."""
        queue, before = list(messages), len(self.published)
        while queue:
            for output in service.step(self.state, queue.pop(0), self.cfg):
                if isinstance(output, Ask):
                    queue.append(self.do(output.request))
                else:
                    self.published.append(output)
        return [message for topic, message in self.published[before:] if topic is PRIOR]

    def do(self, request):
        if isinstance(request, Recall) and self.found is not None:
            return Recalled(question=request.question, **self.found)
        return asyncio.run(self.errands[type(request)](request))

    def settle(self) -> list[Prior]:
        """Enough ticks for a claim to be heard."""
        return self.feed(*[Tick(stamp_ns=n) for n in range(4)])
