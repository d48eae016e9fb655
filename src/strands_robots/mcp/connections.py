"""Connections and sessions of the HTTP server: bounds, a reserve for stops.

uvicorn waits for a header and a body as long as the client likes, so half-sent requests could fill the process until no
stop of a true client finds a place. Here each connection has a deadline in every part of a request, those that have
shown no token are few and give way to new ones, and each token has a bound beyond which its stops alone are served.
"""

# mypy: disable-error-code="misc"
from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import re
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum
from itertools import chain, islice
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from strands_robots.mcp._compat import end_session
from strands_robots.mcp.server import MESSAGE_MAX
from strands_robots.serving.verbs import TTL_MAX_S

logger = logging.getLogger(__name__)

CONNECTION = "strands_robots.connection"
"""Key of the connection in the state of a request's scope."""

HEADER_S = 5.0
"""Seconds for a complete header, the TLS handshake included."""

BODY_S = 10.0
"""Seconds for the body after its header."""

IDLE_S = 60
"""Seconds after which a connection without a request is closed."""

STRANGERS_MAX = 128
"""Connections that have shown no token; beyond it the oldest one of the busiest address is closed."""

ADDRESS_MAX = 64
"""The same for one address, or for one /64 network of IPv6."""

TOKEN_MAX = 64
"""Connections of one token; those beyond it serve nothing but stops."""

TOTAL_MAX = 448
"""Connections of all tokens; those beyond it serve nothing but stops."""

RESERVE = 64
"""Connections of one token, and of all tokens, that are left for stops."""

HEADER_MAX = 16 * 1024
"""Bytes of a header."""

_BLANK = re.compile(rb"\n\r?\n")
_LENGTH = re.compile(rb"\ncontent-length:[ \t]*([0-9]{1,12})[ \t]*\r?\n")
_AS_IT_COMES = re.compile(rb"\n(transfer-encoding|expect):")

BACKLOG = 1024
RETRY_S = 0.05
"""Seconds until the next connection is accepted when the process has no file descriptor left."""

KEEPALIVE = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 5000}
"""Options of a connection: its client's machine is gone after 5 s without a sign."""

SESSION_IDLE_S = TTL_MAX_S + 300.0
"""Seconds without a request after which a session is ended; every lease of its client has ended before."""

SESSIONS_OF_TOKEN_MAX = 32
"""Sessions of one token; beyond it the idle one that is missed least is ended."""

SESSIONS_MAX = 256
"""Sessions of all tokens; beyond it one of the token that has the most is ended."""


class Phase(Enum):
    """Part of a request in which a connection is."""

    HEADER = "header"
    BODY = "body"
    SERVING = "serving"
    IDLE = "idle"


DEADLINES = {Phase.HEADER: HEADER_S, Phase.BODY: BODY_S}
GIVES_WAY = (Phase.BODY, Phase.HEADER, Phase.IDLE)
"""Phases in which a connection of a token is closed for a new one of it, in this order."""


class Capacity(Enum):
    """Requests that a connection may serve."""

    ANY = "any"
    STOPS = "stops"
    NONE = "none"


