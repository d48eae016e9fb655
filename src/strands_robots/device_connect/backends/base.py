"""Base of the messaging clients: subscriptions, served commands, owed replies."""

from __future__ import annotations

import json
import uuid
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any

from device_connect_edge.messaging.base import MessagingClient, Subscription
from device_connect_edge.messaging.exceptions import PublishError, RequestTimeoutError

from ...bounded_json import LONG_MAX, MESSAGE_MAX, SMALL_BYTES, refusal
from ...errors import StrandsRobotsError
from . import jsonrpc
from .config import LinkConfig
from .dispatch import CommandServer, Handler, OrderedFeed, PendingReplies, Serve, relaying, send

STOPS_PER_S = 200
"""Emergency stops of one subscription that a handler is called with in a second; it loses those beyond."""

Undo = Callable[[], Awaitable[None]]
"""Ends what was declared on the network."""


class NoResponderError(StrandsRobotsError, RequestTimeoutError, PublishError):  # type: ignore[misc]  # untyped
    """No device serves the subject; known at once and not after the deadline.

    The framework raises ``RequestTimeoutError`` for this over Zenoh and ``PublishError`` over NATS; this is both.
    """


class ResponderLostError(NoResponderError):
    """The device that got the request left the network before it replied."""


def _short_stop(size: int) -> bytes:
    """Encode a stop for foreign handlers, in place of one of ``size`` bytes."""
    params = {"event_id": uuid.uuid4().hex, "reason": f"an emergency stop of {size} bytes, which was not read"}
    return json.dumps({"jsonrpc": "2.0", "method": "emergencyStop", "params": params}).encode()


def too_long(reply: bytes | int) -> str:
    """Return the reason why a reply is not given to who asked, or nothing.

    Args:
        reply: its bytes, or their number where there are too many.
    """
    why = f"it has {reply} bytes" if isinstance(reply, int) else refusal(reply, LONG_MAX)
    return f"the reply is not read: {why}" if why else ""


class UnreadableReplyError(StrandsRobotsError, PublishError):  # type: ignore[misc]  # untyped
    """A reply came that is out of bounds, and was not parsed."""


class ServedSubscription(Subscription):  # type: ignore[misc]  # the framework has no type information
    """A subscription with its consumer; ends once."""

    def __init__(
        self, undo: Undo, consumer: CommandServer | OrderedFeed, forget: Callable[[ServedSubscription], None]
    ) -> None:
        self._undo: Undo | None = undo
        self._consumer = consumer
        self._forget = forget

    async def unsubscribe(self) -> None:
        """Stop receiving; cancels what is being served."""
        undo, self._undo = self._undo, None
        self._forget(self)
        if undo is not None:
            await undo()
            await self._consumer.close()


