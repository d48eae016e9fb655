"""Signatures of messages: by a peer's certificate, or its user's console key.

The session id on a sample is chosen by its publisher, so it is a hint. Under ``sig`` a message carries the leaf
certificate and a signature over the canonical JSON of the message without ``sig`` and of the signature's own
fields. A certificate's common name speaks for the peer id that equals it, or starts with it and ``__``.

Without certificates a console signs what moves real hardware, commands and input frames, with a key in the state
directory of its user, made at its first motion. Robots of the same user find that key there; robots of other machines
trust the keys in ``STRANDS_MESH_CONSOLE_PUBLIC_KEYS`` and the enrolled ones.
"""

from __future__ import annotations

import base64
import binascii
import datetime
import hashlib
import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.certificates import cryptography
from strands_robots.errors import StrandsRobotsError
from strands_robots.mesh import wire
from strands_robots.mesh.transport.config import Posture, TlsCredentials
from strands_robots.moved import of_module
from strands_robots.rate_limits import RecentKeys
from strands_robots.safety import ed25519
from strands_robots.safety.identity import (
    PUBLIC_KEYS,
    SigningIdentity,
    console_key,
    enrolled_consoles,
    kept_consoles,
    stated_consoles,
)
from strands_robots.utils import MissingExtraError, ValidationError, canonical_json, identifier, shown

if TYPE_CHECKING:
    from cryptography import x509

    from strands_robots.mesh.transport import Transport

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


logger = logging.getLogger(__name__)

CONSOLE = "console"
CONSOLE_FIELDS = frozenset({"v", "key", "t", "nonce", "sig"})
MOTION = "mesh-motion"
INPUT = "mesh-input"


class ConsoleSigner:
    """Signs with the key of this user's consoles, which is made when it is needed.

    Args:
        clock: wall-clock seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._identity: SigningIdentity | None = None
        self._path: Path | None = None

    def sign(self, body: Mapping[str, Any], purpose: str) -> dict[str, Any]:
        """Return ``body`` with its signature; as it is, and logged, without a key."""
        identity = self._load()
        if identity is None:
            return dict(body)
        head = {"v": VERSION, "key": identity.public_text, "t": self._clock(), "nonce": secrets.token_hex(16)}
        return {**body, CONSOLE: {**head, "sig": identity.sign(_covered(body, head, purpose))}}

    def _load(self) -> SigningIdentity | None:
        file = console_key()
        if file.path != self._path:
            self._identity, self._path = None, file.path
            try:
                self._identity = file.load_or_make()
            except (ValueError, OSError, MissingExtraError) as exc:
                logger.error("Motions of real hardware leave here without a signature: %s", exc)  # noqa: TRY400 - one sentence
        return self._identity


class ConsoleTrust:
    """Checks the signatures of consoles; thread-safe.

    Args:
        clock: wall-clock seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._keys: frozenset[bytes] = frozenset()
        self._stated: tuple[str, ...] = ()
        self._paths: tuple[Path, ...] = ()
        self._stamps: tuple[object, ...] = ()
        self._complaint = ""
        self._trusted()  # read now: the first command waits for no disk

    def refusal(self, body: Mapping[str, Any], purpose: str) -> str | None:
        """Return the reason why ``body`` is not signed by a trusted console, or None."""
        stated = body.get(CONSOLE)
        if not isinstance(stated, dict) or set(stated) != CONSOLE_FIELDS or stated["v"] != VERSION:
            return "it is not signed by a console"
        key, signature = ed25519.decode(stated["key"], 32), ed25519.decode(stated["sig"], 64)
        if key is None or signature is None or key not in self._trusted():
            return "the key of its console is not enrolled here"
        stamp = wire.finite(stated["t"])
        if stamp is None or not wire.fresh(stamp, self._clock()):
            return "its signature is not fresh"
        try:
            covered = _covered(body, {name: stated[name] for name in ("v", "key", "t", "nonce")}, purpose)
        except (ValueError, TypeError, RecursionError):
            return "it has no canonical form"
        return None if ed25519.signed_by_one_of([key], signature, covered) else "its signature does not fit"

    def _trusted(self) -> frozenset[bytes]:
        """Return the keys, read anew where a setting or a file has changed."""
        with self._lock:
            stated = settings.raw("STRANDS_STATE_DIR"), settings.raw(PUBLIC_KEYS)
            if stated != self._stated:
                self._stated, self._paths = stated, (console_key().path, enrolled_consoles().path)
            # Taken before the files are read: one that changes meanwhile is read once more.
            stamps = (stated, *map(_stamp, self._paths))
            if stamps != self._stamps:
                self._stamps, self._keys = stamps, self._read()
            return self._keys

    def _read(self) -> frozenset[bytes]:
        keys, complaint = stated_consoles(), ""
        try:
            keys |= kept_consoles()
        except (ValueError, OSError, MissingExtraError) as exc:
            complaint = str(exc)
        if complaint and complaint != self._complaint:
            logger.error("Keys of consoles are left out: %s", complaint)
        self._complaint = complaint
        return keys


