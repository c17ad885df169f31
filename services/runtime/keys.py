"""What a participant carries: its certificate and key, the authority's certificate, and who else takes part.

A participant is a machine: a robot, an edge server, a console. It is known by the common name of its certificate, which
changes with every new certificate, so that an old one opens nothing.
"""

import os
import stat
from pathlib import Path
from typing import Any, Literal

import msgspec

from prior_sg.services.folders import expanded
from prior_sg.services.runtime.bus import BusError

VARIABLE = "PSG_KEYS"
Role = Literal["robot", "edge", "fleet", "viewer", "operator"]
CA_FILE, CERTIFICATE_FILE, KEY_FILE, ABOUT_FILE = "ca.pem", "cert.pem", "key.pem", "bundle.json"


class Participant(msgspec.Struct, frozen=True, kw_only=True):
    """Somebody with a certificate; `issue` counts its certificates from 1."""

    name: str
    role: Role
    issue: int
    until: str  # the day after which the certificate is not taken, as 2027-01-31
    revoked: bool = False
    public_key: str = ""  # compressed point of P-256 in hexadecimal; empty in older lists

    @property
    def common_name(self) -> str:
        """Of the certificate in force; `#` is in no name of a participant."""
        return f"{self.name}#{self.issue}"

    def state(self, today: str) -> Literal["takes part", "revoked", "expired"]:
        """On a day of UTC, as 2027-01-31."""
        if self.revoked:
            return "revoked"
        return "expired" if self.until < today else "takes part"


class About(msgspec.Struct, frozen=True, kw_only=True):
    """What bundle.json says: whose bundle it is, and everybody who takes part."""

    name: str
    participants: list[Participant]


class Bundle(msgspec.Struct, frozen=True, kw_only=True):
    """A participant's folder."""

    folder: Path
    about: About

    @property
    def own(self) -> Participant:
        """Whose bundle it is."""
        return next(one for one in self.about.participants if one.name == self.about.name)

    @property
    def robots(self) -> list[str]:
        """Those who take part."""
        return sorted(one.name for one in self.about.participants if one.role == "robot" and not one.revoked)

    def transport(self) -> dict[str, Any]:
        """Zenoh's settings of TLS. Only an edge's certificate lets it listen: who joins checks that."""
        key, certificate = str(self.folder / KEY_FILE), str(self.folder / CERTIFICATE_FILE)
        return {
            "root_ca_certificate": str(self.folder / CA_FILE),
            "enable_mtls": True,
            "verify_name_on_connect": False,  # edges move between addresses; the purpose in the certificate counts
            "close_link_on_expiration": True,
            "connect_private_key": key,
            "connect_certificate": certificate,
            "listen_private_key": key,
            "listen_certificate": certificate,
        }


class Beyond(msgspec.Struct, frozen=True, kw_only=True):
    """How a router reaches beyond its host: where it listens, which routers it joins, and who may do what."""

    bundle: Bundle
    access: dict[str, Any]  # Zenoh's access_control
    listen: tuple[str, ...] = ()
    join: tuple[str, ...] = ()
    thin_bps: float = 0  # bits per second that the link carries; 0 = more than is sent


def bundle_in_force() -> Bundle | None:
    """The bundle that this environment names; None where it names none. Raises BusError."""
    named = os.environ.get(VARIABLE, "")
    return read_bundle(expanded(named)) if named else None


def read_bundle(folder: Path) -> Bundle:
    """Raises BusError for a folder that is no bundle, or whose key others may read."""
    try:
        about = msgspec.json.decode((folder / ABOUT_FILE).read_bytes(), type=About)
        mode, *_ = [(folder / name).stat().st_mode for name in (KEY_FILE, CA_FILE, CERTIFICATE_FILE)]
    except (OSError, msgspec.DecodeError) as error:
        raise BusError(
            f"{folder} is no bundle of keys; name a folder that `prior-sg keys add` has made, with --keys or {VARIABLE}"
        ) from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise BusError(f"others may read {folder / KEY_FILE}; run `chmod 600 {folder / KEY_FILE}`")
    if not any(one.name == about.name for one in about.participants):
        raise BusError(f"{folder / ABOUT_FILE} does not name its own participant; copy the bundle again")
    return Bundle(folder=folder.resolve(), about=about)
