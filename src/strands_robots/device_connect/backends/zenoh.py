"""Device Connect over Zenoh, on the framework's wire.

The wire is that of the framework's own adapter: subjects become key expressions, a command is a Zenoh query on the
device's ``cmd`` key whose payload is the JSON-RPC request, its reply carries the JSON-RPC response, events are puts.

The clients of a process share one Zenoh session for each distinct link.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import logging
import random
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from functools import lru_cache, partial
from typing import Any

from device_connect_edge.messaging.exceptions import (
    MessagingConnectionError,
    NotConnectedError,
    PublishError,
    RequestTimeoutError,
    SubscribeError,
)

from ...bounded_json import LONG_MAX, SMALL_BYTES
from ...utils import missing_extra, redacted
from ...zenoh_session import LinkedSession, Sink, direct, undeclare
from . import jsonrpc
from .base import Backend, NoResponderError, ResponderLostError, Undo, UnreadableReplyError, too_long
from .config import LOOPBACK, LinkConfig
from .dial import reason_of, why_silent, words_of
from .dispatch import REPLY_SUBJECT, Backlog, CommandServer, Fanout, OrderedFeed, on_a_thread

try:
    import zenoh
except ImportError as error:
    raise missing_extra("Device Connect over Zenoh", "device-connect") from error

logger = logging.getLogger(__name__)

NO_ZENOH = "what answers there speaks no Zenoh, or asks for TLS"
"""Why a client that reaches an endpoint has no link all the same."""

WHY_S = 2.0
"""Seconds in which it is looked for why an endpoint is silent; a system's look-up of names has no bound."""

REPLY_TTL_S = 60.0
"""Seconds a query outside a command waits for its reply before it is given up."""

FIRST_RETRY_S = 0.005
"""Seconds until a peer asks again where no device answered; doubled at each try. Links here come up in milliseconds."""

LOST_S = 0.5
"""Seconds in which a router says that no device serves a key; a request that ends later had reached one."""

KNOWN_S = 2.0
"""Seconds after which a peer knows who serves a key, so that its request is sent to nobody else."""

LARGE_BYTES = 2**16
"""From here on, which is more than one batch, a message goes out on a thread: it may have to wait for the link."""

# Zenoh keeps a query's deadline itself; this many seconds later we stop believing that it will.
_GRACE_S = 0.05

MEETING_CHECK_S = 1.0
"""Seconds between two checks of a process without the meeting port whether another one still has it.

Half of it is random, so that two survivors rarely try in the same instant.
"""

_EVENT = {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA}

# Queries have a queue of their own beside telemetry. Not express: an express message takes a whole batch of that queue.
_QUERY = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "consolidation": zenoh.ConsolidationMode.NONE,
}
# A peer's routes may be a moment old: asking all that match, not the best, costs nothing where one matches.
_QUERY_OF_A_PEER = {**_QUERY, "target": zenoh.QueryTarget.ALL}


@lru_cache(maxsize=1024)
def key_of(subject: str) -> str:
    """Return the key expression for a dotted subject, or the key that it is."""
    if "/" in subject:
        return subject
    return "/".join("**" if token == ">" else token for token in subject.split("."))


