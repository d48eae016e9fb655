"""Access to the page: addresses, certificate, roles, and the operator's key.

There is no cookie: a page presents its token, or on loopback nothing, as the first message of a WebSocket, which
another origin cannot open.
"""

from __future__ import annotations

import hashlib
import hmac
import io
import ipaddress
import re
import secrets
import ssl
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots.certificates import CA_CERT, CA_KEY, init, issue
from strands_robots.errors import StrandsRobotsError
from strands_robots.http_access import HttpRules, bracketed
from strands_robots.safety.ed25519 import load_signing_key
from strands_robots.state_files import state_dir
from strands_robots.utils import ValidationError, is_loopback_host, optional_module, shown

VIEWER, OPERATOR = "viewer", "operator"
ROLES = (VIEWER, OPERATOR)

HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=(), serial=(), gamepad=(self)",
    "cache-control": "no-store",
}

FOLDER = "dashboard-keys"
SERVED_ANYWAY = frozenset({"127.0.0.1", "localhost"})

WRONG_MAX, PAUSE_S = 5, 30.0
"""Wrong passphrases after which none is tried for a while."""


@dataclass(frozen=True, slots=True)
class Access(HttpRules):
    """Addresses that the page answers at, and what opens it.

    Attributes:
        tokens: roles by token; without any, a page on loopback has ``local_role``.
        local_role: role of a page on loopback, which needs no token.
    """

    tokens: Mapping[str, str] = field(default_factory=dict, repr=False)
    local_role: str = OPERATOR

    def role(self, token: object, *, local: bool) -> str | None:
        """Return the role of a page that presents ``token``, or None."""
        given = token if isinstance(token, str) else ""
        found = None
        for known, role in self.tokens.items():
            # JSON can carry what UTF-8 cannot, such as half of a surrogate pair.
            if hmac.compare_digest(known.encode(), given.encode(errors="replace")):
                found = role
        if found is None and local and not given:
            return self.local_role
        return found


def loopback_origins(port: int) -> frozenset[str]:
    """Return the origins of a page on loopback."""
    return frozenset(f"http://{host}:{port}" for host in ("127.0.0.1", "localhost", "[::1]"))


def new_token() -> str:
    """Return a fresh token of 192 bits."""
    return secrets.token_urlsafe(24)


def is_local(client: object) -> bool:
    """Return True for the address of a program on this machine."""
    return isinstance(client, list | tuple) and bool(client) and is_loopback_host(str(client[0]))


@dataclass(frozen=True, slots=True)
class RemoteAddress:
    """An address beyond this machine that the page is served at.

    Attributes:
        cert, key: files of the certificate for this address.
        tokens: of the roles, made at each start.
    """

    host: str
    port: int
    cert: Path
    key: Path
    tokens: dict[str, str]

    @property
    def origin(self) -> str:
        """The page's origin at this address."""
        return f"https://{bracketed(self.host)}:{self.port}"

    def url(self, role: str) -> str:
        """Return the address that opens the page with a role.

        The token stands behind the hash, which a browser sends to no server.
        """
        return f"{self.origin}/#token={self.tokens[role]}"

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the certificate, as browsers show it."""
        digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(self.cert.read_text(encoding="ascii"))).hexdigest()
        return ":".join(digest[at : at + 2] for at in range(0, len(digest), 2)).upper()


def remote_address(address: str, port: int) -> RemoteAddress:
    """Return the address with a certificate of an authority of its own.

    Raises:
        ValidationError: ``address`` is no address or name of this machine, means all of them, or is where the page
            is served anyway.
    """
    host = address.strip().strip("[]").lower()
    try:
        parsed = ipaddress.ip_address(host)
    except ValueError:
        if not re.fullmatch(r"[a-z0-9]([a-z0-9.-]{0,251}[a-z0-9])?", host):
            raise ValidationError(f"--listen must be an IP address or a host name, not {shown(address)}.") from None
    else:
        if parsed.is_unspecified:
            raise ValidationError(f"--listen must be one address of this machine, not all of them ({address}).")
    if host in SERVED_ANYWAY:
        raise ValidationError(f"--listen must be an address besides {host}, where the page is served anyway.")
    folder = state_dir() / FOLDER
    if not (folder / CA_CERT).exists() or not (folder / CA_KEY).exists():
        init(folder, "strands-robots dashboard")
    name = "page-" + re.sub(r"[^a-z0-9]", "-", host)[:58]
    cert, key = folder / f"{name}.pem", folder / f"{name}.key"
    if not (cert.exists() and key.exists()):
        issue(folder, name, [host])
    return RemoteAddress(host, port, cert, key, {role: new_token() for role in ROLES})


def access_for(port: int, remote: RemoteAddress | None, *, viewer: bool = False) -> Access:
    """Return who may open a page on loopback, and at the remote address if any."""
    origins = loopback_origins(port)
    local = VIEWER if viewer else OPERATOR
    if remote is None:
        return Access(origins, {}, local)
    return Access(origins | {remote.origin}, {token: role for role, token in remote.tokens.items()}, local)


def qr_code(url: str) -> str:
    """Return a QR code for a terminal, as text."""
    segno, drawn = optional_module("segno", what="The QR code", extra="dashboard"), io.StringIO()
    # Light modules are drawn, so that it reads on a dark terminal: two rows of modules a line.
    segno.make(url, error="l").terminal(drawn, border=2, compact=True)
    return drawn.getvalue()


class KeyRefusedError(StrandsRobotsError, RuntimeError):
    """The operator's key cannot be used; the text says why."""


class OperatorKey:
    """Key file that frees locked robots and takes control.

    It is opened with a passphrase for one act, and not kept.

    Args:
        path: of the key; None where the server was given none.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._wrong, self._until = 0, float("-inf")

    @property
    def present(self) -> bool:
        """True where the server was given a key."""
        return self._path is not None

    def open(self, passphrase: object) -> Any:
        """Return the private key. Slow on purpose: call it on a thread.

        Raises:
            KeyRefusedError: there is none, the passphrase does not open it, or too many were wrong.
        """
        if self._path is None:
            raise KeyRefusedError("This page was started without --operator-key.")
        if time.monotonic() < self._until:
            raise KeyRefusedError(f"After {WRONG_MAX} wrong passphrases none is tried for {PAUSE_S:g} s.")
        if not isinstance(passphrase, str) or not passphrase or len(passphrase) > 1000:
            raise KeyRefusedError("The passphrase of the operator's key is missing.")
        try:
            key = load_signing_key(self._path, passphrase)
        except OSError as exc:
            raise KeyRefusedError(f"The operator's key cannot be read: {exc.strerror}") from exc
        except ValueError as exc:
            self._wrong += 1
            if self._wrong >= WRONG_MAX:
                self._wrong, self._until = 0, time.monotonic() + PAUSE_S
            raise KeyRefusedError("The passphrase does not open the operator's key.") from exc
        self._wrong = 0
        return key
