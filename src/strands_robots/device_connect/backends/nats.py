"""Device Connect over NATS, on the framework's wire."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Any

import nats.errors
from device_connect_edge.messaging.exceptions import (
    NotConnectedError,
    PublishError,
    RequestTimeoutError,
    SubscribeError,
)
from nats.aio.client import Client
from nats.aio.msg import Msg

from . import jsonrpc
from ._compat import payload_of
from .base import Backend, NoResponderError, Undo, UnreadableReplyError, too_long
from .config import LinkConfig
from .dispatch import REPLY_SUBJECT, CommandServer, OrderedFeed
from .nats_connection import NatsConnection, connection_for


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