def _stamp(path: Path) -> tuple[object, ...]:
    """Return what changes with a key file, its access and that of its folders."""
    facts: list[object] = []
    for each in (path, *path.parents[:3]):
        try:
            found = each.stat()
        except OSError:
            facts.append(None)
            continue
        facts.append((found.st_mode, found.st_uid))
        if each is path:
            facts.append((found.st_ino, found.st_ctime_ns, found.st_size))
    return tuple(facts)


def _covered(body: Mapping[str, Any], head: Mapping[str, Any], purpose: str) -> bytes:
    bare = {key: value for key, value in body.items() if key not in (CONSOLE, "sig")}
    return canonical_json({"body": bare, "head": dict(head), "purpose": purpose})


VERSION = 1
CERT_MAX_BYTES = 4096
SIG_MAX_BYTES = 2048
SALT_BYTES = 32
NONCE_S = 65.0
NONCES_MAX = 4096
FIELDS = frozenset({"v", "alg", "cert", "t", "nonce", "sig"})
ALGORITHMS = ("rsa-pss-sha256", "ecdsa-sha256", "ed25519")


class IdentityError(StrandsRobotsError, ValueError):
    """A signature that does not count; the message says why."""


@dataclass(frozen=True, slots=True)
class Verified:
    """The certificate that signed: its SHA-256 in hex and its common name."""

    cert_sha256: str
    common_name: str

    def speaks_for(self, peer_id: str) -> bool:
        return peer_id == self.common_name or peer_id.startswith(f"{self.common_name}__")


