"""Device Connect over Zenoh: the framework's wire, without its thread pool and its queue of commands.

The wire is that of the framework's own adapter: subjects become key expressions, a command is a Zenoh query on the
device's ``cmd`` key whose payload is the JSON-RPC request, its reply carries the JSON-RPC response, events are puts.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import time
from collections.abc import Awaitable, Callable
from functools import lru_cache, partial
from typing import Any

import zenoh
from device_connect_edge.messaging.base import MessagingClient, Subscription
from device_connect_edge.messaging.exceptions import (
    MessagingConnectionError,
    NotConnectedError,
    PublishError,
    RequestTimeoutError,
    SubscribeError,
)

from . import jsonrpc, sessions
from .config import LinkConfig
from .dispatch import CommandDesk, Inbox, OrderedFeed, Serve, relaying, serving
from .errors import NoResponderError
from .threads import on_a_thread
from .zenoh_ask import LARGE_BYTES, ask
from .zenoh_intake import Handle, Intake, answer_query

logger = logging.getLogger(__name__)

REPLY_TTL_S = 60.0
"""Seconds a query outside a command waits for its reply before it is given up."""

_REPLY = "_strands_reply/"

_EVENT = {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA}


@lru_cache(maxsize=1024)
def key_of(subject: str) -> str:
    """The key expression for a dotted subject; one with a slash in it is a key expression already."""
    if "/" in subject:
        return subject
    return "/".join("**" if token == ">" else token for token in subject.split("."))


class ZenohBackend(MessagingClient):  # type: ignore[misc]  # the framework has no type information
    """A messaging client on a shared session. Everything but zenoh's callbacks runs on the loop that connected.

    ``open_ended`` takes what the link leaves open from the arguments of ``connect``.
    """

    def __init__(self, link: LinkConfig, *, open_ended: bool = False) -> None:
        self._link = link
        self._open_ended = open_ended
        self._shared: sessions.SharedSession | None = None
        self._closed = False
        self._inbox: Inbox | None = None
        self._queries: dict[str, tuple[Any, float]] = {}
        self._numbers = itertools.count()
        self._subscriptions: set[Handle] = set()
        self._callbacks: tuple[Callable[[], Awaitable[None]] | None, ...] = (None, None)
        self._tasks: set[asyncio.Task[Any]] = set()
        self._tries, self._retry_delay = 3, 0.3

    @property
    def link(self) -> LinkConfig:
        """The link as it is used, with what ``connect`` was given filled in."""
        return self._link

    async def connect(
        self,
        servers: list[str],
        credentials: dict[str, Any] | None = None,
        tls_config: dict[str, Any] | None = None,
        reconnect_cb: Callable[[], Awaitable[None]] | None = None,
        disconnect_cb: Callable[[], Awaitable[None]] | None = None,
        **_options: Any,
    ) -> None:
        """Open the link or join it where the process has it already.

        Raises:
            MessagingConnectionError: no router answered within the link's ``connect_timeout_s``, a port is taken,
                or a certificate is unusable.
        """
        self._link = self._link.filled(servers, credentials, tls_config) if self._open_ended else self._link
        self._inbox = Inbox(asyncio.get_running_loop())
        self._callbacks = (disconnect_cb, reconnect_cb)
        try:
            self._shared = await on_a_thread(partial(sessions.acquire, self._link), undo=sessions.release)
        except zenoh.ZError as error:
            where = ", ".join(self._link.connect or self._link.listeners)
            raise MessagingConnectionError(f"no Zenoh link at {where}: {_plain(error)}") from error
        self._closed = False
        self._shared.watch(self._on_link)

    async def publish(self, subject: str, data: bytes) -> None:
        """Send ``data``; never waits for a slow peer.

        Raises:
            NotConnectedError: closed, or a client without its router.
            PublishError: the subject is no key, the message is larger than a peer accepts, or it is no valid JSON
                reply.
        """
        if subject.startswith(_REPLY):
            await self._reply(subject, data)
            return
        shared = self._session()
        try:
            if len(data) < LARGE_BYTES:
                shared.session.put(key_of(subject), data, **_EVENT)
            else:
                await on_a_thread(partial(shared.session.put, key_of(subject), data, **_EVENT))
        except zenoh.ZError as error:
            raise PublishError(f"cannot publish on {subject}: {error}") from error

    async def subscribe(
        self,
        subject: str,
        callback: Callable[[bytes, str | None], Awaitable[None]],
        queue: str | None = None,
        subscribe_only: bool = False,
    ) -> Subscription:
        """Have ``callback(data, reply_subject)`` called; one subject ending in ``.cmd`` is served concurrently.

        Raises:
            NotConnectedError: not connected.
            SubscribeError: the subject is no key expression.
        """
        if key_of(subject).endswith("/cmd") and not subscribe_only:
            relay = relaying(callback, partial(self.keep, until_answered=True), self._owed)
            return self._declare(subject, queue, desk=CommandDesk(subject, relay, _answer))
        return self._declare(subject, queue, OrderedFeed(subject, callback, self.hand_over), answers=not subscribe_only)

    async def serve(self, subject: str, serve: Serve) -> Subscription:
        """Have every command on ``subject`` carried out by ``serve``, concurrently, and its reply sent.

        Raises:
            NotConnectedError: not connected.
            SubscribeError: the subject is no key expression.
        """
        return self._declare(subject, None, desk=CommandDesk(subject, serving(serve), _answer))

    async def subscribe_with_subject(
        self,
        subject: str,
        callback: Callable[[bytes, str, str | None], Awaitable[None]],
        queue: str | None = None,
        subscribe_only: bool = False,
    ) -> Subscription:
        """``subscribe`` whose callback also gets the key that matched: ``callback(data, key, reply_subject)``."""
        feed = OrderedFeed(subject, callback, self.hand_over)
        return self._declare(subject, queue, feed, answers=not subscribe_only, with_subject=True)

    async def request(self, subject: str, data: bytes, timeout: float = 5.0) -> bytes:  # noqa: ASYNC109 - the framework's signature
        """The first reply to ``data``.

        Raises:
            NoResponderError: nobody serves ``subject``.
            RequestTimeoutError: somebody does, but gave no reply within ``timeout`` seconds.
            NotConnectedError: closed, or a client without its router.
        """
        deadline = time.monotonic() + timeout
        key, of_peers, remaining = key_of(subject), self._link.is_peer, max(timeout, 0.001)
        for left in reversed(range(self._tries if of_peers else 1)):
            session, inbox = self._session().session, self._inbox
            assert inbox is not None
            try:
                answer = await ask(session, inbox, key, data, remaining, of_peers=of_peers)
            except RequestTimeoutError as error:
                raise RequestTimeoutError(f"no reply on {subject} within {timeout:g} s") from error
            if answer is not None:
                return answer
            remaining = deadline - time.monotonic() - self._retry_delay
            if left == 0 or remaining <= 0:
                break
            # A peer that links at this very moment is not known here yet.
            await asyncio.sleep(self._retry_delay)
        raise NoResponderError(f"nobody answers on {subject}")

    async def close(self) -> None:
        """Undeclare everything and give the session back; the last of the process closes it."""
        self._closed = True
        shared, self._shared = self._shared, None
        for subscription in tuple(self._subscriptions):
            await subscription.unsubscribe()
        self._queries.clear()
        for task in tuple(self._tasks):
            task.cancel()
        if shared is not None:
            shared.unwatch(self._on_link)
            await on_a_thread(partial(sessions.release, shared))

    @property
    def is_connected(self) -> bool:
        """True while messages can leave: a peer's session is open, a client has its router."""
        return self._shared is not None and self._shared.linked

    @property
    def is_closed(self) -> bool:
        """True after ``close``."""
        return self._closed

    def convert_subject_syntax(self, subject: str) -> str:
        """The key expression for a dotted subject."""
        return key_of(subject)

    def configure_d2d_retry(self, retries: int = 3, delay: float = 0.3) -> None:
        """How often a peer asks again when nobody answers, and after how many seconds; the framework calls this."""
        self._tries, self._retry_delay = retries, delay

    def _session(self) -> sessions.SharedSession:
        if self._shared is None or not self._shared.linked:
            raise NotConnectedError("closed" if self._closed else "not connected to Zenoh")
        return self._shared

    def _declare(
        self,
        subject: str,
        queue: str | None,
        feed: OrderedFeed | None = None,
        *,
        desk: CommandDesk | None = None,
        answers: bool = True,
        with_subject: bool = False,
    ) -> Subscription:
        if queue:
            logger.warning("Zenoh has no queue groups: every subscriber of %s gets every message", subject)
        shared, key = self._session(), key_of(subject)
        intake = Intake(self, desk, feed, with_subject)
        undo = []
        try:
            undo.append(shared.subscribe(key, intake.on_sample))
            if answers:
                undo.append(shared.answer(key, intake.on_query))
        except zenoh.ZError as error:
            for each in undo:
                each()
            raise SubscribeError(f"cannot subscribe to {subject}: {error}") from error
        subscription = Handle(undo, desk or feed, self._subscriptions.discard)
        self._subscriptions.add(subscription)
        return subscription

    def hand_over(self, function: Callable[..., None], *args: Any) -> None:
        """Call ``function(*args)`` on the client's loop; from any thread."""
        if self._inbox is not None:
            self._inbox.put(function, *args)

    def keep(self, query: Any, *, until_answered: bool) -> str:
        """Remember a query until its reply is published; the subject to publish it to. On the loop.

        A command's query is let go when its handler ends, any other after ``REPLY_TTL_S``.
        """
        reply = f"{_REPLY}{next(self._numbers)}"
        if until_answered:
            self._queries[reply] = (query, math.inf)
        else:
            now = time.monotonic()
            for old in [each for each, (_, until) in self._queries.items() if until < now]:
                del self._queries[old]
            self._queries[reply] = (query, now + REPLY_TTL_S)
        return reply

    def _owed(self, reply: str) -> bool:
        return self._queries.pop(reply, None) is not None

    async def _reply(self, reply: str, data: bytes) -> None:
        query, _ = self._queries.pop(reply, (None, 0.0))
        if query is None:
            raise PublishError("the caller no longer waits for this reply")
        if not jsonrpc.valid_json(data):
            data = jsonrpc.no_number(jsonrpc.id_of(data))
        sending = _answer(query, data)
        if sending is not None:
            await sending

    def _on_link(self, linked: bool) -> None:
        self.hand_over(self._tell, linked)

    def _tell(self, linked: bool) -> None:
        logger.log(logging.INFO if linked else logging.WARNING, "Zenoh link %s", "is back" if linked else "lost")
        callback = self._callbacks[linked]
        if callback is not None and not self._closed:
            task = asyncio.ensure_future(callback())
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)


def _answer(query: Any, data: bytes) -> Awaitable[None] | None:
    """Reply to a query; what has to wait for room is returned and awaited."""
    if len(data) < LARGE_BYTES:
        answer_query(query, data)
        return None
    return on_a_thread(partial(answer_query, query, data))


def _plain(error: BaseException) -> str:
    """What Zenoh says, without the place in its own sources."""
    return str(error).partition(" at /")[0].strip()