class ZenohBackend(Backend):
    """A messaging client on a shared session; runs on the loop that connected."""

    def __init__(self, link: LinkConfig, *, open_ended: bool = False) -> None:
        super().__init__(link, open_ended=open_ended)
        self._shared: SharedSession | None = None
        self._closed = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._outcomes = Backlog(lambda: self._call_soon(self._settle_requests))
        self._callbacks: tuple[Callable[[], Awaitable[None]] | None, ...] = (None, None)
        self._tasks: set[asyncio.Task[Any]] = set()
        self._tries, self._retry_delay = 13, 0.05
        self._query = _QUERY

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
        link = self._fill_link(servers, credentials, tls_config)
        self._loop = asyncio.get_running_loop()
        self._callbacks = (disconnect_cb, reconnect_cb)
        try:
            self._shared = await on_a_thread(partial(acquire, link), undo=release)
        except zenoh.ZError as error:
            where = ", ".join(link.connect or link.listeners)
            # Zenoh tells of a listener why it fails, and of a connection only that none came about in time.
            silent = await _why_silent(link)
            reason = silent or (NO_ZENOH if link.connect and not link.is_peer else words_of(str(error)))
            raise MessagingConnectionError(redacted(f"no Zenoh link at {where}: {reason}")) from error
        self._closed = False
        self._query = _QUERY_OF_A_PEER if link.is_peer else _QUERY
        self._shared.watch(self._on_link)

    async def publish(self, subject: str, data: bytes) -> None:
        """Send ``data``; never waits for a slow peer.

        Raises:
            NotConnectedError: closed, or a client without its router.
            PublishError: the subject is no key, the message is larger than a peer accepts, or its caller no longer
                waits for this reply.
        """
        if subject.startswith(REPLY_SUBJECT):
            await self._publish_reply(subject, data)
            return
        put = partial(self._connected().session.put, key_of(subject), data, **_EVENT)
        try:
            if len(data) < LARGE_BYTES:
                put()
            else:
                await on_a_thread(put)
        except zenoh.ZError as error:
            raise PublishError(f"cannot publish on {subject}: {error}") from error

    async def request(self, subject: str, data: bytes, timeout: float = 5.0) -> bytes:  # noqa: ASYNC109 - the framework's signature
        """Return the first reply to ``data``.

        Raises:
            NoResponderError: no device serves ``subject``.
            ResponderLostError: the device that got it left before it replied.
            RequestTimeoutError: a device does, but gave no reply within ``timeout`` seconds.
            NotConnectedError: closed, or a client without its router.
        """
        began = time.monotonic()
        deadline, linked_by = began + timeout, began + (self._tries - 1) * self._retry_delay
        remaining, pause, lost = timeout, min(FIRST_RETRY_S, self._retry_delay), None
        while True:
            try:
                return await self.request_once(subject, data, remaining)
            except NoResponderError as error:
                again = time.monotonic() + pause
                remaining = deadline - again
                lost = error if isinstance(error, ResponderLostError) else lost
                if not self._link.is_peer or again > linked_by or remaining <= 0:
                    raise lost or error from None
            except RequestTimeoutError as error:
                raise RequestTimeoutError(f"no reply on {subject} within {timeout:g} s") from error
            # A peer that links at this very moment is not known here yet.
            await asyncio.sleep(pause)
            pause = min(2 * pause, self._retry_delay)

    async def request_once(self, subject: str, data: bytes, within: float) -> bytes:
        """Return the first reply to ``data``, asking the devices that are linked now.

        Raises:
            PublishError: the subject is malformed, or the other side refused.
            UnreadableReplyError: the reply is out of bounds.
        """
        session, loop, wait_s = self._connected().session, asyncio.get_running_loop(), max(within, 0.001)
        began = time.monotonic()
        request, key = _Request(loop, self._outcomes), key_of(subject)
        token: Any = zenoh.CancellationToken()
        handler = direct(request.on_reply, request.on_end)
        get = partial(session.get, key, handler, payload=data, timeout=wait_s, cancellation_token=token, **self._query)
        deadline = loop.call_later(wait_s + _GRACE_S, request.on_deadline)
        try:
            if len(data) < LARGE_BYTES:
                get()
            else:
                await on_a_thread(get)
            # Where a peer knows of no one who serves the key, the request ends before it is sent.
            sent = not request.ended_at and self._link.is_peer and self.linked_for_s > KNOWN_S
            answer = await request.future
        except zenoh.ZError as error:
            raise PublishError(f"cannot ask {key}: {error}") from error
        finally:
            deadline.cancel()
            if not request.answered:
                token.cancel()
        if answer is not None:
            return answer
        if request.failure == "Timeout":
            raise RequestTimeoutError(f"no reply on {key} in time")
        if request.unread:
            raise UnreadableReplyError(f"{key}: {request.unread}")
        if request.failure:
            raise PublishError(f"{key} refused: {request.failure}")
        if sent or request.ended_at - began > LOST_S:
            raise ResponderLostError(f"what served {subject} left before it replied")
        raise NoResponderError(f"no device answers on {subject}")

    async def close(self) -> None:
        """Undeclare everything and release the session."""
        self._closed = True
        shared, self._shared = self._shared, None
        await self._unsubscribe_all()
        self._replies.clear()
        for task in tuple(self._tasks):
            task.cancel()
        if shared is not None:
            shared.unwatch(self._on_link)
            await on_a_thread(partial(release, shared))

    @property
    def links(self) -> int:
        """Peers that this one is linked to; 0 for a client of a router."""
        shared = self._shared
        return shared.links if shared is not None and self._link.is_peer else 0

    @property
    def linked_for_s(self) -> float:
        """Seconds since the session was opened."""
        return 0.0 if self._shared is None else time.monotonic() - self._shared.opened_at

    @property
    def is_connected(self) -> bool:
        """True for an open peer, and for a client that has its router."""
        return self._shared is not None and self._shared.linked

    @property
    def is_closed(self) -> bool:
        """True after ``close``."""
        return self._closed

    def convert_subject_syntax(self, subject: str) -> str:
        """Return the key expression for a dotted subject."""
        return key_of(subject)

    def configure_d2d_retry(self, retries: int = 3, delay: float = 0.3) -> None:
        """Set a peer's retries of an unanswered request, and the longest pause."""
        self._tries, self._retry_delay = retries, delay

    def _connected(self) -> SharedSession:
        if self._shared is None or not self._shared.linked:
            raise NotConnectedError("closed" if self._closed else "not connected to Zenoh")
        return self._shared

    async def _declare(
        self,
        subject: str,
        queue: str | None,
        consumer: CommandServer | OrderedFeed,
        *,
        answers: bool = True,
        with_subject: bool = False,
    ) -> Undo:
        if queue:
            logger.warning("Zenoh has no queue groups: every subscriber of %s gets every message", subject)
        shared, key = self._connected(), key_of(subject)
        if isinstance(consumer, CommandServer):
            on_sample = on_query = consumer.receive
        else:
            on_sample = partial(self._on_message, consumer, with_subject)
            on_query = partial(self._on_question, consumer, with_subject)
        undo = []
        try:
            undo.append(shared.subscribe(key, on_sample))
            if answers:
                undo.append(shared.answer(key, on_query))
        except zenoh.ZError as error:
            for each in undo:
                each()
            raise SubscribeError(f"cannot subscribe to {subject}: {error}") from error

        async def undeclare() -> None:
            for each in undo:
                each()

        return undeclare

    @staticmethod
    def _on_message(feed: OrderedFeed, with_subject: bool, sample: Any) -> None:
        """Take a put. On Zenoh's thread."""
        key = (str(sample.key_expr),) if with_subject else ()
        feed.accept(_payload(sample, feed.longest), *key, None)

    def _on_question(self, feed: OrderedFeed, with_subject: bool, query: Any) -> None:
        """Take a query that is no command. On Zenoh's thread."""
        data = _payload(query, feed.longest)
        if self._replies.full or isinstance(data, int):
            query.drop()
            return
        key = (str(query.key_expr),) if with_subject else ()
        feed.accept(data, *key, self._replies.expect(partial(self._answer, query), REPLY_TTL_S))

    @staticmethod
    def _read(message: Any) -> tuple[bytes | int, Any]:
        return _payload(message, jsonrpc.MAX_COMMAND_BYTES), message if isinstance(message, zenoh.Query) else None

    def _answer(self, reply: Any, data: bytes) -> Awaitable[None] | None:
        if len(data) < LARGE_BYTES:
            _reply_to(reply, data)
            return None
        return on_a_thread(partial(_reply_to, reply, data))

    def _call_soon(self, function: Callable[[], None]) -> None:
        # A closed loop has no handler left.
        with contextlib.suppress(RuntimeError):
            if self._loop is not None:
                self._loop.call_soon_threadsafe(function)

    def _settle_requests(self) -> None:
        while (outcome := self._outcomes.take()) is not None:
            request, value = outcome
            request.settle(value)

    def _on_link(self, linked: bool) -> None:
        """Report a lost or restored link. On Zenoh's thread."""
        self._call_soon(partial(self._report_link, linked))

    def _report_link(self, linked: bool) -> None:
        where = ", ".join(self._link.connect)
        if linked:
            logger.warning("The Zenoh link to %s is back.", where)
        else:
            logger.warning("The Zenoh link to %s is lost. It is tried again.", where)
        callback = self._callbacks[linked]
        if callback is not None and not self._closed:
            task = asyncio.ensure_future(callback())
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)


