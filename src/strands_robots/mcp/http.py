"""MCP server over streamable HTTP, for clients with tokens."""

# mypy: disable-error-code="misc"
from __future__ import annotations

import asyncio
import contextlib
import secrets
import signal
import socket
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn
from mcp.server.auth.middleware.bearer_auth import AuthenticatedUser
from mcp.server.auth.provider import AccessToken
from mcp.server.transport_security import TransportSecuritySettings
from starlette.responses import JSONResponse, Response
from starlette.types import Message, Receive, Scope, Send

from strands_robots.device_connect import FleetClient
from strands_robots.errors import StrandsRobotsError
from strands_robots.mcp.access import ClientAccess
from strands_robots.mcp.approval import Approvals
from strands_robots.mcp.caller import Caller
from strands_robots.mcp.resources import RobotResources
from strands_robots.mcp.server import GONE, build
from strands_robots.mcp.tokens import Token, TokenFile
from strands_robots.utils import is_loopback_host

PATH = "/mcp"
PICTURES = "/pictures/"
PICTURES_MAX = 16
MESSAGES_MAX = 8

LEFT_S = 1.0
"""Seconds without a request after a client closed its standing stream; then it has gone away."""

KEEPALIVE = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 5000}
"""Options of a connection: its client's machine is gone after 5 s without a sign."""

SHUTDOWN_S = 1
CONNECTING_MAX = 4

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
        return f"http{'s' if self.cert else ''}://{_bracketed((self.hosts or (self.host,))[0])}:{self.port}"

    def security(self) -> Any:
        """Return the Host and Origin headers that requests may have."""
        names = ["127.0.0.1", "localhost", "[::1]"] if self.loopback else [_bracketed(self.host)]
        names += [_bracketed(each) for each in self.hosts]
        scheme = "https" if self.cert else "http"
        return TransportSecuritySettings(
            allowed_hosts=[*(f"{name}:*" for name in names), *names],
            allowed_origins=[*(f"{scheme}://{name}:*" for name in names), *(f"{scheme}://{name}" for name in names)],
        )


class _Client:
    """One token's client: its connection to the robots, and its open requests."""

    def __init__(self, token: Token, caller: Caller, show_picture: Callable[[bytes], str]) -> None:
        self.token = token
        self.access = ClientAccess(caller, approves=token.approves, show_picture=show_picture)
        self.open = 0


