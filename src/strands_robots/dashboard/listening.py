"""Listening beyond this machine: certificate, tokens, and a QR code for a phone."""

from __future__ import annotations

import hashlib
import ipaddress
import re
import ssl
from dataclasses import dataclass
from pathlib import Path

from strands_robots.certificates import CA_CERT, CA_KEY, init, issue
from strands_robots.dashboard.access import OPERATOR, ROLES, VIEWER, Access, loopback_origins, new_token
from strands_robots.state_files import state_dir
from strands_robots.utils import ValidationError, missing_extra, shown

FOLDER = "dashboard-keys"
SERVED_ANYWAY = frozenset({"127.0.0.1", "localhost"})


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
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"https://{host}:{self.port}"

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
    try:
        import segno  # noqa: PLC0415 - loaded when a code is shown
    except ModuleNotFoundError as exc:
        raise missing_extra("The QR code", "dashboard") from exc
    matrix = [[False, False, *(bool(each) for each in row), False, False] for row in segno.make(url, error="l").matrix]
    blank = [False] * len(matrix[0])
    rows = [blank, *matrix, blank]
    if len(rows) % 2:
        rows.append(blank)
    # Light modules are drawn, so that it reads on a dark terminal: two rows of modules a line.
    marks = {(False, False): "█", (False, True): "▀", (True, False): "▄", (True, True): " "}
    return "\n".join(
        "".join(marks[pair] for pair in zip(upper, lower, strict=True))
        for upper, lower in zip(rows[::2], rows[1::2], strict=True)
    )
