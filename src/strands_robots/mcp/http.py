"""MCP server over streamable HTTP, for clients with tokens."""

# mypy: disable-error-code="misc"
from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import signal
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import uvicorn
from mcp.server.auth.middleware.bearer_auth import AuthenticatedUser
from mcp.server.auth.provider import AccessToken
from mcp.server.transport_security import TransportSecuritySettings
from starlette.responses import JSONResponse, Response
from starlette.types import Message, Receive, Scope, Send

from strands_robots.errors import StrandsRobotsError
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.safety_console import StandingController
from strands_robots.http_access import Guard, HttpRules, Token, TokenFile, bracketed
from strands_robots.mcp.approval import Approvals
from strands_robots.mcp.caller import Caller, ClientAccess
from strands_robots.mcp.connections import CONNECTION, IDLE_S, BoundedServer, Capacity, Connections, Sessions, listener
from strands_robots.mcp.server import GONE, MESSAGE_MAX, STOPS, THREADS, RobotResources, build
from strands_robots.utils import is_loopback_host

PATH = "/mcp"
PICTURES = "/pictures/"
PICTURES_MAX = 16

LEFT_S = 1.0
"""Seconds without a request after a client closed its standing stream; then it has gone away."""

CLOSE = {"connection": "close"}
BEFORE_A_STOP = ("initialize", "notifications/initialized", "server/discover", "ping", "tools/list")
"""Methods that a client calls before its first stop."""

SHUTDOWN_S = 1
CONNECTING_MAX = 4
LOOK_S = 30.0
"""Seconds between two looks for idle sessions."""

_ACCESS = "strands_robots.access"


@dataclass(frozen=True)
class Address:
    """Address of the server.

    Attributes:
        cert, key: PEM files of TLS.
        hosts: further names by which clients reach it.
    """

    host: str = "127.0.0.1"
    port: int = 8765
    cert: Path | None = None
    key: Path | None = None
    hosts: tuple[str, ...] = ()

    @property
    def loopback(self) -> bool:
        """True where no other machine reaches it."""
        return is_loopback_host(self.host)

    @property
    def url(self) -> str:
        """Address that a client connects to."""
        return f"{self.origin}{PATH}"

    @property
    def origin(self) -> str:
        """Scheme, host and port."""
        return f"http{'s' if self.cert else ''}://{bracketed((self.hosts or (self.host,))[0])}:{self.port}"

    def rules(self) -> HttpRules:
        """Return the Host and Origin headers that requests may have."""
        names = ["127.0.0.1", "localhost", "[::1]"] if self.loopback else [bracketed(self.host)]
        scheme = "https" if self.cert else "http"
        known = (*names, *map(bracketed, self.hosts))
        return HttpRules(frozenset(f"{scheme}://{name}".lower() for name in known), any_port=True)


class _Client:
    """One token's client: its networks, and its open requests."""

    def __init__(self, token: Token, networks: Networks, show_picture: Callable[[bytes], str]) -> None:
        self.token, self.open = token, 0
        caller = Caller(networks, present=lambda: bool(self.open))
        self.access = ClientAccess(caller, approves=token.approves, show_picture=show_picture)


