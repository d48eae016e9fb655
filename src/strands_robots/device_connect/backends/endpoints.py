"""Where a link goes: endpoints in Zenoh's and in NATS's spelling, checked before anything is dialled."""

from __future__ import annotations

import re
from collections.abc import Sequence
from urllib.parse import urlparse, urlsplit

from ...utils import ValidationError, shown

INTERNET = ("tcp", "udp", "tls", "quic", "ws")
ZENOH_PORT = 7447

_DOTTED = re.compile(r"[0-9.]+")


def endpoints(servers: Sequence[str]) -> tuple[str, ...]:
    """Zenoh endpoints for URLs in any of the framework's spellings; ``zenoh://`` alone means none."""
    found = []
    for server in (each.strip() for each in servers):
        scheme, _, rest = server.partition("://")
        if rest and scheme in ("zenoh", "zenoh+tls"):
            url = urlparse(server)
            found.append(f"{'tls' if scheme.endswith('tls') else 'tcp'}/{url.hostname}:{url.port or ZENOH_PORT}")
        elif server and "://" not in server:
            found.append(server if "/" in server else f"tcp/{server}")
        elif rest:
            found.append(server)
    return tuple(found)


def host_of(endpoint: str) -> str:
    """The host that an endpoint names, without brackets, credentials and port."""
    address = endpoint.partition("://")[2] or endpoint.partition("/")[2]
    return address.rpartition("@")[2].rpartition(":")[0].strip("[]")


def check_zenoh(name: str, endpoint: str) -> None:
    """Refuse an endpoint that no attempt could reach: ``tcp/host:port`` is the form; serial and sockets pass.

    Raises:
        ValidationError: naming ``name``, the value and the domain.
    """
    scheme, slash, rest = endpoint.partition("/")
    if slash and scheme not in INTERNET:
        return
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    host, colon, port = address.rpartition(":")
    if not (slash and colon and _is_host(host) and port.isascii() and port.isdigit() and int(port) <= 65535):
        raise ValidationError(f"{name} must be like tcp/host:port or tls/host:port, not {shown(endpoint)}.")


def check_nats(name: str, url: str) -> None:
    """Refuse a URL that no attempt could reach: ``nats://host:port`` is the form; the port may be left out.

    Raises:
        ValidationError: naming ``name``, the value and the domain.
    """
    try:
        parts = urlsplit(url if "://" in url else f"nats://{url}")
        good = parts.scheme in ("nats", "tls", "ws", "wss") and _is_host(parts.hostname or "") and parts.port != 0
    except ValueError:  # of a port that is none
        good = False
    if not good:
        # A URL may carry a password, which is nobody's business in a log.
        raise ValidationError(f"{name} must be like nats://host:port or tls://host:port, not {shown(_safe(url))}.")


def _is_host(host: str) -> bool:
    if _DOTTED.fullmatch(host):
        octets = host.split(".")
        return len(octets) == 4 and all(octet and int(octet) <= 255 for octet in octets)
    return bool(host) and not re.search(r"[\s/]", host)


def _safe(url: str) -> str:
    return re.sub(r"//[^@/]*@", "//***@", url)
