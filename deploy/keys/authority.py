"""A small certificate authority in a folder: it issues, replaces and revokes certificates of participants.

Certificates are of ECDSA over P-256. Only an edge's lets it listen for others. A bundle per participant lies in
`bundles/NAME`; the authority's own key, which needs to be on no other machine, in `ca.key`.
"""

import os
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from prior_sg.deploy.errors import UserError
from prior_sg.schemas.names import fault_of_robot
from prior_sg.services.errors import reason_of
from prior_sg.services.runtime.keys import ABOUT_FILE, CA_FILE, CERTIFICATE_FILE, KEY_FILE, About, Participant, Role

CA_KEY_FILE, LIST_FILE, BUNDLES = "ca.key", "participants.json", "bundles"
CA_DAYS, DAYS = 3650, 365
SKEW = timedelta(minutes=10)  # by which a participant's clock may be behind
LONGEST_NAME = 48  # characters; a common name has 64


class KeysError(UserError):
    """The authority cannot do what was asked; the message says what to do."""


class Authority:
    """The certificate authority in a folder. Raises KeysError unless `create` has made it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            self._certificate = x509.load_pem_x509_certificate((folder / CA_FILE).read_bytes())
            key = load_pem_private_key((folder / CA_KEY_FILE).read_bytes(), None)
            listed = msgspec.json.decode((folder / LIST_FILE).read_bytes(), type=list[Participant])
        except FileNotFoundError as error:
            raise KeysError(f"{folder} holds no keys yet; run `prior-sg keys init`") from error
        except (OSError, ValueError) as error:
            raise KeysError(
                f"the keys in {folder} cannot be read ({reason_of(error)}); restore them from a copy"
            ) from error
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        self._key = key
        self.participants = {one.name: one for one in listed}

    @classmethod
    def create(cls, folder: Path) -> "Authority":
        """A new authority. Raises KeysError where there is one."""
        if (folder / CA_KEY_FILE).exists():
            raise KeysError(f"{folder} holds keys already; choose another folder with --folder, or remove it first")
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _built("prior-sg authority", key, CA_DAYS)
        _write(folder / CA_KEY_FILE, _pem(key))
        _write(folder / CA_FILE, certificate.public_bytes(Encoding.PEM))
        _write(folder / LIST_FILE, b"[]")
        return cls(folder)

    def bundle(self, name: str) -> Path:
        """Where a participant's bundle lies."""
        return self.folder / BUNDLES / name

    def add(self, role: Role, name: str, days: int = DAYS) -> Participant:
        """Let somebody take part, also again after a revocation. Raises KeysError."""
        check_name(name)
        known = self.participants.get(name)
        if known is not None and not known.revoked:
            raise KeysError(
                f"{name} takes part already, as {known.role}; run `prior-sg keys rotate {name}` for a new key"
            )
        return self._issue(name, role, 1 if known is None else known.issue + 1, days)

    def rotate(self, name: str, days: int = DAYS) -> Participant:
        """Another key and certificate; routers that know of it take the one before no more. Raises KeysError."""
        known = self._known(name)
        return self._issue(name, known.role, known.issue + 1, days)

    def revoke(self, name: str) -> Participant:
        """Let somebody take part no longer, as soon as routers know of it. Raises KeysError."""
        revoked = msgspec.structs.replace(self._known(name), revoked=True)
        self._note(revoked)
        return revoked

    def _known(self, name: str) -> Participant:
        known = self.participants.get(name)
        if known is None or known.revoked:
            there = ", ".join(one.name for one in self.participants.values() if not one.revoked) or "nobody"
            raise KeysError(f"{name} does not take part; those who do: {there}")
        return known

    def _issue(self, name: str, role: Role, issue: int, days: int) -> Participant:
        until = (datetime.now(UTC) + timedelta(days=days)).date().isoformat()
        key = ec.generate_private_key(ec.SECP256R1())
        participant = Participant(name=name, role=role, issue=issue, until=until, public_key=_point(key.public_key()))
        certificate = _built(
            participant.common_name, key, days, role=role, issuer=self._certificate.subject, issuer_key=self._key
        )
        folder = self.bundle(name)
        _write(folder / KEY_FILE, _pem(key))
        _write(folder / CERTIFICATE_FILE, certificate.public_bytes(Encoding.PEM))
        _write(folder / CA_FILE, self._certificate.public_bytes(Encoding.PEM))
        self._note(participant)
        return participant

    def _note(self, participant: Participant) -> None:
        """Remember, and tell every bundle."""
        self.participants[participant.name] = participant
        self.participants = {name: self._with_key(one) for name, one in self.participants.items()}
        everybody = list(self.participants.values())
        _write(self.folder / LIST_FILE, _json(everybody))
        for one in everybody:
            _write(self.bundle(one.name) / ABOUT_FILE, _json(About(name=one.name, participants=everybody)))

    def _with_key(self, one: Participant) -> Participant:
        """With the public key of its certificate, which older lists lack; without where its bundle is not here."""
        path = self.bundle(one.name) / CERTIFICATE_FILE
        if one.public_key or not path.exists():
            return one
        public = x509.load_pem_x509_certificate(path.read_bytes()).public_key()
        assert isinstance(public, ec.EllipticCurvePublicKey)
        return msgspec.structs.replace(one, public_key=_point(public))


def check_name(name: str) -> None:
    """Raise KeysError unless a participant, of whatever role, can be called so."""
    if fault := fault_of_robot(name):
        raise KeysError(fault.replace("robot's name", "name"))
    if len(name) > LONGEST_NAME or name.startswith("."):
        raise KeysError(f"the name {name!r} is too long or begins with a dot; take at most {LONGEST_NAME} letters")


def _built(
    common_name: str,
    key: ec.EllipticCurvePrivateKey,
    days: int,
    *,
    role: Role | None = None,
    issuer: x509.Name | None = None,
    issuer_key: ec.EllipticCurvePrivateKey | None = None,
) -> x509.Certificate:
    """A certificate; without an issuer it is the authority's own."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer or subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(issuer is None, 0 if issuer is None else None), critical=True)
    )
    if role is not None:
        builder = builder.add_extension(x509.ExtendedKeyUsage(_purposes(role)), critical=False)
        builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName("prior-sg.invalid")]), critical=False)
    return builder.sign(issuer_key or key, hashes.SHA256())


def _purposes(role: Role) -> Iterable[x509.ObjectIdentifier]:
    client = [ExtendedKeyUsageOID.CLIENT_AUTH]
    return [*client, ExtendedKeyUsageOID.SERVER_AUTH] if role == "edge" else client


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _point(public: ec.EllipticCurvePublicKey) -> str:
    return public.public_bytes(Encoding.X962, PublicFormat.CompressedPoint).hex()


def _json(value: object) -> bytes:
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


def _write(path: Path, data: bytes) -> None:
    """For this user's eyes only, and whole or not at all. Raises KeysError."""
    beside = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        beside.unlink(missing_ok=True)
        with os.fdopen(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(data)
        beside.replace(path)
    except OSError as error:
        raise KeysError(f"cannot write {path} ({error.strerror}); choose another folder with --folder") from error
