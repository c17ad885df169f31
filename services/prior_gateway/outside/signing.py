"""Signatures of priors in files: Ed25519 over the digest, for priors that go from one fleet or laboratory to another.

Keys are PEM files as OpenSSL writes them (docs/priors.md). The signer's name is the stem of its key's file. Within a
fleet with keys, hosts sign what they publish (services/runtime/signatures.py), and such signatures count here, too.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from prior_sg.schemas.priors import Prior
from prior_sg.services.folders import expanded
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.runtime.service import ServiceError
from prior_sg.services.runtime.signatures import Signatures, signatures_in_force

if TYPE_CHECKING:  # it comes with the first key
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

PURPOSE = b"prior-sg prior "  # a signature of a prior is one of nothing else


class Signer:
    """Signs with one private key, if there is one, and checks against the trusted public keys and the fleet's list.

    Raises ServiceError for keys that cannot be used, BusError for a bundle that cannot.
    """

    def __init__(self, cfg: Config) -> None:
        self._fleet = signatures_in_force()
        self.required = cfg.require_signature or isinstance(self._fleet, Signatures)  # of what comes from elsewhere
        self.name, self._key = "", None
        if cfg.signing_key:
            path = expanded(cfg.signing_key)
            self.name, self._key = path.stem, _private(path)
        self._trusted: dict[str, Ed25519PublicKey] = {}
        if cfg.trusted_keys:
            folder = expanded(cfg.trusted_keys)
            if not folder.is_dir():
                raise ServiceError(f"prior_gateway.trusted_keys: {folder} is no folder")
            self._trusted = {path.stem: _public(path) for path in sorted(folder.glob("*.pub"))}
        if self._key is not None:
            self._trusted[self.name] = self._key.public_key()

    def sign(self, prior: Prior) -> Prior:
        """The prior with this key's signature; unchanged without a key."""
        if self._key is None:
            return prior
        signature = self._key.sign(PURPOSE + prior.digest().encode()).hex()
        provenance = msgspec.structs.replace(prior.provenance, signer=self.name, signature=signature)
        return msgspec.structs.replace(prior, provenance=provenance)

    def check(self, prior: Prior) -> tuple[bool, str]:
        """Whether the signature is good, and a sentence about it."""
        made = prior.provenance
        if not made.signature:
            return False, "not signed"
        if isinstance(self._fleet, Signatures) and made.signer not in self._trusted:
            fault = self._fleet.fault_of(prior)
            return not fault, fault or f"signed by {made.signer!r}, verified"
        key = self._trusted.get(made.signer)
        if key is None:
            return False, f"signed by {made.signer!r}, whose key is not among the trusted ones"
        from cryptography.exceptions import InvalidSignature

        try:
            key.verify(bytes.fromhex(made.signature), PURPOSE + prior.digest().encode())
        except (InvalidSignature, ValueError):
            return False, f"the signature is not {made.signer!r}'s: the prior was changed or forged"
        return True, f"signed by {made.signer!r}, verified"


def _private(path: Path) -> "Ed25519PrivateKey":
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise ServiceError(f"prior_gateway.signing_key: {path} cannot be read as an unencrypted PEM key") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise ServiceError(f"prior_gateway.signing_key: {path} is no Ed25519 key")
    return key


def _public(path: Path) -> "Ed25519PublicKey":
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    try:
        key = load_pem_public_key(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ServiceError(f"prior_gateway.trusted_keys: {path} cannot be read as a PEM public key") from error
    if not isinstance(key, Ed25519PublicKey):
        raise ServiceError(f"prior_gateway.trusted_keys: {path} is no Ed25519 key")
    return key
