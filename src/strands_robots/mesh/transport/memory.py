"""The mesh inside one process: for tests, and for robots that never leave it.

Delivery is synchronous, in order, on the publisher's thread.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from strands_robots.mesh import topics, wire
from strands_robots.mesh.transport import Callback, LivenessCallback, Sample, Transport, TransportError


@dataclass(eq=False, slots=True)
class _Declared:
    """A subscriber, a watcher of tokens, or a token, which has neither callback."""

    owner: MemoryTransport
    key: str
    on_sample: Callback | None = None
    on_token: LivenessCallback | None = None

    def undeclare(self) -> None:
        self.owner.bus.leave(self)


class MemoryBus:
    """State that the in-memory transports of one mesh share."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._declared: list[_Declared] = []

    def join(self, declared: _Declared) -> None:
        """Add a subscriber, watcher or token; watchers learn of existing tokens."""
        with self._lock:
            self._declared.append(declared)
            tokens, watchers = self._tokens(), self._watchers()
        if declared.on_token is not None:
            self._notify(tokens, [declared], alive=True)
        elif declared.on_sample is None:
            self._notify([declared], watchers, alive=True)

    def leave(self, declared: _Declared) -> None:
        """Remove what was added; twice is once."""
        with self._lock:
            if declared not in self._declared:
                return
            self._declared.remove(declared)
            watchers = self._watchers()
        if declared.on_sample is None and declared.on_token is None:
            self._notify([declared], watchers, alive=False)

    def forget(self, owner: MemoryTransport) -> None:
        """Remove all of a session: first its callbacks, then its tokens."""
        owned = self.declared_by(owner)
        for each in sorted(owned, key=lambda each: each.on_sample is None and each.on_token is None):
            each.undeclare()

    def declared_by(self, owner: MemoryTransport) -> list[_Declared]:
        """The subscribers, watchers and tokens of a session."""
        with self._lock:
            return [each for each in self._declared if each.owner is owner]

    def parted(self, one: MemoryTransport, other: MemoryTransport) -> bool:
        """Return True where nothing passes between two sessions; here all do."""
        return False

    def deliver(self, sender: MemoryTransport, sample: Sample) -> None:
        """Call every subscriber of a sample's key."""
        with self._lock:
            callbacks = [
                each.on_sample
                for each in self._declared
                if each.on_sample is not None
                and topics.matches(each.key, sample.key)
                and not self.parted(sender, each.owner)
            ]
        for callback in callbacks:
            callback(sample)

    def _tokens(self) -> list[_Declared]:
        return [each for each in self._declared if each.on_sample is None and each.on_token is None]

    def _watchers(self) -> list[_Declared]:
        return [each for each in self._declared if each.on_token is not None]

    @staticmethod
    def _notify(tokens: list[_Declared], watchers: list[_Declared], *, alive: bool) -> None:
        for token in tokens:
            for watcher in watchers:
                if watcher.on_token is not None and topics.matches(watcher.key, token.key):
                    watcher.on_token(token.key, alive)


SHARED = MemoryBus()
"""The bus of ``STRANDS_MESH_BACKEND=memory``."""


class MemoryTransport(Transport):
    """One session on a :class:`MemoryBus`.

    Args:
        bus: shared by all sessions that receive each other's messages; the process's own by default.
        session: its id, random by default.
        sessionless: publish without a session, as MQTT does.
    """

    def __init__(self, bus: MemoryBus | None = None, session: str | None = None, *, sessionless: bool = False) -> None:
        self.bus = bus or SHARED
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
        self._require_open()
        data = payload if isinstance(payload, bytes) else wire.encode(payload, topics.topic_of(key).max_bytes)
        self.bus.deliver(self, Sample(key, data, self.session_id, self._sessionless))

    def declare_subscriber(self, key: str, callback: Callback) -> _Declared:
        self._require_open()
        return self._declare(_Declared(self, key, on_sample=callback))

    def declare_token(self, key: str) -> _Declared:
        return self._declare(_Declared(self, key))

    def watch_tokens(self, key: str, callback: LivenessCallback) -> _Declared:
        return self._declare(_Declared(self, key, on_token=callback))

    def _declare(self, declared: _Declared) -> _Declared:
        self.bus.join(declared)
        return declared

    def _require_open(self) -> None:
        if not self._open:
            raise TransportError("the in-memory session is closed.")