class HttpConnection(H11Protocol):
    """One connection, from its acceptance on.

    Args:
        address: the client's, which shares a bound.
        closed: called with the connection at its end.
        parts: of uvicorn: its configuration, the state of its server and of the application.
    """

    def __init__(self, address: str, closed: Callable[[HttpConnection], None], *parts: Any) -> None:
        config, state, app_state = parts
        super().__init__(config, state, {**app_state, CONNECTION: self})
        self.address = address
        self.owner = ""
        self.phase = Phase.HEADER
        self.opening: asyncio.Task[None] | None = None
        self.open = False
        self._closed = closed
        self._held, self._length = bytearray(), 0
        self._deadline: asyncio.TimerHandle | None = self.loop.call_later(HEADER_S, self.cut)

    def connection_made(self, transport: Any) -> None:
        """Begin, after the handshake of TLS."""
        self.open = True
        super().connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Take bytes of requests; nothing of a request is read before all of it is here."""
        if self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]:
            self._held += data
            if not self._whole():
                self._enter(Phase.BODY if self._length else Phase.HEADER)
                return
            data, self._held, self._length = bytes(self._held), bytearray(), 0
        super().data_received(data)
        self._follow(received=True)

    def on_response_complete(self) -> None:
        """Begin to wait for the next request."""
        super().on_response_complete()
        self._follow(received=False)

    def connection_lost(self, exc: Exception | None) -> None:
        """End what belongs to the connection."""
        self._end()
        super().connection_lost(exc)

    def cut(self) -> None:
        """Close it now, whatever was sent."""
        self._end()
        if self.open:
            self.transport.abort()
        elif self.opening is not None:
            self.opening.cancel()

    def _end(self) -> None:
        self._set_deadline(None)
        self._closed(self)

    def _whole(self) -> bool:
        """Return whether a whole request is held, or one that is refused as it is."""
        if not self._length:
            blank = _BLANK.search(self._held)
            if blank is None:
                return len(self._held) > HEADER_MAX
            header = bytes(self._held[: blank.end()]).lower()
            lengths = _LENGTH.findall(header)
            # A client that asks first, sends chunks or states no single length is read as it sends.
            if len(lengths) != 1 or _AS_IT_COMES.search(header) or int(lengths[0]) > MESSAGE_MAX:
                return True
            self._length = blank.end() + int(lengths[0])
        return len(self._held) >= self._length

    def _follow(self, *, received: bool) -> None:
        if self.transport.is_closing():
            return
        theirs = self.conn.their_state
        if theirs is h11.SEND_BODY:
            phase = Phase.BODY
        elif theirs is h11.IDLE:
            phase = Phase.HEADER if received or self.conn.trailing_data[0] else Phase.IDLE
        else:
            phase = Phase.SERVING
        self._enter(phase)

    def _enter(self, phase: Phase) -> None:
        if phase is not self.phase:
            self.phase = phase
            self._set_deadline(DEADLINES.get(phase))

    def _set_deadline(self, seconds: float | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.cut)


class Connections:
    """All connections of a server, within their bounds."""

    def __init__(self) -> None:
        self._strangers: dict[HttpConnection, None] = {}
        self._owned: dict[str, dict[HttpConnection, None]] = {}

    def enter(self, connection: HttpConnection) -> None:
        """Count a new connection, which has shown no token; an older one may give way."""
        near = [each for each in self._strangers if each.address == connection.address]
        if len(near) >= ADDRESS_MAX:
            near[0].cut()
        elif len(self._strangers) >= STRANGERS_MAX:
            busiest = Counter(each.address for each in self._strangers).most_common(1)[0][0]
            next(each for each in self._strangers if each.address == busiest).cut()
        self._strangers[connection] = None

    def admit(self, connection: HttpConnection, owner: str) -> Capacity:
        """Count a connection for the token that it has shown; return what it serves."""
        if connection.owner != owner:
            self.leave(connection)
            connection.owner = owner
            self._owned.setdefault(owner, {})[connection] = None
        owned = self._owned[owner]
        if len(owned) > TOKEN_MAX:
            _give_way(owned, connection)
        if self._total > TOTAL_MAX:
            _give_way(list(chain.from_iterable(self._owned.values())), connection)
        if len(owned) > TOKEN_MAX + RESERVE or self._total > TOTAL_MAX + RESERVE:
            return Capacity.NONE
        return Capacity.ANY if connection in islice(owned, TOKEN_MAX) and self._total <= TOTAL_MAX else Capacity.STOPS

    def leave(self, connection: HttpConnection) -> None:
        """Forget a connection."""
        self._strangers.pop(connection, None)
        owned = self._owned.get(connection.owner, {})
        owned.pop(connection, None)
        if not owned:
            self._owned.pop(connection.owner, None)

    def give_up_one(self) -> None:
        """Close the oldest connection without a token, where none can be opened."""
        if self._strangers:
            next(iter(self._strangers)).cut()

    @property
    def _total(self) -> int:
        return sum(map(len, self._owned.values()))


class BoundedServer(uvicorn.Server):
    """uvicorn's server, with bounds on connections and a report of its end.

    Args:
        on_exit: called by the signal's handler.
    """

    def __init__(self, config: uvicorn.Config, connections: Connections, on_exit: Callable[[], object]) -> None:
        super().__init__(config)
        self._connections, self._on_exit = connections, on_exit

    def handle_exit(self, sig: int, frame: Any) -> None:
        """Report the signal, then act on it."""
        self._on_exit()
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept connections from now on."""
        await self.lifespan.startup()
        parts = self.config, self.server_state, self.lifespan.state
        acceptors: list[Any] = [_Acceptor(each, self._connections, *parts) for each in sockets or ()]
        self.servers = acceptors
        self.started = True