class _Sent:
    """Answer to a request, sent on as it comes.

    Attributes:
        accepted: it began, and is no refusal.
        complete: it has ended.
        session_id: of the session that it names.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self.accepted = self.complete = False
        self.session_id = ""

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.accepted = message["status"] < 400
            self.session_id = _header(message, b"mcp-session-id")
        await self._send(message)
        ended = message["type"] == "http.response.body" and not message.get("more_body", False)
        self.complete = self.complete or ended


class HttpServer:
    """ASGI application that checks tokens, over a server for each permission.

    Args:
        networks_of: returns the networks of a caller's name, not opened yet.
        default: the client without a token, while there is no token and no other machine reaches the server. Its name
            is the server's.
    """

    def __init__(
        self, networks_of: Callable[[str], Networks], tokens: TokenFile, address: Address, default: Token
    ) -> None:
        self._networks_of, self._tokens, self._address, self._default = networks_of, tokens, address, default
        self._clients: dict[Token, asyncio.Task[_Client]] = {}
        self._pictures: dict[str, bytes] = {}
        # Of its own: the other threads may all be reading lists of robots when a new client wants to stop one.
        self._connecting = ThreadPoolExecutor(CONNECTING_MAX, "mcp-connect")
        self._leaving: set[asyncio.Task[None]] = set()
        self._running = AsyncExitStack()
        self._sessions: dict[bool, Sessions] = {}
        self.connections = Connections()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Serve for the length of the block; clients leave at its end."""
        async with AsyncExitStack() as stack:
            self._running = stack
            networks = await self._connected(self._default.name)
            resources, approvals = RobotResources(networks), Approvals()
            standing = StandingController(self._default.name, networks)
            for read_only in (False, True):
                server = build(_access_of, resources, approvals, standing, read_only=read_only)
                # Guard has checked the addresses of a request.
                unchecked = TransportSecuritySettings(enable_dns_rebinding_protection=False)
                server.streamable_http_app(streamable_http_path=PATH, transport_security=unchecked)
                self._sessions[read_only] = Sessions(server.session_manager)
                await stack.enter_async_context(server.session_manager.run())
            await stack.enter_async_context(resources.published())
            stack.push_async_callback(asyncio.to_thread, standing.close)
            standing.open()
            looking = asyncio.ensure_future(self._close_idle())
            try:
                yield
            finally:
                looking.cancel()
                # Before the stack closes the connections of the clients.
                await self.leave_all()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            return
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        if scope["path"].startswith(PICTURES):
            await self._picture(scope["path"].removeprefix(PICTURES))(scope, receive, send)
            return
        if scope["path"] != PATH:
            await Response(status_code=404)(scope, receive, send)
            return
        # Read here and not in a thread: a stop waits for no thread of the pool. It is one small file.
        token = self._token(headers.get(b"authorization", ""))
        if token is None:
            refusal = JSONResponse(
                {"error": "invalid_token", "error_description": "strands-robots keys mcp NAME makes a token"},
                status_code=401,
                headers={"www-authenticate": 'Bearer error="invalid_token"', **CLOSE},
            )
            await refusal(scope, receive, send)
            return
        room = self.connections.admit(scope["state"][CONNECTION], token.name)
        body = b"" if room is Capacity.NONE else await _body(headers, receive)
        if body is None:
            return
        if len(body) > MESSAGE_MAX:
            await _refused(413, f"A message has at most {MESSAGE_MAX} bytes.")(scope, receive, send)
        elif room is Capacity.ANY or (room is Capacity.STOPS and stops(body)):
            await self._serve(await self._client(token), body, scope, receive, send)
        else:
            await _refused(503, "This token has too many connections; stops alone are served.")(scope, receive, send)

    async def _serve(self, client: _Client, body: bytes, scope: Scope, receive: Receive, send: Send) -> None:
        gone, sent_body = asyncio.Event(), False
        # A session of the SDK belongs to the user that began it.
        user = AuthenticatedUser(AccessToken(token="", client_id=client.token.name, scopes=[]))
        inner = {**scope, "user": user, _ACCESS: client.access, GONE: gone}
        answer = _Sent(send)

        async def watch() -> None:
            while (await receive())["type"] != "http.disconnect":
                pass
            gone.set()

        async def received() -> Message:
            nonlocal sent_body
            if not sent_body:
                sent_body = True
                return {"type": "http.request", "body": body, "more_body": False}
            await gone.wait()
            return {"type": "http.disconnect"}

        sessions, session_id = self._sessions[client.token.read_only], _header(scope, b"mcp-session-id")
        name = client.token.name
        client.open += 1
        sessions.begin(session_id, name)
        watching = asyncio.ensure_future(watch())
        try:
            await sessions.manager.handle_request(inner, received, answer)
        finally:
            watching.cancel()
            client.open -= 1
            sessions.end(session_id, name)
            if answer.accepted:
                client.access.caller.used()
            standing = scope["method"] == "GET" or _header(scope, b"mcp-method") == "subscriptions/listen"
            if answer.accepted and (scope["method"] == "DELETE" or (standing and not answer.complete)):
                leaving = asyncio.ensure_future(self._left(client))
                self._leaving.add(leaving)
                leaving.add_done_callback(self._leaving.discard)
            with anyio.CancelScope(shield=True):
                await _keep(sessions, answer, session_id, name, ended=scope["method"] == "DELETE")

    async def _close_idle(self) -> None:
        while True:
            await asyncio.sleep(LOOK_S)
            for sessions in self._sessions.values():
                await sessions.close_idle()

    async def _left(self, client: _Client) -> None:
        """Halt and release what a client has, unless it comes again at once."""
        await asyncio.sleep(LEFT_S)
        if not client.open:
            await client.access.caller.leave()

    def _token(self, header: str) -> Token | None:
        scheme, _, text = header.partition(" ")
        if scheme.lower() == "bearer" and text:
            return self._tokens.find(text.strip())
        return self._default if self._address.loopback and not (header or self._tokens.names()) else None

    async def _client(self, token: Token) -> _Client:
        client = self._clients.get(token)
        if client is None or (client.done() and (client.cancelled() or client.exception())):
            client = self._clients[token] = asyncio.ensure_future(self._new_client(token))
        return await asyncio.shield(client)

    async def _new_client(self, token: Token) -> _Client:
        client = _Client(token, await self._connected(token.name), self._show)
        self._running.callback(client.access.caller.close)
        return client

    async def _connected(self, name: str) -> Networks:
        networks = self._networks_of(name)
        await asyncio.get_running_loop().run_in_executor(self._connecting, networks.open)
        self._running.push_async_callback(asyncio.to_thread, networks.close)
        return networks

    async def leave_all(self) -> None:
        """Halt and release what every client has."""
        for leaving in self._leaving:
            leaving.cancel()
        connected = [each.result() for each in self._clients.values() if each.done() and not each.exception()]
        await asyncio.gather(*(client.access.caller.leave() for client in connected))
        self._connecting.shutdown(wait=False)

    def _show(self, jpeg: bytes) -> str:
        name = f"{secrets.token_urlsafe(24)}.jpg"
        self._pictures[name] = jpeg
        while len(self._pictures) > PICTURES_MAX:
            del self._pictures[next(iter(self._pictures))]
        return f"{self._address.origin}{PICTURES}{name}"

    def _picture(self, name: str) -> Response:
        # Its name cannot be guessed; a browser that shows it has no token.
        jpeg = self._pictures.get(name)
        return Response(status_code=404) if jpeg is None else Response(jpeg, media_type="image/jpeg")


