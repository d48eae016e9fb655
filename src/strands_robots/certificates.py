"""Certificates: an authority, and what it issues, as PEM files."""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from strands_robots.utils import ValidationError, missing_extra, text, whole

AUTHORITY_DAYS, ISSUED_DAYS = 3650, 397
CA_CERT, CA_KEY = "ca.pem", "ca.key"
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")
NAME_MAX = 64


@lru_cache(maxsize=1)
def cryptography() -> SimpleNamespace:
    """Load the parts of the ``cryptography`` package that certificates need.

    Raises:
        MissingExtraError: the package is not installed.
    """
    try:
        from cryptography import exceptions, x509  # noqa: PLC0415 - optional, loaded when used
        from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415 - as above
        from cryptography.hazmat.primitives.asymmetric import ec, ed25519, padding, rsa  # noqa: PLC0415 - as above
    except ImportError:
        raise missing_extra("A certificate", "mesh") from None
    modules = (exceptions, x509, hashes, serialization, ec, ed25519, padding, rsa)
    return SimpleNamespace(**{module.__name__.rpartition(".")[2]: module for module in modules})


def init(folder: Path, name: str, days: int = AUTHORITY_DAYS) -> Path:
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


def issue(folder: Path, name: str, hosts: Sequence[str] = (), days: int = ISSUED_DAYS) -> tuple[Path, Path]:
    """Make a certificate for ``name``, valid on loopback and on ``hosts``.

    Returns:
        The files of the certificate and of its key (0600), which are called ``name``.

    Raises:
        ValueError: a name longer than 64 characters, a blank host, or ``days`` not from 1 to 3650.
        FileNotFoundError: there is no authority in ``folder``.
        FileExistsError: this name has a certificate already.
    """
    modules = cryptography()
    x509 = modules.x509
    if len(name) > NAME_MAX:
        raise ValidationError(f"A name in a certificate must have at most {NAME_MAX} characters, not {len(name)}.")
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
    issued = folder / f"{name}.pem", folder / f"{name}.key"
    _write(issued[1], _pem(key), 0o600)
    _write(issued[0], certificate.public_bytes(modules.serialization.Encoding.PEM), 0o644)
    return issued


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
