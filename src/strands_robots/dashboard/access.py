"""Access to the page: addresses, origins, tokens and roles.

A browser sends the name that it was given (Host) and the page that asks (Origin). Both are checked on every request, so
that neither another site nor a name that was pointed at this machine reaches anything. There is no cookie: a page
presents its token, or on loopback nothing, as the first message of a WebSocket, which another origin cannot open.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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

TOO_LONG = 200


@dataclass(frozen=True, slots=True)
class Access:
    """Addresses that the page answers at, and what opens it.

    Attributes:
        origins: of the page, such as ``http://127.0.0.1:8800``.
        tokens: roles by token; without any, a page on loopback has ``local_role``.
        local_role: role of a page on loopback, which needs no token.
    """

    origins: frozenset[str]
    tokens: Mapping[str, str] = field(default_factory=dict, repr=False)
    local_role: str = OPERATOR

    @property
    def hosts(self) -> frozenset[str]:
        """The values of Host that the page answers to."""
        return frozenset(each.partition("://")[2] for each in self.origins)

    def refusal(self, headers: Mapping[str, str], *, websocket: bool) -> str:
        """Return why a request is refused, or ""."""
        host, origin = headers.get("host", "").lower(), headers.get("origin")
        if host not in self.hosts:
            return f"Host {host[:TOO_LONG]!r} is not an address of this page."
        if origin is None:
            if websocket:
                return "A WebSocket needs an Origin."
        elif origin.lower() not in self.origins or origin.lower().partition("://")[2] != host:
            return f"Origin {origin[:TOO_LONG]!r} is not this page."
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "Another site may not use this page."
        return ""

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
    host = client[0] if isinstance(client, list | tuple) and client else ""
    try:
        return ipaddress.ip_address(str(host)).is_loopback
    except ValueError:
        return False


class Guard:
    """ASGI middleware that refuses strangers and sets the headers of every answer."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        why = self._access.refusal(Headers(scope=scope), websocket=scope["type"] == "websocket")
        if not why and scope["type"] == "http" and scope["method"] not in ("GET", "HEAD"):
            why = "Only GET is served."
        if why and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message.get("headers", ()), *own]
            await send(message)

        if why:
            await PlainTextResponse(f"{why}\n", 403)(scope, receive, with_headers)
            return
        await self._app(scope, receive, with_headers)
