"""Zenoh sessions, one for each distinct link, shared by the process."""

from __future__ import annotations

import atexit
import contextlib
import logging
import random
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from ...utils import missing_extra
from ...zenoh_session import LinkedSession, Sink, direct, undeclare
from .config import LOOPBACK, LinkConfig

try:
    import zenoh
except ImportError as error:
    raise missing_extra("Device Connect over Zenoh", "device-connect") from error

logger = logging.getLogger(__name__)

# Seconds between two checks of a process without the meeting port whether another one still has it; half of it is
# random, so that two survivors rarely try in the same instant.
MEETING_CHECK_S = 1.0

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


class SharedSession:
    """The session of one link with its users and its subscribers by key."""

    def __init__(self, link: LinkConfig) -> None:
        self.link = link
        self.users = 0
        self.opened_at = time.monotonic()
        self.session: Any = None
        self._linked_session: LinkedSession | None = None
        self._lock = threading.RLock()
        self._topics: dict[str, _Topic] = {}
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
                topic = self._topics[key] = _Topic()
                topic.sinks = (sink,)
                topic.subscriber = self.session.declare_subscriber(key, direct(topic.deliver))
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
        undeclare(topic.subscriber)

    def _on_change(self, _up: bool) -> None:
        with self._lock:
            linked, before = self.linked, self._was_linked
            self._was_linked = linked
            watchers = tuple(self._watchers)
        if linked != before:
            for watcher in watchers:
                watcher(linked)


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


@atexit.register
def _close_all() -> None:
    """Close the meeting ports too, before the sessions of the process are closed."""
    with _lock:
        left = list(_sessions.values())
        _sessions.clear()
    for shared in left:
        shared.close()
