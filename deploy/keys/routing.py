"""A router that reaches beyond its host, made from the keys in force."""

from collections.abc import Sequence

import psutil

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.keys.access import access_control
from prior_sg.services.runtime.endpoints import KEYS_NEEDED
from prior_sg.services.runtime.keys import Beyond, bundle_in_force

LOOPBACK = ("127.0.0.1", "::1")


def beyond_this_host(listen: Sequence[str], join: Sequence[str], thin_bps: float = 0) -> Beyond | None:
    """How the router reaches others, over links of `thin_bps` bits per second (0 = fast ones); None where it is to
    reach nobody. Raises UserError, BusError.
    """
    if not (listen or join):
        if thin_bps:
            raise UserError("--thin-link is of links to other hosts; name them with --listen or --join")
        return None
    bundle = bundle_in_force()
    if bundle is None:
        raise UserError(f"a router that others reach takes those with keys only; {KEYS_NEEDED}")
    if bundle.own.revoked:
        raise UserError(f"the keys of {bundle.own.name} are revoked; `prior-sg keys add` gives new ones")
    access = access_control(bundle.about.participants, _loopback_interfaces())
    return Beyond(bundle=bundle, access=access, listen=tuple(listen), join=tuple(join), thin_bps=thin_bps)


def _loopback_interfaces() -> list[str]:
    """Names of the interfaces by which processes of this host talk to each other."""
    found = psutil.net_if_addrs().items()
    return sorted(name for name, addresses in found if any(one.address in LOOPBACK for one in addresses))
