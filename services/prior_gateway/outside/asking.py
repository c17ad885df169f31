"""Whom the gateway asks: the configured model, or nobody. What speaks HTTP comes with a model only (5 MB)."""

from collections.abc import Awaitable, Callable

from prior_sg.schemas.priors import ModelReply, ModelRequest
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.runtime.service import Identity


def open_endpoint(cfg: Config, identity: Identity) -> Callable[[ModelRequest], Awaitable[ModelReply]]:
    """The errand that asks the configured model. Raises ServiceError when its key is missing."""
    if cfg.provider == "library":

        async def nobody(request: ModelRequest) -> ModelReply:
            return ModelReply(
                conversation=request.conversation, turn=request.turn, failure="none", reason="no model is configured"
            )

        return nobody
    from prior_sg.services.prior_gateway.outside.endpoint import Endpoint, read_key

    return Endpoint(cfg, read_key(cfg)).ask