class HttpServer:
    """ASGI application that checks tokens, over a server for each permission.

    Args:
        link_fleet: connects to the robots under a caller's name.
        default: the client without a token, while there is no token; None requires one.
    """

    def __init__(
        self, link_fleet: Callable[[str], FleetClient], tokens: TokenFile, address: Address, default: Token | None
    ) -> None:
        self._link_fleet, self._tokens, self._address, self._default = link_fleet, tokens, address, default
        self._clients: dict[Token, asyncio.Task[_Client]] = {}
        self._pictures: dict[str, bytes] = {}
        # Of its own: the other threads may all be reading lists of robots when a new client wants to stop one.
        self._connecting = ThreadPoolExecutor(CONNECTING_MAX, "mcp-connect")
        self._leaving: set[asyncio.Task[None]] = set()
        self._running = AsyncExitStack()
        self._servers: dict[bool, Any] = {}

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Serve for the length of the block; clients leave at its end."""
        async with AsyncExitStack() as stack:
            self._running = stack
            fleet = await self._connected("mcp-resources")
            resources, approvals = RobotResources(fleet), Approvals()
            for read_only in (False, True):
                server = build(_access_of, resources, approvals, read_only=read_only)
                server.streamable_http_app(
                    streamable_http_path=PATH, transport_security=self._address.security(), host=self._address.host
                )
                self._servers[read_only] = server.session_manager
                await stack.enter_async_context(server.session_manager.run())
            await stack.enter_async_context(resources.published())
            try:
                yield
            finally:
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
                headers={"www-authenticate": 'Bearer error="invalid_token"'},
            )
            await refusal(scope, receive, send)
            return
        await self._serve(await self._client(token), scope, receive, send)

    async def _serve(self, client: _Client, scope: Scope, receive: Receive, send: Send) -> None:
        gone = asyncio.Event()
        # A session of the SDK belongs to the user that began it.
        user = AuthenticatedUser(AccessToken(token="", client_id=client.token.name, scopes=[]))
        inner = {**scope, "user": user, _ACCESS: client.access, GONE: gone}
        messages: asyncio.Queue[Message] = asyncio.Queue(MESSAGES_MAX)
        answered = False

        async def pump() -> None:
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    gone.set()
                await messages.put(message)
                if gone.is_set():
                    return

        async def sent(message: Message) -> None:
            nonlocal answered
            await send(message)
            answered = answered or (message["type"] == "http.response.body" and not message.get("more_body", False))

        client.open += 1
        client.access.caller.used()
        pumping = asyncio.ensure_future(pump())
        try:
            await self._servers[client.token.read_only].handle_request(inner, messages.get, sent)
        finally:
            pumping.cancel()
            client.open -= 1
            client.access.caller.used()
            standing = scope["method"] == "GET" or _header(scope, b"mcp-method") == "subscriptions/listen"
            if scope["method"] == "DELETE" or (standing and not answered):
                leaving = asyncio.ensure_future(self._left(client))
                self._leaving.add(leaving)
                leaving.add_done_callback(self._leaving.discard)

    async def _left(self, client: _Client) -> None:
        """Halt and release what a client has, unless it comes again at once."""
        await asyncio.sleep(LEFT_S)
        if not client.open:
            await client.access.caller.leave()

    def _token(self, header: str) -> Token | None:
        scheme, _, text = header.partition(" ")
        if scheme.lower() == "bearer" and text:
            return self._tokens.find(text.strip())
        return None if header or self._tokens.names() else self._default

    async def _client(self, token: Token) -> _Client:
        client = self._clients.get(token)
        if client is None or (client.done() and (client.cancelled() or client.exception())):
            client = self._clients[token] = asyncio.ensure_future(self._new_client(token))
        return await asyncio.shield(client)

    async def _new_client(self, token: Token) -> _Client:
        made: list[_Client] = []
        caller = Caller(await self._connected(token.name), present=lambda: any(each.open for each in made))
        self._running.callback(caller.close)
        made.append(_Client(token, caller, self._show))
        return made[0]

    async def _connected(self, name: str) -> FleetClient:
        fleet = self._link_fleet(name)
        await asyncio.get_running_loop().run_in_executor(self._connecting, fleet.__enter__)
        self._running.push_async_callback(asyncio.to_thread, fleet.close)
        return fleet

    async def leave_all(self) -> None:
        """Halt and release what every client has."""
        for leaving in self._leaving:
            leaving.cancel()
        made = [each.result() for each in self._clients.values() if each.done() and not each.exception()]
        await asyncio.gather(*(client.access.caller.leave() for client in made))
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


class _Server(uvicorn.Server):
    """uvicorn's server, which reports at once that it was told to end."""

    on_exit: Callable[[], object] = staticmethod(lambda: None)

    def handle_exit(self, sig: int, frame: Any) -> None:
        self.on_exit()
        super().handle_exit(sig, frame)


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
    link_fleet: Callable[[str], FleetClient], address: Address, *, default: Token, ready: Callable[[str], object]
) -> None:
    """Serve clients over HTTP until the process is told to end.

    Args:
        default: the client without a token, while this machine has no token and no other reaches the server.
        ready: called with the URL once it listens.
    """
    tokens = TokenFile()
    require_secure(address, tokens)
    app = HttpServer(link_fleet, tokens, address, default if address.loopback else None)
    config = uvicorn.Config(
        app,
        lifespan="off",
        log_level="warning",
        ssl_certfile=address.cert,
        ssl_keyfile=address.key,
        timeout_graceful_shutdown=SHUTDOWN_S,
        timeout_keep_alive=60,
    )
    loop = asyncio.get_running_loop()
    leaving: list[asyncio.Future[None]] = []
    server = _Server(config)
    server.on_exit = lambda: loop.call_soon_threadsafe(lambda: leaving.append(asyncio.ensure_future(app.leave_all())))
    for each in (signal.SIGTERM, signal.SIGINT):
        # uvicorn raises a signal again at its end; the robots are halted first, and then the process ends by itself.
        signal.signal(each, lambda *_: None)
    with listener(address.host, address.port) as listening:
        async with app.running():
            ready(address.url)
            await server.serve(sockets=[listening])


def listener(host: str, port: int) -> socket.socket:
    """Return a listening socket that notices when a client's machine is gone.

    Its client counts as present until then, so its leases are renewed.
    """
    listening = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    # asyncio sets this on sockets of a stated protocol only; without it an answer waits 40 ms for the client's kernel.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in KEEPALIVE.items():
        option = getattr(socket, name, None)  # the names differ among systems
        if option is not None:
            listening.setsockopt(socket.IPPROTO_TCP, option, value)
    return listening


def _access_of(context: Any) -> ClientAccess:
    access: ClientAccess = context.request_context.request.scope[_ACCESS]
    return access


def _header(scope: Scope, name: bytes) -> str:
    return next((value.decode("latin-1") for each, value in scope["headers"] if each.lower() == name), "")


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