class Backend(MessagingClient):  # type: ignore[misc]  # the framework has no type information
    """A messaging client whose transport a subclass adds.

    Args:
        link: what to connect to.
        open_ended: take what the link leaves open from the arguments of ``connect``.
    """

    def __init__(self, link: LinkConfig, *, open_ended: bool = False) -> None:
        self._link = link
        self._open_ended = open_ended
        self._replies = PendingReplies()
        self._subscriptions: set[ServedSubscription] = set()

    @property
    def link(self) -> LinkConfig:
        """The link as it is used, with what ``connect`` was given filled in."""
        return self._link

    @property
    def links(self) -> int:
        """Peers that this one is linked to; 0 where a server stands between."""
        return 0

    async def request_once(self, subject: str, data: bytes, within: float) -> bytes:
        """Return the first reply to ``data``, asking once.

        Raises:
            NoResponderError: no device serves ``subject`` at this moment.
            RequestTimeoutError, NotConnectedError, PublishError: as ``request``.
        """
        answer: bytes = await self.request(subject, data, timeout=within)
        return answer

    async def subscribe(
        self,
        subject: str,
        callback: Handler,
        queue: str | None = None,
        subscribe_only: bool = False,
    ) -> Subscription:
        """Have ``callback(data, reply_subject)`` called; ``.cmd`` is served concurrently.

        Raises:
            NotConnectedError: not connected.
            SubscribeError: the subject is malformed.
        """
        if subject.endswith((".cmd", "/cmd")) and not subscribe_only:
            return await self._serve(subject, queue, relaying(callback, self._replies))
        feed = self._feed(subject, callback)
        return await self._consumed(subject, queue, feed, answers=not subscribe_only)

    async def serve(self, subject: str, serve: Serve) -> Subscription:
        """Have every command on ``subject`` answered by ``serve``, concurrently.

        Raises:
            NotConnectedError: not connected.
            SubscribeError: the subject is malformed.
        """
        return await self._serve(subject, None, serve)

    async def subscribe_with_subject(
        self,
        subject: str,
        callback: Callable[[bytes, str, str | None], Awaitable[None]],
        queue: str | None = None,
        subscribe_only: bool = False,
    ) -> Subscription:
        """Have ``callback(data, subject, reply)`` called with the subject that matched."""
        feed = self._feed(subject, callback)
        return await self._consumed(subject, queue, feed, answers=not subscribe_only, with_subject=True)

    async def subscribe_to_stops(
        self, subject: str, callback: Callable[[bytes | int, str, str | None], Awaitable[None]]
    ) -> Subscription:
        """Have ``callback(data, subject, reply)`` called with emergency stops.

        ``data`` is the number of bytes of a stop that is too long to be read.
        """
        feed = self._feed(subject, callback, lambda size: size)
        return await self._consumed(subject, None, feed, answers=False, with_subject=True)

    def _feed(
        self,
        subject: str,
        callback: Callable[..., Awaitable[None]],
        unread: Callable[[int], bytes | int | None] = _short_stop,
    ) -> OrderedFeed:
        if not subject.endswith("emergencyStop"):
            return OrderedFeed(subject, callback, self._call_soon, longest=MESSAGE_MAX)
        # The e-stop listener has every stop by a link of its own; here a flood of them would take its computing time.
        return OrderedFeed(subject, callback, self._call_soon, per_s=STOPS_PER_S, longest=SMALL_BYTES, unread=unread)

    async def _serve(self, subject: str, queue: str | None, serve: Serve) -> Subscription:
        server = CommandServer(subject, serve, self._read, self._answer, self._call_soon)
        return await self._consumed(subject, queue, server)

    async def _consumed(
        self, subject: str, queue: str | None, consumer: CommandServer | OrderedFeed, **options: bool
    ) -> Subscription:
        try:
            undo = await self._declare(subject, queue, consumer, **options)
        except BaseException:
            await consumer.close()
            raise
        subscription = ServedSubscription(undo, consumer, self._subscriptions.discard)
        self._subscriptions.add(subscription)
        return subscription

    async def _publish_reply(self, subject: str, data: bytes) -> None:
        answer = self._replies.take(subject)
        if answer is None:
            raise PublishError("the caller no longer waits for this reply")
        await send(answer, jsonrpc.sendable(data))

    async def _unsubscribe_all(self) -> None:
        for subscription in tuple(self._subscriptions):
            await subscription.unsubscribe()

    def _fill_link(
        self, servers: Sequence[str], credentials: Mapping[str, Any] | None, tls: Mapping[str, Any] | None
    ) -> LinkConfig:
        if self._open_ended:
            self._link = self._link.filled(servers, credentials, tls)
        return self._link

    async def _declare(
        self,
        subject: str,
        queue: str | None,
        consumer: CommandServer | OrderedFeed,
        *,
        answers: bool = True,
        with_subject: bool = False,
    ) -> Undo:
        """Feed the consumer from ``subject``, with ``answers`` also from queries."""
        raise NotImplementedError

    @staticmethod
    def _read(message: Any) -> tuple[bytes | int, Any]:
        """Split a transport's message as :class:`CommandServer` wants it."""
        raise NotImplementedError

    def _answer(self, reply: Any, data: bytes) -> Awaitable[None] | None:
        """Send a reply; what has to wait is returned and awaited."""
        raise NotImplementedError

    def _call_soon(self, function: Callable[[], None]) -> None:
        """Have ``function`` called on the loop; from threads on which messages arrive."""
        raise NotImplementedError
