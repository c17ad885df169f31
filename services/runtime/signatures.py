"""Signatures of priors in a fleet: whoever publishes one signs it with its key, everybody checks it by the list in its
bundle. Without a bundle there is nothing to sign with and nothing to check by.

A signature is of ECDSA over P-256 and speaks of the prior's digest; its signer is the common name of a certificate, so
that what was replaced or revoked signs no longer. The key stands in the list of participants, which is read again when
the file has changed.
"""

import logging
import threading
from typing import TYPE_CHECKING

import msgspec

from prior_sg.schemas.codec import Message
from prior_sg.schemas.priors import Prior, PriorList
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.keys import ABOUT_FILE, KEY_FILE, Bundle, Participant, bundle_in_force, read_bundle

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

log = logging.getLogger(__name__)
PURPOSE = b"prior-sg prior of a fleet "  # a signature of a prior is one of nothing else
SIGNERS = ("edge", "operator")  # whose priors all others take
HOW = "docs/security.md says who may sign"


class Unsigned:
    """Where no keys are in force: nothing is signed, everything is taken."""

    def signed(self, message: Message) -> Message:
        """The message as it is."""
        return message

    def fault_of(self, message: Message) -> str:
        """Nothing speaks against it."""
        return ""


class Signatures(Unsigned):
    """Of one participant. Raises ExtraMissing, and BusError for a key that cannot be read. Used by any thread."""

    def __init__(self, bundle: Bundle) -> None:
        extras.require_modules(("cryptography",), "keys", "map")
        self._lock = threading.Lock()
        self._bundle, self._seen = bundle, _look_of(bundle)
        self._key = _private(bundle)

    def signed(self, message: Message) -> Message:
        """The message with this participant's signature where it is a prior or holds some; else as it is."""
        match message:
            case Prior():
                return self._signed(message)
            case PriorList():
                return msgspec.structs.replace(message, priors=[self._signed(prior) for prior in message.priors])
        return message

    def fault_of(self, message: Message) -> str:
        """Why a prior, or one of several, is not taken, as a sentence; empty where nothing speaks against it."""
        match message:
            case Prior():
                return self._fault_of(message)
            case PriorList():
                return next((fault for prior in message.priors if (fault := self._fault_of(prior))), "")
        return ""

    def _signed(self, prior: Prior) -> Prior:
        from cryptography.hazmat.primitives.asymmetric.ec import ECDSA
        from cryptography.hazmat.primitives.hashes import SHA256

        signature = self._key.sign(_statement(prior), ECDSA(SHA256())).hex()
        signer = self._bundle.own.common_name
        provenance = msgspec.structs.replace(prior.provenance, signer=signer, signature=signature)
        return msgspec.structs.replace(prior, provenance=provenance)

    def _fault_of(self, prior: Prior) -> str:
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ec import ECDSA, SECP256R1, EllipticCurvePublicKey
        from cryptography.hazmat.primitives.hashes import SHA256

        made = prior.provenance
        if not made.signature:
            return f"the prior is not signed; {HOW}"
        bundle = self._bundle_now()
        signer = next((one for one in bundle.about.participants if one.common_name == made.signer), None)
        if fault := _fault_of_signer(signer, made.signer, bundle.own):
            return fault
        assert signer is not None
        if not signer.public_key:
            return (
                f"the list of participants lacks the key of {signer.name}: on the authority's machine run "
                f"`prior-sg keys rotate {signer.name}` and copy the bundles"
            )
        try:
            key = EllipticCurvePublicKey.from_encoded_point(SECP256R1(), bytes.fromhex(signer.public_key))
            key.verify(bytes.fromhex(made.signature), _statement(prior), ECDSA(SHA256()))
        except (InvalidSignature, ValueError):
            return f"the signature is not {signer.name}'s: the prior was changed or forged"
        return ""

    def _bundle_now(self) -> Bundle:
        """With the list as it is on disk; the one before where that cannot be read."""
        with self._lock:
            if (look := _look_of(self._bundle)) != self._seen:
                self._seen = look
                try:
                    self._bundle = read_bundle(self._bundle.folder)
                except BusError as error:
                    log.warning("the list of participants cannot be read again; the one before holds: %s", error)
            return self._bundle


def signatures_in_force() -> Unsigned:
    """Those of the bundle that this environment names, if it names one. Raises BusError, ExtraMissing."""
    bundle = bundle_in_force()
    return Unsigned() if bundle is None else Signatures(bundle)


def _fault_of_signer(signer: Participant | None, name: str, own: Participant) -> str:
    if signer is None:
        return f"the prior is signed by {name!r}, a key that is not in the list of participants or was replaced; {HOW}"
    if signer.revoked:
        return f"the prior is signed by {signer.name}, whose keys are revoked"
    if signer.role not in SIGNERS and signer.name != own.name:
        return f"the prior is signed by {signer.name}, which is {signer.role} and makes none for others; {HOW}"
    return ""


def _statement(prior: Prior) -> bytes:
    return PURPOSE + prior.digest().encode()


def _look_of(bundle: Bundle) -> tuple[int, int, int]:
    """What changes when the list is written anew."""
    try:
        found = (bundle.folder / ABOUT_FILE).stat()
    except OSError:
        return 0, 0, 0
    return found.st_mtime_ns, found.st_size, found.st_ino


def _private(bundle: Bundle) -> "EllipticCurvePrivateKey":
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    path = bundle.folder / KEY_FILE
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise BusError(f"{path} cannot be read as a key; copy the bundle again") from error
    if not isinstance(key, EllipticCurvePrivateKey):
        raise BusError(f"{path} is no key that `prior-sg keys` has made; copy the bundle again")
    return key
