"""One Zenoh session for each distinct link in the process, shared by every client and closed by the last.

Zenoh calls back on its own threads; a sink given here runs there and must only hand over. Callbacks are direct: the
binding would otherwise start one Python thread for each subscriber, queryable and query.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import logging
import random
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from ...utils import missing_extra
from .config import LOOPBACK, LinkConfig

try:
    import zenoh
except ImportError as error:
    raise missing_extra("Device Connect over Zenoh", "device-connect") from error

logger = logging.getLogger(__name__)

Sink = Callable[[Any], None]

# Seconds between two checks of a process without the meeting port whether another one still has it; half of it is
# random, so that two survivors rarely try in the same instant.
MEETING_CHECK_S = 1.0

# Seconds that Zenoh's threads may still need after a close to release callbacks. A thread that asks for the interpreter
# while that ends aborts the process, and Zenoh does not report when the last one has released.
RELEASE_S = 0.05

_ever_opened = threading.Event()

_sessions: dict[LinkConfig, SharedSession] = {}
_lock = threading.Lock()


def acquire(link: LinkConfig) -> SharedSession:
    """Return the process's session for ``link``, opened on first use. Blocks; call it off the event loop.

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
    """Give a session back; the last one closes it. Blocks; call it off the event loop."""
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


def direct(sink: Sink, drop: Callable[[], None] | None = None) -> Any:
    """Return a Zenoh handler that calls ``sink`` on the thread on which Zenoh received."""
    return zenoh.handlers.Callback(sink, drop, indirect=False)


class SharedSession:
    """A Zenoh session with its users, its subscribers by key, and the sessions it is linked to."""

    def __init__(self, link: LinkConfig) -> None:
        self.link = link
        self.users = 0
        self.session: Any = None
        self._lock = threading.RLock()
        self._topics: dict[str, _Topic] = {}
        self._remotes: set[str] = set()
        self._watchers: list[Callable[[bool], None]] = []
        self._link_events: Any = None
        self._meeting: MeetingPort | None = None

    def open(self) -> None:
        """Open the session unless it is open."""
        with self._lock:
            if self.session is not None:
                return
            self.session, self._meeting = _open(self.link)
            _ever_opened.set()
            self._link_events = self.session.info.declare_transport_events_listener(
                direct(self._on_transport), history=True
            )

    def close(self) -> None:
        """Close everything. Safe to call twice."""
        with self._lock:
            session, self.session = self.session, None
            meeting, self._meeting = self._meeting, None
            link_events, self._link_events = self._link_events, None
            self._watchers.clear()
            self._topics.clear()
        if meeting is not None:
            meeting.close()
        if link_events is not None:
            # Closing ends links, which Zenoh would report on its own threads after this has returned.
            _undeclare(link_events)
        if session is not None:
            try:
                session.close()
            except zenoh.ZError as problem:
                logger.warning("a Zenoh session did not close in order: %s", problem)

    @property
    def linked(self) -> bool:
        """True when the session can send: a client while it has its router, a peer always."""
        return self.session is not None and (self.link.is_peer or bool(self._remotes))

    def watch(self, watcher: Callable[[bool], None]) -> None:
        """Have ``watcher(linked)`` called, on Zenoh's thread, when the link is lost or back."""
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
                topic = self._topics[key] = _Topic()
                topic.sinks = (sink,)
                topic.subscriber = self.session.declare_subscriber(key, direct(topic.deliver))
            else:
                topic.sinks = (*topic.sinks, sink)
        return lambda: self._unsubscribe(key, sink)

    def answer(self, key: str, sink: Sink) -> Callable[[], None]:
        """Have ``sink(query)`` called for every query on ``key``; the result undoes it."""
        queryable = self.session.declare_queryable(key, direct(sink), complete=True)
        return lambda: _undeclare(queryable)

    def _unsubscribe(self, key: str, sink: Sink) -> None:
        with self._lock:
            topic = self._topics.get(key)
            if topic is None or sink not in topic.sinks:
                return
            topic.sinks = tuple(each for each in topic.sinks if each != sink)
            if topic.sinks:
                return
            del self._topics[key]
        _undeclare(topic.subscriber)

    def _on_transport(self, event: Any) -> None:
        zid = str(event.transport.zid)
        with self._lock:
            before = self.linked
            (self._remotes.add if event.kind == zenoh.SampleKind.PUT else self._remotes.discard)(zid)
            after = self.linked
            watchers = tuple(self._watchers)
        if before != after:
            for watcher in watchers:
                watcher(after)


class _Topic:
    """One Zenoh subscriber and the sinks that share it."""

    __slots__ = ("sinks", "subscriber")

    def __init__(self) -> None:
        self.sinks: tuple[Sink, ...] = ()
        self.subscriber: Any = None

    def deliver(self, sample: Any) -> None:
        """Hand a sample to every sink."""
        for sink in self.sinks:
            sink(sample)


class MeetingPort:
    """Takes over the meeting port when the process that has it goes.

    Zenoh cannot add a listener to an open session, and a session that still waits for a port does not close, so the
    port gets a small session of its own, which the main one finds by its own connect retry.
    """

    def __init__(self, link: LinkConfig, session: Any) -> None:
        self._link = link
        self._session = session
        self._host: Any = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="strands-meeting", daemon=True)
        self._thread.start()

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
                    self._host = zenoh.open(_zenoh_config(self._link.meeting_host()))
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


def _open(link: LinkConfig) -> tuple[Any, MeetingPort | None]:
    if link.meeting_point is None:
        return zenoh.open(_zenoh_config(link.zenoh())), None
    try:
        return zenoh.open(_zenoh_config(link.zenoh(meet=True))), None
    except zenoh.ZError:
        session = zenoh.open(_zenoh_config(link.zenoh()))
        return session, MeetingPort(link, session)


def _zenoh_config(config: dict[str, Any]) -> Any:
    return zenoh.Config.from_json5(json.dumps(config))


def _undeclare(entity: Any) -> None:
    # A session that was closed meanwhile has undeclared it already.
    with contextlib.suppress(zenoh.ZError):
        entity.undeclare()


@atexit.register
def _close_all() -> None:
    """A session left open with a subscriber would hang the interpreter's exit."""
    with _lock:
        left = list(_sessions.values())
        _sessions.clear()
    for shared in left:
        shared.close()
    if _ever_opened.is_set():
        time.sleep(RELEASE_S)
