"""Device Connect over NATS, on the framework's wire.

A ``nats-py`` client belongs to one event loop, and credentials to one link. Devices that have both in common share one
connection: one descriptor, and one subscription for a subject that all of them follow.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import nats.errors
from device_connect_edge.messaging.exceptions import (
    AuthenticationError,
    MessagingConnectionError,
    NotConnectedError,
    PublishError,
    RequestTimeoutError,
    SubscribeError,
)
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription

from ...utils import redacted
from . import jsonrpc
from ._compat import EncryptedClient, direct_parser, payload_of
from .base import Backend, NoResponderError, Undo, UnreadableReplyError, too_long
from .config import DEFAULT_URL, LinkConfig
from .dial import client_context, reason_of
from .dispatch import REPLY_SUBJECT, CommandServer, Fanout, OrderedFeed, Throttled

logger = logging.getLogger(__name__)

RECONNECT_WAIT_S = 0.5
"""Seconds between attempts to reach a server that went away."""

DENIED = "permissions violation for publish to"
"""Words of a NATS server before the subject that a client may not publish to, in the small letters of nats-py."""

SUBJECT_MAX = 300

PROBLEMS_KEPT = 8
"""Errors of a connection that are kept, to name the last one where it cannot be made."""

Sign = Callable[[str | bytes], bytes]
OnLink = Callable[[bool], Awaitable[None]]
"""Awaited with True when the server is back, with False when it is lost."""

Sink = Callable[[Msg], None]
"""Takes a message over on the loop; returns at once."""


class NatsBackend(Backend):
    """A messaging client on a NATS connection."""

    def __init__(self, link: LinkConfig, *, open_ended: bool = False) -> None:
        super().__init__(link, open_ended=open_ended)
        self._connection: NatsConnection | None = None
        self._listening: list[Undo] = []
        self._closing = False

    async def connect(
        self,
        servers: list[str],
        credentials: dict[str, Any] | None = None,
        tls_config: dict[str, Any] | None = None,
        reconnect_cb: Callable[[], Awaitable[None]] | None = None,
        disconnect_cb: Callable[[], Awaitable[None]] | None = None,
        **_options: Any,
    ) -> None:
        """Connect, and stay connected: a lost server is tried again for ever.

        Raises:
            AuthenticationError: the server refuses the credentials.
            MessagingConnectionError: no server answered within the link's ``connect_timeout_s``.
        """
        link = self._fill_link(servers, credentials, tls_config)

        async def on_link(back: bool) -> None:
            callback = reconnect_cb if back else disconnect_cb
            if callback is not None and not self._closing:
                await callback()

        connection = connection_for(link, (credentials or {}).get("signature_cb"))
        await connection.enter(self, on_link)
        self._connection = connection

    async def publish(self, subject: str, data: bytes) -> None:
        """Send ``data``.

        Raises:
            NotConnectedError: no server at this moment; nothing is kept for later, when it would be stale.
            PublishError: the server would refuse it: too large, or a bad subject; or the caller no longer waits for
                this reply.
        """
        if subject.startswith(REPLY_SUBJECT):
            await self._publish_reply(subject, data)
            return
        client = self._connected
        if len(data) > client.max_payload:
            raise PublishError(f"{len(data)} bytes for {subject}: the NATS server takes at most {client.max_payload}")
        try:
            await client.publish(subject, data)
        except nats.errors.Error as error:
            raise PublishError(f"cannot publish on {subject}: {error}") from error

    async def request(self, subject: str, data: bytes, timeout: float = 5.0) -> bytes:  # noqa: ASYNC109 - the framework's signature
        """Return the first reply to ``data``.

        Raises:
            NoResponderError: no device serves ``subject``.
            RequestTimeoutError: a device does, but gave no reply within ``timeout`` seconds.
            PublishError: the server would refuse the request.
            UnreadableReplyError: the reply is out of bounds.
            NotConnectedError: no server at this moment.
        """
        client = self._connected
        try:
            answer = await client.request(subject, data, timeout=timeout)
        except nats.errors.NoRespondersError as error:
            raise NoResponderError(f"no device answers on {subject}") from error
        except (nats.errors.TimeoutError, TimeoutError) as error:
            raise RequestTimeoutError(f"no reply on {subject} within {timeout:g} s") from error
        except nats.errors.Error as error:
            raise PublishError(f"cannot ask {subject}: {error}") from error
        why = too_long(answer.data)
        if why:
            raise UnreadableReplyError(f"{subject}: {why}")
        payload: bytes = answer.data
        return payload

    async def listen(self, subject: str, sink: Callable[[bytes | int, str], None]) -> None:
        """Have ``sink(data, subject)`` called on the loop as each message arrives.

        ``data`` is the number of its bytes where there are too many to be read. It lasts until ``close``, and ``sink``
        returns at once. Unlike ``subscribe`` it keeps no backlog.

        Raises:
            NotConnectedError: not connected.
            SubscribeError: the subject is malformed.
        """

        def take(message: Msg) -> None:
            sink(payload_of(message), message.subject)

        self._listening.append(await self._subscribed(subject, "", take))

    async def flush(self) -> None:
        """Wait until the server has everything sent so far, subscriptions too."""
        if self.is_connected:
            with contextlib.suppress(nats.errors.Error):  # a connection that is lost has nothing to flush
                # nats-py writes its PING before what it still holds back; only the second one follows all of that.
                await self._connected.flush(timeout=2)
                await self._connected.flush(timeout=2)

    async def close(self) -> None:
        """Unsubscribe, send what is pending, and leave the connection."""
        self._closing = True
        listening, self._listening = self._listening, []
        for undo in listening:
            await undo()
        await self._unsubscribe_all()
        await self.flush()
        connection, self._connection = self._connection, None
        if connection is not None:
            await connection.leave(self)

    def denied(self, subject: str) -> str:
        """Return what the server said to refuse a message to ``subject``, or ""."""
        return self._connection.denied.get(subject.lower(), "") if self._connection is not None else ""

    @property
    def is_connected(self) -> bool:
        """True while a server is there."""
        return self._connection is not None and bool(self._connection.client.is_connected)

    @property
    def is_closed(self) -> bool:
        """True after ``close``."""
        return self._closing or (self._connection is not None and bool(self._connection.client.is_closed))

    @property
    def _connected(self) -> Client:
        """The client of the connection.

        Raises:
            NotConnectedError: no server at this moment.
        """
        if self._connection is None or not self._connection.client.is_connected:
            raise NotConnectedError("not connected to NATS")
        return self._connection.client

    async def _declare(
        self,
        subject: str,
        queue: str | None,
        consumer: CommandServer | OrderedFeed,
        *,
        answers: bool = True,
        with_subject: bool = False,
    ) -> Undo:
        def feed(message: Msg) -> None:
            if isinstance(consumer, CommandServer):
                consumer.receive(message)
            else:
                matched = (message.subject,) if with_subject else ()
                consumer.accept(payload_of(message), *matched, message.reply or None)

        return await self._subscribed(subject, queue or "", feed)

    async def _subscribed(self, subject: str, queue: str, sink: Callable[[Msg], None]) -> Undo:
        # Without a connection this raises.
        connected, connection = self._connected, self._connection
        assert connected is not None and connection is not None
        try:
            return await connection.subscribe(subject, queue, sink)
        except nats.errors.Error as error:
            raise SubscribeError(f"cannot subscribe to {subject}: {error}") from error

    @staticmethod
    def _read(message: Msg) -> tuple[bytes | int, str | None]:
        return payload_of(message), message.reply or None

    async def _answer(self, reply: str, data: bytes) -> None:
        with contextlib.suppress(PublishError, NotConnectedError):  # the caller is out of reach
            await self.publish(reply, jsonrpc.sendable(data, self._connected.max_payload))

    def _call_soon(self, function: Callable[[], None]) -> None:
        asyncio.get_running_loop().call_soon(function)


class NatsConnection:
    """One connection with its users, and its subscriptions by subject."""

    def __init__(self, link: LinkConfig, sign: Sign | None) -> None:
        self.link = link
        self.client = EncryptedClient() if link.encrypted else Client()
        self._parser = direct_parser(self.client)
        self._sign = sign
        self._users: dict[object, OnLink] = {}
        self._opening: asyncio.Task[None] | None = None
        self._closing = False
        self._declaring = asyncio.Lock()
        self._topics: dict[str, Fanout] = {}
        self._log = Throttled(logger)
        self.denied: dict[str, str] = {}
        """What the server said to refuse a message, by its subject; the last ones."""

    async def enter(self, user: object, on_link: OnLink) -> None:
        """Add a user; the first one connects, and the others wait for it.

        Raises:
            AuthenticationError: the server refuses the credentials.
            MessagingConnectionError: no server answered within the link's ``connect_timeout_s``.
        """
        self._users[user] = on_link
        if self._opening is None:
            self._opening = asyncio.create_task(self._open())
        try:
            await asyncio.shield(self._opening)
        except BaseException:
            await self.leave(user)
            raise

    async def leave(self, user: object) -> None:
        """Remove a user; the last one closes the connection."""
        if self._users.pop(user, None) is None or self._users:
            return
        self._closing = True
        key = (asyncio.get_running_loop(), self.link)
        if _CONNECTIONS.get(key) is self:
            del _CONNECTIONS[key]
        if self._opening is not None and not self._opening.done():
            self._opening.cancel()
            await asyncio.gather(self._opening, return_exceptions=True)
        # A client that was never connected has nothing to close, and nats-py trips over it.
        if self.client.is_connected or self.client.is_reconnecting:
            await self.client.close()

    async def subscribe(self, subject: str, queue: str, sink: Sink) -> Callable[[], Awaitable[None]]:
        """Have ``sink`` called for every message on ``subject``; the result undoes it.

        Raises:
            nats.errors.Error: the server would refuse it.
        """
        if queue:
            return partial(self._unsubscribe, await self._subscribe(subject, queue, sink))
        async with self._declaring:
            topic = self._topics.get(subject)
            if topic is None:
                topic = Fanout()
                topic.subscription = await self._subscribe(subject, "", topic.deliver)
                self._topics[subject] = topic
            topic.sinks = (*topic.sinks, sink)
        return partial(self._forget, subject, topic, sink)

    async def _subscribe(self, subject: str, queue: str, sink: Sink) -> Subscription:
        async def on_message(message: Msg) -> None:
            sink(message)

        subscription = await self.client.subscribe(subject, queue=queue, cb=on_message)
        self._parser.hand_over(subscription, sink)
        return subscription

    async def _unsubscribe(self, subscription: Subscription) -> None:
        self._parser.forget(subscription)
        # A closed connection has dropped its subscriptions already.
        with contextlib.suppress(nats.errors.Error):
            await subscription.unsubscribe()

    async def _forget(self, subject: str, topic: Fanout, sink: Sink) -> None:
        async with self._declaring:
            topic.sinks = tuple(each for each in topic.sinks if each is not sink)
            if topic.sinks or self._topics.get(subject) is not topic:
                return
            del self._topics[subject]
            await self._unsubscribe(topic.subscription)

    async def _open(self) -> None:
        link, problems = self.link, list[str]()

        async def on_error(error: Exception) -> None:
            problems.append(reason_of(error))
            del problems[:-PROBLEMS_KEPT]
            self._note_denied(str(error))
            # Why no connection comes about is told by our exception, and a lost one by _report_link.
            unlinked = isinstance(error, (OSError, TimeoutError, nats.errors.UnexpectedEOF))
            log = logger.debug if unlinked else self._log.warning
            log("NATS: %s", problems[-1])

        options: dict[str, Any] = {
            "servers": list(link.connect) or [DEFAULT_URL],
            "connect_timeout": link.connect_timeout_s,
            "reconnect_time_wait": RECONNECT_WAIT_S,
            "max_reconnect_attempts": -1,
            "disconnected_cb": partial(self._report_link, False),
            "reconnected_cb": partial(self._report_link, True),
            "error_cb": on_error,
        }
        if link.jwt:
            options["user_jwt_cb"] = lambda: bytearray(link.jwt.encode())
            options["signature_cb"] = self._sign or partial(_signed, link.nkey_seed)
        where = ", ".join(link.connect) or DEFAULT_URL
        try:
            if link.encrypted:
                options["tls"] = client_context(link)
            async with asyncio.timeout(link.connect_timeout_s):
                await self.client.connect(**options)
        except (TimeoutError, OSError, nats.errors.Error) as error:
            await self._abandon()
            refused = [each for each in problems if "authorization" in each.lower()]
            reasons = refused or problems
            reason = reasons[-1] if reasons else reason_of(error) or f"no answer within {link.connect_timeout_s:g} s"
            kind = AuthenticationError if "authorization" in reason.lower() else MessagingConnectionError
            raise kind(redacted(f"no NATS connection to {where}: {reason}")) from error
        except asyncio.CancelledError:
            await self._abandon()
            raise

    def _note_denied(self, problem: str) -> None:
        """Keep a refusal to publish; the server names the subject in quotes."""
        at = problem.lower().find(DENIED)
        subject = problem[at + len(DENIED) :].strip().strip("\"'") if at >= 0 else ""
        if subject:
            self.denied[subject[:SUBJECT_MAX].lower()] = problem[:SUBJECT_MAX]
            while len(self.denied) > PROBLEMS_KEPT:
                del self.denied[next(iter(self.denied))]

    async def _abandon(self) -> None:
        self._closing = True
        await self.client.close()

    async def _report_link(self, back: bool) -> None:
        if self._closing:
            return
        where = redacted(", ".join(self.link.connect) or DEFAULT_URL)
        if back:
            logger.warning("The NATS server at %s is back.", where)
        else:
            logger.warning("The NATS server at %s is gone. It is tried again every %g s.", where, RECONNECT_WAIT_S)
        for on_link in tuple(self._users.values()):
            await on_link(back)


_CONNECTIONS: dict[tuple[asyncio.AbstractEventLoop, LinkConfig], NatsConnection] = {}


def connection_for(link: LinkConfig, sign: Sign | None = None) -> NatsConnection:
    """Return the running loop's connection for ``link``; a private one with ``sign``."""
    if sign is not None:
        return NatsConnection(link, sign)
    key = (asyncio.get_running_loop(), link)
    if key not in _CONNECTIONS:
        _CONNECTIONS[key] = NatsConnection(link, None)
    return _CONNECTIONS[key]


def _signed(seed: str, nonce: str | bytes) -> bytes:
    """Sign the server's nonce with the seed's key; in base64."""
    import nkeys  # type: ignore[import-untyped]  # noqa: PLC0415 - only credentials need it

    challenge = nonce.encode() if isinstance(nonce, str) else nonce
    return base64.b64encode(nkeys.from_seed(seed.encode()).sign(challenge))
