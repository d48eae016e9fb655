"""Access to HTTP servers: addresses that they answer at, tokens of their clients.

A browser sends the name that it was given (Host) and the page that asks (Origin). Both are checked on every request, so
that neither another site nor a name that was pointed at this machine reaches anything.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from strands_robots.state_files import StateFileError, make_private, read_private, state_dir, write_private
from strands_robots.utils import device_id

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

TOKENS_FILE = "mcp-tokens.json"
SHOWN_MAX = 200


@dataclass(frozen=True, slots=True)
class HttpRules:
    """Addresses that a server answers at.

    Attributes:
        origins: such as ``http://127.0.0.1:8800``.
        any_port: Host and Origin may have another port or none, as behind a proxy. Then any of the origins may ask,
            and a WebSocket needs none.
    """

    origins: frozenset[str]
    any_port: bool = field(default=False, kw_only=True)

    def refusal(self, headers: Mapping[str, str], *, websocket: bool = False) -> str:
        """Return why a request is refused, or ""."""
        host, origin = headers.get("host", "").lower(), headers.get("origin")
        known = {each.partition("://")[2] for each in self.origins}
        if self._portless(host) not in known:
            return f"Host {host[:SHOWN_MAX]!r} is not an address of this server."
        if origin is not None and self._portless(origin.lower()) not in self.origins:
            return f"Origin {origin[:SHOWN_MAX]!r} is not this server."
        if self.any_port:
            return ""
        if origin is None and websocket:
            return "A WebSocket needs an Origin."
        if origin is not None and origin.lower().partition("://")[2] != host:
            return f"Origin {origin[:SHOWN_MAX]!r} is not this server."
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "Another site may not use this server."
        return ""

    def _portless(self, address: str) -> str:
        return re.sub(r":\d+\Z", "", address) if self.any_port else address


def bracketed(host: str) -> str:
    """Return a host as it stands in an address, an IPv6 one in brackets."""
    return f"[{host}]" if ":" in host else host


class Guard:
    """ASGI middleware that refuses strangers and sets the headers of every answer.

    Args:
        app: what it guards.
        rules: of its addresses.
        headers: of every answer.
        methods: that are served; empty for all.
    """

    def __init__(
        self,
        app: ASGIApp,
        rules: HttpRules,
        headers: Mapping[str, str] | None = None,
        methods: Sequence[str] = (),
    ) -> None:
        self._app, self._rules, self._methods = app, rules, methods
        self._headers = [(name.encode(), value.encode()) for name, value in (headers or {}).items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        websocket = scope["type"] == "websocket"
        if not websocket and scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in reversed(scope["headers"])}
        why = self._rules.refusal(headers, websocket=websocket)
        if not why and not websocket and self._methods and scope["method"] not in self._methods:
            why = f"Only {self._methods[0]} is served."
        if why and websocket:
            await receive()
            await send({"type": "websocket.close", "code": 1008})
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *self._headers]
            await send(message)

        if why:
            text = f"{why}\n".encode()
            kind = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(text)).encode())]
            await with_headers({"type": "http.response.start", "status": 403, "headers": kind})
            await with_headers({"type": "http.response.body", "body": text})
            return
        await self._app(scope, receive, with_headers)


@dataclass(frozen=True, slots=True)
class Token:
    """Name and permissions of a client of the MCP server.

    Attributes:
        name: the caller that robots see.
        read_only: it reads and stops, and moves nothing.
        approves: the yes of its user is the operator's approval of a motion of real hardware.
    """

    name: str
    read_only: bool = False
    approves: bool = False


class TokenFile:
    """Bearer tokens of this machine's user, in the state directory.

    The file has the SHA-256 of each token, so that reading it gives nobody a token.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or state_dir() / TOKENS_FILE

    def make(self, token: Token) -> str:
        """Add a token, or replace that of the name; return its text, which is not kept.

        Raises:
            ValidationError: the name is no caller's.
            StateFileError: the file is not this user's alone.
        """
        device_id("name", token.name)
        text = secrets.token_urlsafe(32)
        others = {digest: each for digest, each in self._read().items() if each.name != token.name}
        self._write({**others, _digest(text): token})
        return text

    def revoke(self, name: str) -> bool:
        """Remove the token of a name; False where there is none."""
        tokens = self._read()
        others = {digest: each for digest, each in tokens.items() if each.name != name}
        self._write(others)
        return len(others) < len(tokens)

    def names(self) -> list[str]:
        """Return the names that have a token."""
        return sorted(each.name for each in self._read().values())

    def find(self, text: str) -> Token | None:
        """Return the token of this text, None where it is none or was revoked."""
        wanted = _digest(text)
        # Every digest is compared, so that the time tells nothing.
        found = [token for digest, token in self._read().items() if hmac.compare_digest(digest, wanted)]
        return found[0] if found else None

    def _read(self) -> dict[str, Token]:
        try:
            rows = json.loads(read_private(self.path, self.path.parent))
            return {digest: Token(**fields) for digest, fields in rows.items()}
        except FileNotFoundError:
            return {}
        except (ValueError, TypeError, AttributeError) as exc:
            if isinstance(exc, StateFileError):
                raise
            raise StateFileError(f"{self.path} is no list of tokens: {exc}") from exc

    def _write(self, tokens: dict[str, Token]) -> None:
        make_private(self.path.parent)
        rows = {digest: asdict(token) for digest, token in tokens.items()}
        write_private(self.path, json.dumps(rows, indent=1).encode())


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