class _Request:
    """A pending query: replies come on Zenoh's thread, its future is settled once."""

    __slots__ = ("_outcomes", "answered", "ended_at", "failure", "future", "unread")

    def __init__(self, loop: asyncio.AbstractEventLoop, outcomes: Backlog) -> None:
        self._outcomes = outcomes
        self.failure = self.unread = ""
        self.future: asyncio.Future[bytes | None] = loop.create_future()
        self.answered, self.ended_at = False, 0.0

    def on_reply(self, reply: Any) -> None:
        """Take a reply. On Zenoh's thread."""
        ok = reply.ok
        if ok is None:
            why = _payload(reply.err, SMALL_BYTES)
            self.failure = "a long error" if isinstance(why, int) else why[:200].decode(errors="replace")
        elif not self.answered:
            data = _payload(ok, LONG_MAX)
            self.unread, self.answered = too_long(data), True
            self._outcomes.offer((self, None if self.unread else data))

    def on_end(self) -> None:
        """Settle a request that ended without a reply. On Zenoh's thread."""
        # Here, because the loop may be late to hear of it.
        self.ended_at = time.monotonic()
        # An answered request has woken the loop already.
        if not self.answered:
            self._outcomes.offer((self, None))

    def on_deadline(self) -> None:
        """Give up. On the loop."""
        self.failure = "Timeout"
        self.settle(None)

    def settle(self, value: bytes | None) -> None:
        """Set the outcome, unless there is one. On the loop."""
        if not self.future.done():
            self.future.set_result(value)


