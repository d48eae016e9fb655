"""How the mesh meets the network: which endpoints, and with certificates or without.

A mesh bound to loopback alone comes up without certificates. Leaving loopback needs mutual TLS, or an opt-in
that says in its name what it is.
"""

from __future__ import annotations

import logging
import secrets
import stat
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path

from strands_robots import settings
from strands_robots.mesh.transport.base import TransportError

logger = logging.getLogger(__name__)

ACL_MAX_BYTES = 256 * 1024
HOW_TO_KEYS = "strands-robots mesh keys init"

HEARD_S = 1.1
"""Two heartbeats: who has a link to a peer has been heard by it."""

LINKED_S = 12.0
"""The same where links go to stated endpoints: of two tries the second may come 8 s after the first."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """The PEM files of mutual TLS."""

    ca: Path
    cert: Path
    key: Path


@dataclass(frozen=True, slots=True)
class Posture:
    """What the session is opened with.

    ``hub`` is the loopback endpoint of the automatic hub, None where endpoints are stated. ``access_control`` is
    JSON5 text, None for the table's own rules. ``verified`` says that a peer's certificate is checked.
    """

    namespace: str
    connect: tuple[str, ...]
    listen: tuple[str, ...]
    hub: str | None
    credentials: Credentials | None
    access_control: str | None
    multicast: bool
    max_sessions: int

    @property
    def verified(self) -> bool:
        return self.credentials is not None


def from_settings() -> Posture:
    """The posture the environment asks for.

    Raises:
        TransportError: it would leave loopback without certificates and without the opt-in, or a certificate
            file is missing, a link, or a key that others can read.
    """
    connect, listen = settings.items("ZENOH_CONNECT"), settings.items("ZENOH_LISTEN")
    multicast = settings.boolean("STRANDS_MESH_MULTICAST")
    credentials = None if _insecure() else credentials_from_settings()
    if credentials is None:
        _refuse_to_leave_loopback(connect + listen, multicast)
    if multicast:
        logger.warning("Multicast scouting is on: every Zenoh process on this network learns of this peer.")
    explicit = bool(connect or listen)
    scheme = "tls" if credentials else "tcp"
    hub = None if explicit else f"{scheme}/127.0.0.1:{settings.integer('STRANDS_MESH_PORT')}"
    return Posture(
        namespace=settings.raw("STRANDS_MESH_NAMESPACE"),
        connect=connect,
        listen=listen,
        hub=hub,
        credentials=credentials,
        access_control=_access_control() if credentials else None,
        multicast=multicast,
        max_sessions=settings.integer("STRANDS_MESH_MAX_SESSIONS"),
    )


def linked_within_s(otherwise: float) -> float:
    """How long to wait for a peer to be seen: :data:`LINKED_S` with stated endpoints, else ``otherwise`` seconds."""
    return LINKED_S if settings.items("ZENOH_LISTEN") or settings.items("ZENOH_CONNECT") else otherwise


def credentials_from_settings() -> Credentials | None:
    """The three files, checked; None when none of them is stated.

    Raises:
        TransportError: only some are stated, or one is missing, a symbolic link, or a key open to others.
    """
    names = ("STRANDS_MESH_TLS_CA", "STRANDS_MESH_TLS_CERT", "STRANDS_MESH_TLS_KEY")
    stated = {name: settings.raw(name) for name in names}
    if not any(stated.values()):
        return None
    missing = [name for name, value in stated.items() if not value]
    if missing:
        raise TransportError(f"mutual TLS needs {', '.join(names)}; {', '.join(missing)} is not set.")
    ca, cert, key = (_plain_file(name, Path(value).expanduser()) for name, value in stated.items())
    if stat.S_IMODE(key.stat().st_mode) & 0o077:
        raise TransportError(f"STRANDS_MESH_TLS_KEY: others may read {key}; run chmod 600 on it.")
    return Credentials(ca, cert, key)


def is_loopback(endpoint: str) -> bool:
    """Whether a Zenoh endpoint such as ``tcp/127.0.0.1:7447`` stays on this machine."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith(("unix", "vsock")):
        return protocol.startswith("unix")
    host = address.split("#")[0].split("?")[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


def _insecure() -> bool:
    if settings.boolean("STRANDS_MESH_LOCAL_DEV"):
        return True
    if settings.raw("STRANDS_MESH_AUTH_MODE").lower() != "none":
        return False
    if settings.boolean("STRANDS_MESH_I_KNOW_THIS_IS_INSECURE"):
        return True
    logger.warning(
        "STRANDS_MESH_AUTH_MODE=none is ignored without STRANDS_MESH_I_KNOW_THIS_IS_INSECURE=true; "
        "the mesh stays with mutual TLS."
    )
    return False


def _refuse_to_leave_loopback(endpoints: tuple[str, ...], multicast: bool) -> None:
    outside = [endpoint for endpoint in endpoints if not is_loopback(endpoint)]
    if multicast:
        outside.append("multicast scouting")
    if not outside:
        return
    if _insecure():
        logger.warning("The mesh is open to everybody on the network: %s, without certificates.", ", ".join(outside))
        return
    raise TransportError(
        f"{', '.join(outside)} leaves this machine, and the mesh has no certificates: run '{HOW_TO_KEYS}' and set "
        "STRANDS_MESH_TLS_CA, STRANDS_MESH_TLS_CERT and STRANDS_MESH_TLS_KEY."
    )


def _plain_file(name: str, path: Path) -> Path:
    if path.is_symlink():
        raise TransportError(f"{name}: {path} is a symbolic link; name the file itself.")
    if not path.is_file():
        raise TransportError(f"{name}: there is no file {path}.")
    return path


def _access_control() -> str | None:
    stated = settings.raw("STRANDS_MESH_ACL_FILE")
    if not stated:
        return None
    path = _plain_file("STRANDS_MESH_ACL_FILE", Path(stated).expanduser())
    if path.stat().st_size > ACL_MAX_BYTES:
        raise TransportError(f"STRANDS_MESH_ACL_FILE: {path} is above {ACL_MAX_BYTES // 1024} KiB.")
    return path.read_text(encoding="utf-8")


def visitor_id(word: str) -> str:
    """A fresh id for a short stay on the mesh, which the certificate speaks for where there is one.

    Raises:
        TransportError: the certificate's settings name files that cannot be used.
        IdentityError: the certificate cannot be read.
    """
    from strands_robots.mesh.wire_identity import Signer  # noqa: PLC0415 - needs cryptography, and only with a certificate

    own, files = f"{word}-{secrets.token_hex(4)}", credentials_from_settings()
    return own if files is None else f"{Signer(files.cert, files.key).common_name}__{own}"
