"""Signatures of priors: Ed25519 over the digest, so that a fleet can tell who made a prior.

Keys are PEM files as OpenSSL writes them (docs/operations.md). The signer's name is the stem of its key's file.
"""

from pathlib import Path

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key, load_pem_public_key

from prior_sg.schemas.priors import Prior
from prior_sg.services.folders import expanded
from prior_sg.services.runtime.service import ServiceError

PURPOSE = b"prior-sg prior "  # a signature of a prior is one of nothing else


class Signer:
    """Signs with one private key, if there is one, and checks against the trusted public keys."""

    def __init__(self, key_file: str, trusted_folder: str) -> None:
        self.name, self._key = "", None
        if key_file:
            path = expanded(key_file)
            self.name, self._key = path.stem, _private(path)
        self._trusted: dict[str, Ed25519PublicKey] = {}
        if trusted_folder:
            folder = expanded(trusted_folder)
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
        key = self._trusted.get(made.signer)
        if key is None:
            return False, f"signed by {made.signer!r}, whose key is not among the trusted ones"
        try:
            key.verify(bytes.fromhex(made.signature), PURPOSE + prior.digest().encode())
        except (InvalidSignature, ValueError):
            return False, f"the signature is not {made.signer!r}'s: the prior was changed or forged"
        return True, f"signed by {made.signer!r}, verified"


def _private(path: Path) -> Ed25519PrivateKey:
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise ServiceError(f"prior_gateway.signing_key: {path} cannot be read as an unencrypted PEM key") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise ServiceError(f"prior_gateway.signing_key: {path} is no Ed25519 key")
    return key


def _public(path: Path) -> Ed25519PublicKey:
    try:
        key = load_pem_public_key(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ServiceError(f"prior_gateway.trusted_keys: {path} cannot be read as a PEM public key") from error
    if not isinstance(key, Ed25519PublicKey):
        raise ServiceError(f"prior_gateway.trusted_keys: {path} is no Ed25519 key")
    return key