async def _why_silent(link: LinkConfig) -> str:
    """Return why a link's endpoints do not answer, or empty."""
    try:
        silent: str = await asyncio.wait_for(on_a_thread(partial(why_silent, link)), WHY_S)
    except TimeoutError as error:
        return reason_of(error)
    return silent


def _payload(message: Any, longest: int) -> bytes | int:
    """Return the bytes of a message, or their number where there are more."""
    size = 0 if message.payload is None else len(message.payload)
    data: bytes = message.payload.to_bytes() if 0 < size <= longest else b""
    return size if size > longest else data


def _reply_to(query: Any, data: bytes) -> None:
    """Reply with the caller's priority and end the query."""
    with contextlib.suppress(zenoh.ZError):  # the link to the caller is gone
        query.reply(query.key_expr, data)
    query.drop()


class SharedSession:
    """The session of one link with its users and its subscribers by key."""

    def __init__(self, link: LinkConfig) -> None:
        self.link = link
        self.users = 0
        self.opened_at = time.monotonic()
        self.session: Any = None
        self._linked_session: LinkedSession | None = None
        self._lock = threading.RLock()
        self._topics: dict[str, Fanout] = {}
        self._was_linked = False
        self._is_peer = link.is_peer
        self._watchers: list[Callable[[bool], None]] = []
        self._meeting: MeetingPort | None = None

    def open(self) -> None:
        """Open the session unless it is open."""
        with self._lock:
            if self.session is not None:
                return
            self._linked_session = opened = self._opened()
            self.opened_at = time.monotonic()
            self.session, self._was_linked = opened.session, self.link.is_peer
            opened.watch_links()

    def close(self) -> None:
        """Close everything. Safe to call twice."""
        with self._lock:
            self.session = None
            linked_session, self._linked_session = self._linked_session, None
            meeting, self._meeting = self._meeting, None
            self._watchers.clear()
            self._topics.clear()
        if meeting is not None:
            meeting.close()
        if linked_session is not None:
            linked_session.close()

    @property
    def linked(self) -> bool:
        """True for an open peer, and for a client that has its router."""
        opened = self._linked_session
        return opened is not None and (self._is_peer or bool(opened.remotes))

    @property
    def links(self) -> int:
        """Number of sessions that this one is linked to."""
        opened = self._linked_session
        return 0 if opened is None else len(opened.remotes)

    @property
    def meets(self) -> str:
        """Kind of process on the meeting port, as :func:`meets` returns it."""
        with self._lock:
            return "peer" if self._meeting is None else self._meeting.kind

    def watch(self, watcher: Callable[[bool], None]) -> None:
        """Have ``watcher(linked)`` called on Zenoh's thread at each change."""
        with self._lock:
            self._watchers.append(watcher)

    def unwatch(self, watcher: Callable[[bool], None]) -> None:
        """Undo ``watch``."""
        with self._lock, contextlib.suppress(ValueError):
            self._watchers.remove(watcher)

    def subscribe(self, key: str, sink: Sink) -> Callable[[], None]:
        """Have ``sink(sample)`` called for every sample on ``key``; the result undoes it.

        All sinks of a key share one Zenoh subscriber.
        """
        with self._lock:
            topic = self._topics.get(key)
            if topic is None:
                topic = self._topics[key] = Fanout()
                topic.sinks = (sink,)
                topic.subscription = self.session.declare_subscriber(key, direct(topic.deliver))
            else:
                topic.sinks = (*topic.sinks, sink)
        return lambda: self._unsubscribe(key, sink)

    def answer(self, key: str, sink: Sink) -> Callable[[], None]:
        """Have ``sink(query)`` called for every query on ``key``; the result undoes it."""
        queryable = self.session.declare_queryable(key, direct(sink), complete=True)
        return lambda: undeclare(queryable)

    def _opened(self) -> LinkedSession:
        link = self.link
        if link.meeting_point is not None:
            with contextlib.suppress(zenoh.ZError):  # another process has the meeting port
                return LinkedSession(link.zenoh(meet=True), self._on_change)
        opened = LinkedSession(link.zenoh(), self._on_change)
        if link.meeting_point is not None:
            self._meeting = MeetingPort(link, opened.session)
        return opened

    def _unsubscribe(self, key: str, sink: Sink) -> None:
        with self._lock:
            topic = self._topics.get(key)
            if topic is None or sink not in topic.sinks:
                return
            topic.sinks = tuple(each for each in topic.sinks if each != sink)
            if topic.sinks:
                return
            del self._topics[key]
        undeclare(topic.subscription)

    def _on_change(self, _up: bool) -> None:
        with self._lock:
            linked, before = self.linked, self._was_linked
            self._was_linked = linked
            watchers = tuple(self._watchers)
        if linked != before:
            for watcher in watchers:
                watcher(linked)


