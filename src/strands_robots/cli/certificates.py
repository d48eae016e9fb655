"""Check of the certificates that a link uses."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import load_pem_private_key

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig


def certificate_problem(link: LinkConfig, now: datetime | None = None) -> str:
    """Return the problem of a link's certificates by its file, or empty."""
    moment = now or datetime.now(UTC)
    try:
        authorities, chain = _certificates(link.ca), _certificates(link.cert)
        for file, each in [*((link.ca, each) for each in authorities), *((link.cert, each) for each in chain)]:
            since, until = each.not_valid_before_utc, each.not_valid_after_utc
            if not since <= moment <= until:
                said = "has expired: it was valid until" if moment > until else "is not valid yet, but from"
                return f"{_named(file)} {said} {(until if moment > until else since):%Y-%m-%d %H:%M} UTC"
        return _misfit(link, chain, authorities) if chain else ""
    except OSError as exc:
        return f"{exc.filename} cannot be read: {exc.strerror}"
    except _UnusableError as exc:
        return str(exc)


def valid_until(link: LinkConfig) -> str:
    """Return the last valid day of a link's own certificate, else of its authority's."""
    return _certificates(link.cert or link.ca)[0].not_valid_after_utc.date().isoformat()


def own_host(link: LinkConfig) -> str:
    """Return the host in a link's own certificate that this machine reaches it by."""
    try:
        names = _hosts(_certificates(link.cert)[0]) if link.cert else []
    except (OSError, _UnusableError, IndexError):
        return ""
    return next((each for each in ("127.0.0.1", "localhost") if each in names), names[0] if names else "")


class _UnusableError(ValueError):
    """A file that holds something else."""


def _misfit(link: LinkConfig, chain: list[x509.Certificate], authorities: list[x509.Certificate]) -> str:
    """Return which of key, certificate and authority do not belong together."""
    try:
        key = load_pem_private_key(_content(link.key), None)
    except (ValueError, TypeError) as exc:
        raise _UnusableError(f"{_named(link.key)} holds no PEM private key without a passphrase") from exc
    if chain[0].public_key() != key.public_key():
        return f"{_named(link.key)} is not the key of {_named(link.cert)}"
    if not any(_issued(chain[-1], each) for each in authorities):
        return f"{_named(link.cert)} was not issued by {_named(link.ca)}: peers that trust that authority refuse it"
    return ""


def _hosts(certificate: x509.Certificate) -> list[str]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (x509.ExtensionNotFound, ValueError):
        return []
    stated = [*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress))]
    return [each for each in stated if not set("*:/") & set(each)]


def _issued(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return certificate == authority
    return True


def _certificates(given: str) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(_content(given)) if given else []
    except ValueError as exc:
        raise _UnusableError(f"{_named(given)} holds no PEM certificate") from exc


def _content(given: str) -> bytes:
    return given.encode() if _is_text(given) else Path(given).read_bytes()


def _named(given: str) -> str:
    return "the certificate in the credentials" if _is_text(given) else given


def _is_text(given: str) -> bool:
    return given.lstrip().startswith("-----BEGIN")