class _Acceptor:
    """Acceptor of one listening socket, which uvicorn closes as a server of asyncio."""

    def __init__(self, listening: socket.socket, connections: Connections, *parts: Any) -> None:
        self._connections, self._parts = connections, parts
        self._opening: set[asyncio.Task[None]] = set()
        self._accepting = asyncio.ensure_future(self._accept(listening))

    def close(self) -> None:
        """Accept no more."""
        for task in (self._accepting, *self._opening):
            task.cancel()

    async def wait_closed(self) -> None:
        """Wait until nothing is accepted."""
        await asyncio.gather(self._accepting, *self._opening, return_exceptions=True)

    async def _accept(self, listening: socket.socket) -> None:
        listening.setblocking(False)
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, peer = await loop.sock_accept(listening)
            except OSError as problem:
                # No file descriptor is left, or the client has gone.
                logger.warning("A connection was not accepted: %s", problem)
                self._connections.give_up_one()
                await asyncio.sleep(RETRY_S)
                continue
            connection = HttpConnection(network_of(peer[0]), self._connections.leave, *self._parts)
            self._connections.enter(connection)
            connection.opening = opening = asyncio.ensure_future(self._open(connection, accepted))
            self._opening.add(opening)
            opening.add_done_callback(self._opening.discard)
            # One for each turn of the loop, so that a flood of connections delays no request.
            await asyncio.sleep(0)

    async def _open(self, connection: HttpConnection, accepted: socket.socket) -> None:
        tls = self._parts[0].ssl
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: connection, accepted, ssl=tls, ssl_handshake_timeout=HEADER_S if tls else None
            )
        except OSError as problem:
            logger.info("A connection was not opened: %s", problem)
        finally:
            if not connection.open:
                connection.cut()
                accepted.close()


def listener(host: str, port: int) -> socket.socket:
    """Return a listening socket that notices when a client's machine is gone.

    Its client counts as present until then, so its leases are renewed.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.create_server((host, port), family=family, backlog=BACKLOG)
    # asyncio sets this on sockets of a stated protocol only; without it an answer waits 40 ms for the client's kernel.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in KEEPALIVE.items():
        option = getattr(socket, name, None)  # the names differ among systems
        if option is not None:
            listening.setsockopt(socket.IPPROTO_TCP, option, value)
    return listening


def network_of(address: str) -> str:
    """Return what shares a bound: an address of IPv4, a /64 network of IPv6."""
    with contextlib.suppress(ValueError):
        parsed = ipaddress.ip_address(address.partition("%")[0])
        if isinstance(parsed, ipaddress.IPv6Address) and parsed.ipv4_mapped is None and not parsed.is_loopback:
            return str(ipaddress.ip_network((parsed, 64), strict=False))
    return address


def _give_way(connections: Iterable[HttpConnection], to: HttpConnection) -> None:
    """Close the connection that is missed least, if there is one besides ``to``."""
    others = [each for each in connections if each is not to and each.phase in GIVES_WAY]
    if others:
        min(others, key=lambda each: GIVES_WAY.index(each.phase)).cut()


@dataclass
class _Session:
    owner: str
    used_at: float = field(default_factory=time.monotonic)
    uses: int = 1
    open: int = 0


class Sessions:
    """Sessions that the SDK's manager keeps, within bounds: it ends none by itself.

    A session in which a request is open, a stream or a call, is never ended here. Its end halts nothing: what its
    client holds and moves ends with the client's leases, which last shorter than an idle session.

    Args:
        manager: the SDK's ``StreamableHTTPSessionManager``.
    """

    def __init__(self, manager: Any) -> None:
        self.manager = manager
        self._sessions: dict[str, _Session] = {}

    def __len__(self) -> int:
        return len(self._sessions)

    def begin(self, session_id: str, owner: str) -> None:
        """Note a request in a session that is the owner's."""
        session = self._sessions.get(session_id)
        if session is not None and session.owner == owner:
            session.open += 1
            session.uses += 1

    def end(self, session_id: str, owner: str) -> None:
        """Note the end of that request."""
        session = self._sessions.get(session_id)
        if session is not None and session.owner == owner:
            session.open -= 1
            session.used_at = time.monotonic()

    async def opened(self, session_id: str, owner: str) -> None:
        """Keep a new session; an idle one may be ended for it."""
        self._sessions[session_id] = _Session(owner)
        counts = Counter(each.owner for each in self._sessions.values())
        if counts[owner] > SESSIONS_OF_TOKEN_MAX:
            await self._end_one(owner, session_id)
        elif len(self._sessions) > SESSIONS_MAX:
            await self._end_one(counts.most_common(1)[0][0], session_id)

    async def close(self, session_id: str) -> None:
        """End a session."""
        self._sessions.pop(session_id, None)
        await end_session(self.manager, session_id)

    async def close_idle(self) -> None:
        """End the sessions that nobody has used for long."""
        before = time.monotonic() - SESSION_IDLE_S
        for session_id, session in tuple(self._sessions.items()):
            if not session.open and session.used_at < before:
                await self.close(session_id)

    async def _end_one(self, owner: str, new: str) -> None:
        idle = {
            session_id: (each.uses > 1, each.used_at)
            for session_id, each in self._sessions.items()
            if each.owner == owner and not each.open and session_id != new
        }
        if idle:
            # One that was never used after its beginning goes first, so that a flood of them ends no client's.
            await self.close(min(idle, key=lambda each: idle[each]))