class MeetingPort:
    """Takes over the meeting port when the process that has it goes.

    Zenoh cannot add a listener to an open session, and a session that still waits for a port does not close, so the
    port gets a small session of its own, which the main one finds by its own connect retry.
    """

    def __init__(self, link: LinkConfig, session: Any) -> None:
        self._link = link
        self._session = session
        self._host: LinkedSession | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="strands-meeting", daemon=True)
        self._thread.start()

    @property
    def kind(self) -> str:
        """Kind of process on the port; ``stranger`` while nothing there has linked."""
        remotes = {str(link.zid) for link in self._session.info.links() if str(link.dst) == self._link.meeting_point}
        if remotes & {str(each) for each in self._session.info.routers_zid()}:
            return "router"
        return "peer" if remotes or self._host is not None else "stranger"

    def close(self) -> None:
        """Stop watching and give the port back."""
        self._closing.set()
        self._thread.join()
        if self._host is not None:
            self._host.close()

    def _watch(self) -> None:
        while not self._closing.wait(MEETING_CHECK_S * random.uniform(0.5, 1.0)):
            if self._host is None and not self._is_served() and self._is_free():
                # A faster process may have it by now; the main session's retry finds that one.
                with contextlib.suppress(zenoh.ZError):
                    self._host = LinkedSession(self._link.meeting_host())
                    logger.info("took over the meeting point %s", self._link.meeting_point)

    def _is_served(self) -> bool:
        return any(str(link.dst) == self._link.meeting_point for link in self._session.info.links())

    def _is_free(self) -> bool:
        with socket.socket() as probe:
            # Zenoh binds like this: the remains of dead connections do not count.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOOPBACK, self._link.meet_port or 0))
            except OSError:
                return False
        return True


_sessions: dict[LinkConfig, SharedSession] = {}
_lock = threading.Lock()


def acquire(link: LinkConfig) -> SharedSession:
    """Return the session for ``link``, opened on first use. Blocks.

    Raises:
        zenoh.ZError: the session cannot be opened.
    """
    with _lock:
        shared = _sessions.get(link)
        if shared is None:
            shared = _sessions[link] = SharedSession(link)
        shared.users += 1
    try:
        shared.open()
    except BaseException:
        release(shared)
        raise
    return shared


def release(shared: SharedSession) -> None:
    """Release a session; the last user closes it. Blocks."""
    with _lock:
        shared.users -= 1
        if shared.users > 0:
            return
        if _sessions.get(shared.link) is shared:
            del _sessions[shared.link]
        # Before the next one opens: it may listen on the same port.
        shared.close()


def open_links() -> tuple[LinkConfig, ...]:
    """Return the links that have a session at this moment."""
    with _lock:
        return tuple(_sessions)


def meets(link: LinkConfig) -> str:
    """Return the kind of process on a link's meeting port.

    It is ``peer``, also for this process, ``router``, or ``stranger`` where it speaks no Zenoh.
    """
    with _lock:
        shared = next((each for each in _sessions.values() if each.link.meeting_point == link.meeting_point), None)
    return "peer" if shared is None else shared.meets


@atexit.register
def _close_all() -> None:
    """Close the meeting ports too, before the sessions of the process are closed."""
    with _lock:
        left = list(_sessions.values())
        _sessions.clear()
    for shared in left:
        shared.close()
