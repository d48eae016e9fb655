"""TLS of a link's clients, and the reasons why an endpoint does not answer."""

from __future__ import annotations

import contextlib
import errno
import re
import socket
import ssl
import tempfile
from pathlib import Path
from urllib.parse import urlsplit

from ...bounded_json import json_object
from .config import ZENOH_PORT, LinkConfig, host_of

DIAL_S = 0.5
"""Seconds for each step of a dial, after the transport itself has tried for longer."""

NATS_PORT = 4222

_WORDS = {
    errno.ECONNREFUSED: "nothing listens there",
    errno.ECONNRESET: "it cut the connection",
    errno.EPIPE: "it cut the connection",
    errno.EADDRINUSE: "another program holds the port",
    errno.EHOSTUNREACH: "there is no route to it",
    errno.ENETUNREACH: "there is no route to it",
    errno.EADDRNOTAVAIL: "this machine has no such address",
    errno.EACCES: "this user may not open that port",
}


_SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")


def client_context(link: LinkConfig) -> ssl.SSLContext:
    """Return a context that trusts the stated authority alone, else the system's."""
    stated = {"cadata" if link.ca.lstrip().startswith("-----BEGIN") else "cafile": link.ca} if link.ca else {}
    context = ssl.create_default_context(**stated)  # type: ignore[arg-type]  # both keys take text
    context.check_hostname = link.verify_hostname
    if link.cert:
        _load_identity(context, link.cert, link.key)
    return context


def why_silent(link: LinkConfig, within: float = DIAL_S) -> str:
    """Return why the endpoints that a link connects to do not answer, or empty.

    Args:
        link: whose transport could not connect.
        within: seconds for each step.
    """
    problems = [endpoint_problem(link, each, within) for each in link.connect[:3]]
    return "; ".join(dict.fromkeys(filter(None, problems)))


def endpoint_problem(link: LinkConfig, endpoint: str, within: float = DIAL_S) -> str:
    """Return why an endpoint does not answer as TCP, TLS and NATS ask for, or empty.

    What is no TCP is not dialled.
    """
    scheme = re.split(r"://|/", endpoint, maxsplit=1)[0] if re.search(r"://|/", endpoint) else "nats"
    if scheme not in ("tcp", "tls", "nats"):
        return ""
    try:
        with socket.create_connection((host_of(endpoint), _port_of(link, endpoint)), within) as raw:
            if link.transport == "nats" and (refusal := _greeting_problem(raw, link)):
                return refusal
            if scheme == "tls" or (link.transport == "nats" and link.encrypted):
                _shake_hands(raw, link, host_of(endpoint))
    except OSError as error:
        return reason_of(error)
    except ValueError:  # such as a host of more than 63 characters between two dots
        return "its host or port cannot be read"
    return ""


def reason_of(error: BaseException) -> str:
    """Return why a connection failed, as the end of a sentence."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is refused: {error.verify_message.rstrip('.')}"
    if isinstance(error, ssl.SSLError):
        alert = (error.reason or str(error)).replace("_", " ").lower()
        if "key values mismatch" in alert:
            return "our key is not that of our certificate"
        if error.library in ("X509", "PEM") or "pem" in alert.split():
            return "our certificates are no PEM files that fit; doctor, with the same flags, names the file"
        _, refused, why = alert.partition("alert ")
        if refused:
            return f"it refuses our certificate: {why}"
        return f"it does not speak TLS as we do: {alert}"
    if isinstance(error, socket.gaierror):
        return "no such host is known"
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if isinstance(error, OSError):
        # asyncio gives the system's number with words of its own.
        return _WORDS.get(error.errno or 0, error.strerror or str(error))
    return str(error)


def words_of(text: str) -> str:
    """Return the reason in a text of Zenoh, without the place in its own sources."""
    known = _SYSTEM_ERROR.search(text)
    if known:
        return reason_of(OSError(int(known[1]), text))
    return text.partition(" at /")[0].strip()


def _port_of(link: LinkConfig, endpoint: str) -> int:
    if link.transport == "nats":
        return urlsplit(endpoint if "://" in endpoint else f"nats://{endpoint}").port or NATS_PORT
    digits = re.split(r"[?#]", endpoint, maxsplit=1)[0].rpartition(":")[2]
    return int(digits) if digits.isdigit() else ZENOH_PORT


def _greeting_problem(raw: socket.socket, link: LinkConfig) -> str:
    """Read what a NATS server says first; return what is wrong with it."""
    said = b""
    with contextlib.suppress(TimeoutError):
        while b"\r\n" not in said and len(said) < 2**16 and (more := raw.recv(4096)):
            said += more
    if not said.startswith(b"INFO "):
        return "what listens there is no NATS server"
    server = json_object(said[5:].partition(b"\r\n")[0])
    if not server:
        return "what listens there is no NATS server"
    wanted = bool(server.get("tls_required"))
    if link.encrypted and not (wanted or server.get("tls_available")):
        return "that server has no TLS; nats:// without certificates reaches it"
    return "that server asks for TLS; give tls:// and certificates" if wanted and not link.encrypted else ""


def _shake_hands(raw: socket.socket, link: LinkConfig, host: str) -> None:
    """Do a TLS handshake; with TLS 1.3 a server refuses a certificate only after it.

    Raises:
        OSError: it failed.
    """
    with client_context(link).wrap_socket(raw, server_hostname=host) as secured, contextlib.suppress(TimeoutError):
        if not secured.recv(1):
            raise ssl.SSLError(1, "[SSL] the server ended the connection after the handshake")


def _load_identity(context: ssl.SSLContext, cert: str, key: str) -> None:
    """Load certificate and key, which the standard library reads from files only."""
    if not cert.lstrip().startswith("-----BEGIN"):
        context.load_cert_chain(cert, key)
        return
    with tempfile.TemporaryDirectory(prefix="strands-") as folder:
        both = Path(folder, "identity.pem")
        both.touch(mode=0o600)
        both.write_text(f"{cert}\n{key}\n")
        context.load_cert_chain(both)