class Signer:
    """Signs the messages of this peer.

    Raises:
        ValueError: the files hold no certificate and matching private key of a kind in :data:`ALGORITHMS`.
    """

    def __init__(self, cert: Path, key: Path, clock: Callable[[], float] = time.time) -> None:
        x509, serialization = cryptography().x509, cryptography().serialization
        certificate = x509.load_pem_x509_certificate(cert.read_bytes())
        self._key: Any = serialization.load_pem_private_key(key.read_bytes(), None)
        if self._key.public_key() != certificate.public_key():
            raise ValueError(f"{key} is not the private key of {cert}.")
        self._der = certificate.public_bytes(serialization.Encoding.DER)
        if len(self._der) > CERT_MAX_BYTES:
            raise ValueError(f"{cert} is above {CERT_MAX_BYTES} bytes.")
        self._digest = hashlib.sha256(self._der).hexdigest()
        self._encoded = base64.b64encode(self._der).decode()
        self._algorithm = _algorithm_of(self._key.public_key())
        self._clock = clock
        self.common_name = _common_name(certificate)

    def sign(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``body`` with its ``sig``."""
        bare = {key: value for key, value in body.items() if key != "sig"}
        head = {"v": VERSION, "alg": self._algorithm, "t": self._clock(), "nonce": secrets.token_hex(16)}
        signature = self._key.sign(_signed_bytes(bare, head, self._digest), *_parameters(self._algorithm))
        encoded = base64.urlsafe_b64encode(signature).decode().rstrip("=")
        return {**bare, "sig": {**head, "cert": self._encoded, "sig": encoded}}


class Verifier:
    """Checks signed messages; every (certificate, nonce) counts once.

    Args:
        roots: PEM certificates that may issue a peer's certificate, directly.
        clock: wall-clock seconds, for the times on the wire and a certificate's validity.
        monotonic: seconds, by which used nonces age.
    """

    def __init__(
        self,
        roots: bytes,
        clock: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._roots: list[Any] = list(cryptography().x509.load_pem_x509_certificates(roots)) if roots.strip() else []
        self._clock = clock
        self._nonces = RecentKeys(NONCE_S, NONCES_MAX, monotonic)

    def verify(self, body: Mapping[str, Any]) -> Verified:
        """Return the certificate whose signature is on ``body``.

        Raises:
            IdentityError: the signature does not count; the message says why.
        """
        sig = _shape(body.get("sig"))
        if not self._roots:
            raise IdentityError("no root certificate is configured")
        der, signature = _decode(sig["cert"], CERT_MAX_BYTES), _decode(sig["sig"], SIG_MAX_BYTES, url=True)
        certificate = _parse(der)
        name = _common_name(certificate)
        self._issued(certificate)
        self._valid(certificate)
        stamp = wire.finite(sig["t"])
        if stamp is None or not wire.fresh(stamp, self._clock()):
            raise IdentityError("the signature is not fresh")
        public = certificate.public_key()
        if _algorithm_of(public) != sig["alg"]:
            raise IdentityError("the certificate's key does not fit the algorithm")
        digest = hashlib.sha256(der).hexdigest()
        bare = {key: value for key, value in body.items() if key != "sig"}
        head = {key: sig[key] for key in ("v", "alg", "t", "nonce")}
        try:
            covered = _signed_bytes(bare, head, digest)
        except (ValueError, TypeError, RecursionError):
            raise IdentityError("the message has no canonical form") from None
        try:
            public.verify(signature, covered, *_parameters(sig["alg"]))
        except cryptography().exceptions.InvalidSignature:
            raise IdentityError("the signature does not fit the message") from None
        if not self._nonces.first((digest, sig["nonce"])):
            raise IdentityError("the nonce was used before")
        return Verified(digest, name)

    def _issued(self, certificate: x509.Certificate) -> None:
        for root in self._roots:
            try:
                certificate.verify_directly_issued_by(root)
            except Exception as exc:  # noqa: BLE001 - each root refuses in its own way; the next one is tried
                logger.debug("Not issued by %s: %s", root.subject, exc)
            else:
                return
        raise IdentityError("no configured root issued the certificate")

    def _valid(self, certificate: x509.Certificate) -> None:
        now = datetime.datetime.fromtimestamp(self._clock(), datetime.UTC)
        if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
            raise IdentityError("the certificate is not valid now")


class Identity:
    """Signer and verifier of a peer; ``required``: only signed messages count."""

    def __init__(self, signer: Signer | None = None, verifier: Verifier | None = None, required: bool = False) -> None:
        self._signer = signer
        self._verifier = verifier
        self.checks = verifier is not None
        """True when there are roots to check a signature against."""
        self.required = required

    @classmethod
    def from_settings(cls, credentials: TlsCredentials | None) -> Identity:
        """The identity that the environment asks for; signed with certificates."""
        policy = signature_policy()
        signer, verifier = None, None
        if credentials is not None:
            signer = Signer(credentials.cert, credentials.key)
            verifier = Verifier(credentials.ca.read_bytes())
        return cls(signer, verifier, required=policy == "1" or (policy == "auto" and verifier is not None))

    def sign(self, body: dict[str, Any]) -> dict[str, Any]:
        """Return ``body``, signed when this peer holds a certificate."""
        return self._signer.sign(body) if self._signer is not None else body

    def verify(self, body: Mapping[str, Any], peer_id: str) -> Verified:
        """Return the certificate that signed for ``peer_id``, or raise IdentityError."""
        if self._verifier is None:
            raise IdentityError("this peer has no roots to check signatures against")
        verified = self._verifier.verify(body)
        if not verified.speaks_for(peer_id):
            raise IdentityError(f"the certificate of {verified.common_name} does not speak for {shown(peer_id)}")
        return verified

    def refusal(self, body: Mapping[str, Any], peer_id: str) -> str | None:
        """The reason why ``body`` does not count as signed by ``peer_id``, or None."""
        try:
            self.verify(body, peer_id)
        except IdentityError as exc:
            return str(exc)
        return None

    @property
    def signs(self) -> bool:
        """True when this peer holds a certificate."""
        return self._signer is not None


def visitor_id(prefix: str) -> str:
    """Make a fresh id for a short stay, under our certificate's name if any.

    Raises:
        TransportError: the certificate's settings name files that cannot be used.
        IdentityError: the certificate cannot be read.
    """
    own, files = f"{prefix}-{secrets.token_hex(4)}", TlsCredentials.from_settings()
    return own if files is None else f"{Signer(files.cert, files.key).common_name}__{own}"


def identity_of(transport: Transport) -> Identity:
    """The identity that the environment asks for on this transport.

    Signed where the session has certificates. MQTT's own certificates are the broker's business, so there it is signed
    only where that is demanded, with the mesh's.
    """
    posture: Posture | None = getattr(transport, "posture", None)
    if posture is not None:
        return Identity.from_settings(posture.credentials)
    return Identity.from_settings(TlsCredentials.from_settings() if signature_policy() == "1" else None)


def signature_policy() -> str:
    """``STRANDS_MESH_REQUIRE_SIGNED_IDENTITY``: 1, 0 or auto; other text is 1."""
    stated = settings.raw("STRANDS_MESH_REQUIRE_SIGNED_IDENTITY").strip().lower()
    return stated if stated in ("0", "1", "auto") else _unknown_policy(stated)


@lru_cache(maxsize=16)
def _unknown_policy(stated: str) -> str:
    """``1``; the cache limits the warning to one for each text."""
    logger.warning("STRANDS_MESH_REQUIRE_SIGNED_IDENTITY=%s is none of 1, 0 and auto; taken as 1.", shown(stated))
    return "1"


def _shape(sig: object) -> dict[str, Any]:
    if not isinstance(sig, dict) or set(sig) != FIELDS:
        raise IdentityError("not signed, or not with exactly the fields of a signature")
    version, algorithm, nonce = sig["v"], sig["alg"], sig["nonce"]
    if isinstance(version, bool) or version != VERSION or algorithm not in ALGORITHMS:
        raise IdentityError("unknown version or algorithm")
    if not isinstance(nonce, str) or not 1 <= len(nonce) <= 128 or not nonce.isascii():
        raise IdentityError("the nonce must be 1 to 128 ASCII characters")
    return sig


def _decode(text: object, most: int, *, url: bool = False) -> bytes:
    if not isinstance(text, str) or not text.isascii() or len(text) > most * 4 // 3 + 4:
        raise IdentityError("the certificate or the signature is no base64 of an allowed length")
    bare = text.rstrip("=")
    try:
        data = base64.b64decode(bare + "=" * (-len(bare) % 4), altchars=b"-_" if url else None, validate=True)
    except (binascii.Error, ValueError):
        raise IdentityError("the certificate or the signature is no base64") from None
    if not 0 < len(data) <= most:
        raise IdentityError("the certificate or the signature is too long")
    return data


def _parse(der: bytes) -> Any:
    try:
        certificate = cryptography().x509.load_der_x509_certificate(der)
        # The parser reads some parts lazily and finds them broken only then.
        certificate.public_key()
        certificate.subject, certificate.issuer, certificate.extensions  # noqa: B018 - parsed, not used
    except Exception as exc:  # noqa: BLE001 - hostile bytes make the parser raise several kinds
        raise IdentityError(f"the certificate cannot be read: {type(exc).__name__}") from None
    return certificate


def _common_name(certificate: x509.Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(cryptography().x509.NameOID.COMMON_NAME)
    if len(names) != 1:
        raise IdentityError("the certificate must have exactly one common name")
    try:
        return identifier("common name", names[0].value)
    except ValidationError:
        raise IdentityError("the certificate's common name is no peer id") from None


def _algorithm_of(public: Any) -> str:
    modules = cryptography()
    if isinstance(public, modules.ed25519.Ed25519PublicKey):
        return "ed25519"
    if isinstance(public, modules.ec.EllipticCurvePublicKey):
        return "ecdsa-sha256"
    if isinstance(public, modules.rsa.RSAPublicKey):
        return "rsa-pss-sha256"
    raise IdentityError("the certificate's key is of no known kind")


def _signed_bytes(body: Mapping[str, Any], head: Mapping[str, Any], digest: str) -> bytes:
    return canonical_json({"body": body, "sig": {**head, "cert_sha256": digest}})


@lru_cache(maxsize=len(ALGORITHMS))
def _parameters(algorithm: str) -> tuple[Any, ...]:
    """Return the arguments besides the message that signing and verifying take."""
    modules = cryptography()
    sha256 = modules.hashes.SHA256()
    if algorithm == "ed25519":
        return ()
    if algorithm == "ecdsa-sha256":
        return (modules.ec.ECDSA(sha256),)
    return (modules.padding.PSS(mgf=modules.padding.MGF1(sha256), salt_length=SALT_BYTES), sha256)
