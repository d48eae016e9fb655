"""The mesh inside one process: for tests, and for robots that never leave it.

Delivery is synchronous, in order, on the publisher's thread.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Mapping
from typing import Any

from strands_robots.mesh import topics, wire
from strands_robots.mesh.transport import Callback, LivenessCallback, Sample, TransportError


class _Subscriber:
    def __init__(self, owner: MemoryTransport, key: str, callback: Callback) -> None:
        self.owner, self.key, self.callback = owner, key, callback

    def undeclare(self) -> None:
        self.owner.bus.leave(self)


class _Token:
    def __init__(self, owner: MemoryTransport, key: str) -> None:
        self.owner, self.key = owner, key

    def undeclare(self) -> None:
        self.owner.bus.drop_token(self)


class _Watch:
    def __init__(self, owner: MemoryTransport, key: str, callback: LivenessCallback) -> None:
        self.owner, self.key, self.callback = owner, key, callback

    def undeclare(self) -> None:
        self.owner.bus.leave(self)


class MemoryBus:
    """What the in-memory transports of one mesh share. ``partition`` cuts a session off, as a broken link does."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: list[_Subscriber | _Watch] = []
        self._tokens: list[_Token] = []
        self._cut: set[MemoryTransport] = set()

    def join(self, subscriber: _Subscriber | _Watch) -> None:
        with self._lock:
            self._subscribers.append(subscriber)
            tokens = list(self._tokens)
        if isinstance(subscriber, _Watch):
            for token in tokens:
                self._tell(token, True, [subscriber])

    def leave(self, subscriber: _Subscriber | _Watch) -> None:
        with self._lock:
            if subscriber in self._subscribers:
                self._subscribers.remove(subscriber)

    def add_token(self, token: _Token) -> None:
        with self._lock:
            self._tokens.append(token)
            watchers = [each for each in self._subscribers if isinstance(each, _Watch)]
        self._tell(token, True, watchers)

    def drop_token(self, token: _Token) -> None:
        with self._lock:
            if token not in self._tokens:
                return
            self._tokens.remove(token)
            watchers = [each for each in self._subscribers if isinstance(each, _Watch)]
        self._tell(token, False, watchers)

    def forget(self, owner: MemoryTransport) -> None:
        with self._lock:
            self._subscribers = [each for each in self._subscribers if each.owner is not owner]
            tokens = [token for token in self._tokens if token.owner is owner]
        for token in tokens:
            self.drop_token(token)

    def partition(self, transport: MemoryTransport, cut: bool = True) -> None:
        """Lose every message from and to a session, until it is healed with ``cut=False``."""
        with self._lock:
            (self._cut.add if cut else self._cut.discard)(transport)

    def deliver(self, sender: MemoryTransport, sample: Sample) -> None:
        with self._lock:
            hearers = [
                each
                for each in self._subscribers
                if isinstance(each, _Subscriber)
                and topics.matches(each.key, sample.key)
                and (each.owner is sender or not {sender, each.owner} & self._cut)
            ]
        for each in hearers:
            each.callback(sample)

    @staticmethod
    def _tell(token: _Token, there: bool, watchers: list[_Watch]) -> None:
        for watch in watchers:
            if topics.matches(watch.key, token.key):
                watch.callback(token.key, there)


class MemoryTransport:
    """One session on a :class:`MemoryBus`.

    Args:
        bus: shared by all that should hear each other.
        session: its id, random by default.
        sessionless: publish without a session, as MQTT does.
    """

    def __init__(self, bus: MemoryBus, session: str | None = None, *, sessionless: bool = False) -> None:
        self.bus = bus
        self._id = session or secrets.token_hex(16)
        self._sessionless = sessionless
        self._open = False

    @property
    def session_id(self) -> str | None:
        return self._id if self._open and not self._sessionless else None

    def connect(self) -> None:
        self._open = True

    def close(self) -> None:
        self._open = False
        self.bus.forget(self)

    def is_alive(self) -> bool:
        return self._open

    def put(self, key: str, payload: bytes | Mapping[str, Any]) -> None:
        if not self._open:
            raise TransportError("the in-memory session is closed.")
        limit = topics.topic_of(key).max_bytes
        data = payload if isinstance(payload, bytes) else wire.encode(payload, limit)
        self.bus.deliver(self, Sample(key, data, self.session_id, self._sessionless))

    def declare_subscriber(self, key: str, callback: Callback) -> _Subscriber:
        if not self._open:
            raise TransportError("the in-memory session is closed.")
        subscriber = _Subscriber(self, key, callback)
        self.bus.join(subscriber)
        return subscriber

    def declare_token(self, key: str) -> _Token:
        token = _Token(self, key)
        self.bus.add_token(token)
        return token

    def watch_tokens(self, key: str, callback: LivenessCallback) -> _Watch:
        watch = _Watch(self, key, callback)
        self.bus.join(watch)
        return watch


SHARED = MemoryBus()
"""The bus of ``STRANDS_MESH_BACKEND=memory``."""
