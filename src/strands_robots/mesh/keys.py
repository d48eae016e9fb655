"""Certificates and access rules: ``strands-robots mesh keys init|issue|acl``.

One authority for a fleet, one certificate a peer with the peer's id as its common name, and Zenoh access rules
that let each peer publish under its own name alone.
"""

from __future__ import annotations

import datetime
import ipaddress
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from strands_robots.mesh import topics
from strands_robots.mesh.security import validate_peer_id
from strands_robots.mesh.transport.access import MESSAGES, allow, deny_by_default
from strands_robots.mesh.transport.zenoh_config import TlsCredentials
from strands_robots.mesh.wire_identity import cryptography
from strands_robots.utils import ValidationError, text, whole

AUTHORITY_DAYS = 3650
PEER_DAYS = 397
CA_CERT, CA_KEY = "ca.pem", "ca.key"
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")


def init(folder: Path, name: str = "strands-robots mesh", days: int = AUTHORITY_DAYS) -> Path:
    """Make the authority: ``ca.pem``, whose path is returned, and ``ca.key`` (0600).

    Raises:
        ValidationError: a blank name, or ``days`` not from 1 to 36500.
        FileExistsError: there is an authority in ``folder`` already.
    """
    modules = cryptography()
    x509 = modules.x509
    text("name", name, longest=64)
    key = modules.ec.generate_private_key(modules.ec.SECP256R1())
    subject = _subject(name)
    certificate = (
        _builder(subject, subject, key.public_key(), whole("days", days, low=1, high=36_500))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
        .sign(key, modules.hashes.SHA256())
    )
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _write(folder / CA_KEY, _pem(key), 0o600)
    _write(folder / CA_CERT, certificate.public_bytes(modules.serialization.Encoding.PEM), 0o644)
    return folder / CA_CERT


def issue(folder: Path, peer_id: str, hosts: Sequence[str] = (), days: int = PEER_DAYS) -> TlsCredentials:
    """Make a certificate for ``peer_id``, valid on loopback and on ``hosts``.

    Raises:
        ValueError: ``peer_id`` is no peer id, a host is blank, or ``days`` is not from 1 to 3650.
        FileNotFoundError: there is no authority in ``folder``.
        FileExistsError: this peer has a certificate already.
    """
    modules = cryptography()
    x509 = modules.x509
    name = validate_peer_id(peer_id)
    if len(name) > 64:
        raise ValidationError(f"peer_id must have at most 64 characters to stand in a certificate, not {len(name)}.")
    authority = x509.load_pem_x509_certificate((folder / CA_CERT).read_bytes())
    signing: Any = modules.serialization.load_pem_private_key((folder / CA_KEY).read_bytes(), None)
    key = modules.ec.generate_private_key(modules.ec.SECP256R1())
    usages = [x509.ExtendedKeyUsageOID.SERVER_AUTH, x509.ExtendedKeyUsageOID.CLIENT_AUTH]
    alternatives = [_alternative(host) for host in (*LOOPBACK_HOSTS, *(text("host", h, longest=253) for h in hosts))]
    certificate = (
        _builder(_subject(name), authority.subject, key.public_key(), whole("days", days, low=1, high=3650))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .sign(signing, modules.hashes.SHA256())
    )
    issued = TlsCredentials(folder / CA_CERT, folder / f"{name}.pem", folder / f"{name}.key")
    _write(issued.key, _pem(key), 0o600)
    _write(issued.cert, certificate.public_bytes(modules.serialization.Encoding.PEM), 0o644)
    return issued


def acl(
    robots: Sequence[str],
    operators: Sequence[str] = (),
    relays: Sequence[str] | None = None,
    namespace: str = "strands",
) -> str:
    """Return Zenoh access rules (JSON5) that deny by default.

    Every certified peer receives everything, may stop the fleet and may relay a resume, which only the operator's
    key can have signed. A relay is a peer through which others are connected (the hub); what it forwards arrives
    under its own certificate, so others accept everything from it, and the signatures on the messages say whose
    they are. The relays are the operators where None.

    Raises:
        ValueError: no robot and no operator, or a name that is no peer id.
    """
    through = operators if relays is None else relays
    certified = [validate_peer_id(each) for each in dict.fromkeys((*robots, *operators, *through))]
    if not certified:
        raise ValidationError("robots or operators must name at least one peer.")
    prefix = f"{namespace}/{topics.ROOT}" if namespace else topics.ROOT
    receiving = [message for message in MESSAGES if message not in ("put", "delete")]
    rules: list[dict[str, Any]] = [
        allow("hear", receiving, ["ingress", "egress"], [f"{prefix}/**"]),
        allow("be-told", ["put", "delete"], ["egress"], [f"{prefix}/**"]),
        allow("safety", ["put"], ["ingress"], [f"{prefix}/safety/*"]),
        allow("relay", ["put", "delete"], ["ingress"], [f"{prefix}/**"]),
        allow("command", ["put"], ["ingress"], [f"{prefix}/*/cmd", f"{prefix}/broadcast"]),
    ]
    subjects, policies = [], []
    for peer in certified:
        # A certificate speaks for its name, and for what its owner calls NAME__something.
        names = (peer, f"{peer}__$*")
        own = [key for name in names for key in (f"{prefix}/{name}/**", f"{prefix}/*/response/{name}/**")]
        rules.append(allow(f"own-{peer}", ["put", "delete", "liveliness_token"], ["ingress"], own))
        subjects.append({"id": peer, "cert_common_names": [peer]})
        granted = ["hear", "be-told", "safety", f"own-{peer}"]
        granted += [rule for rule, peers in (("command", operators), ("relay", through)) if peer in peers]
        policies.append({"rules": granted, "subjects": [peer]})
    return json.dumps(deny_by_default(rules, subjects, policies), indent=2) + "\n"


def _subject(name: str) -> Any:
    x509 = cryptography().x509
    return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])


def _alternative(host: str) -> Any:
    x509 = cryptography().x509
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _builder(subject: Any, issuer: Any, public: Any, days: int) -> Any:
    x509 = cryptography().x509
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        # A peer whose clock is a little behind must take a certificate made just now.
        .not_valid_before(now - datetime.timedelta(minutes=5))
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _usage(*, authority: bool) -> Any:
    x509 = cryptography().x509
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(key: Any) -> bytes:
    serialization = cryptography().serialization
    pem: bytes = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return pem


def _write(path: Path, data: bytes, mode: int) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