def require_secure(address: Address, tokens: TokenFile) -> None:
    """Refuse to leave this machine without TLS and a token.

    Raises:
        StrandsRobotsError: either is missing.
    """
    if (address.cert is None) != (address.key is None):
        raise StrandsRobotsError("--http-cert and --http-key go together.")
    if address.loopback:
        return
    if address.cert is None:
        raise StrandsRobotsError(f"{address.host} is beyond this machine and needs TLS: --http-cert and --http-key.")
    if not tokens.names():
        raise StrandsRobotsError(
            f"{address.host} is beyond this machine and needs a token: strands-robots keys mcp NAME."
        )


async def serve_http(
    networks_of: Callable[[str], Networks], address: Address, *, default: Token, ready: Callable[[str], object]
) -> None:
    """Serve clients over HTTP until the process is told to end.

    Args:
        networks_of, default: as of :class:`HttpServer`.
        ready: called with the URL once it listens.
    """
    tokens = TokenFile()
    require_secure(address, tokens)
    app = HttpServer(networks_of, tokens, address, default)
    config = uvicorn.Config(
        # Nothing happens for a page of another origin, whatever its method and its session.
        Guard(app, address.rules()),
        lifespan="off",
        log_level="warning",
        ssl_certfile=address.cert,
        ssl_keyfile=address.key,
        timeout_graceful_shutdown=SHUTDOWN_S,
        timeout_keep_alive=IDLE_S,
        # A connection that became another protocol's would be within no bound.
        ws="none",
    )
    loop = asyncio.get_running_loop()
    loop.set_default_executor(ThreadPoolExecutor(THREADS, "mcp-search"))
    leaving: list[asyncio.Future[None]] = []

    def leave() -> None:
        leaving.append(asyncio.ensure_future(app.leave_all()))

    server = BoundedServer(config, app.connections, lambda: loop.call_soon_threadsafe(leave))
    for each in (signal.SIGTERM, signal.SIGINT):
        # uvicorn raises a signal again at its end; the robots are halted first, and then the process ends by itself.
        signal.signal(each, lambda *_: None)
    with listener(address.host, address.port) as listening:
        async with app.running():
            ready(address.url)
            await server.serve(sockets=[listening])


def stops(body: bytes) -> bool:
    """Return whether a message is a stop, or what a client says before its first one."""
    try:
        message = json.loads(body)
        method, params = message["method"], message.get("params")
        return method in BEFORE_A_STOP or (method == "tools/call" and params["name"] in STOPS)
    except (ValueError, RecursionError, TypeError, KeyError, AttributeError):
        return False


async def _body(headers: Mapping[bytes, str], receive: Receive) -> bytes | None:
    """Return a request's body, cut behind its bound; None where its client left."""
    length = headers.get(b"content-length", "")
    if length.isdecimal() and (len(length) > 9 or int(length) > MESSAGE_MAX):
        return bytes(MESSAGE_MAX + 1)
    body = bytearray()
    while len(body) <= MESSAGE_MAX:
        message = await receive()
        if message["type"] != "http.request":
            return None
        body += message.get("body", b"")
        if not message.get("more_body", False):
            break
    return bytes(body)


async def _keep(sessions: Sessions, answer: _Sent, asked: str, owner: str, *, ended: bool) -> None:
    """Keep the session that a request began; end that of a refusal, or a DELETE."""
    if ended and answer.accepted:
        await sessions.close(asked)
    elif answer.session_id and not asked:
        await (sessions.opened(answer.session_id, owner) if answer.accepted else sessions.close(answer.session_id))


def _refused(status: int, why: str) -> Response:
    return JSONResponse({"error": why}, status_code=status, headers=CLOSE)


def _access_of(context: Any) -> ClientAccess:
    access: ClientAccess = context.request_context.request.scope[_ACCESS]
    return access


def _header(message: Mapping[str, Any], name: bytes) -> str:
    """Return a header of a scope or of an answer's start, empty where there is none."""
    return next((value.decode("latin-1") for each, value in message["headers"] if each.lower() == name), "")
