"""What a robot on a ROS graph asks of the road to it, and an implementation in memory for newcomers and tests."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

Message = Mapping[str, Any]
Heard = Callable[[Message], None]
Unwatch = Callable[[], None]


class RosError(RuntimeError):
    """The road to the graph, or the graph, did not do what was asked; the message is one sentence."""


class RosLink(Protocol):
    """One road to a ROS graph. Thread-safe; opened by the first use; every verb raises :class:`RosError`."""

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        """Hand one message to the graph; returns within the link's own time-out."""

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        """The next message of a topic; without ``kind`` the graph is asked for its type."""

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        """Call a service and return its response."""

    def watch(self, topic: str, kind: str | None, heard: Heard) -> Unwatch:
        """Tell ``heard`` of every message from now on, on the link's thread; it must return at once."""

    def close(self) -> None:
        """Let go of the graph. A later use opens it anew."""


class MemoryLink:
    """A graph inside this process: what is published is kept in ``sent`` and told to whoever watches.

    Args:
        services: a callable by service name, which gets the request's fields and returns the response's.
    """

    def __init__(self, services: Mapping[str, Callable[[Message], dict[str, Any]]] | None = None) -> None:
        self.sent: list[tuple[str, dict[str, Any]]] = []
        self.called: list[tuple[str, dict[str, Any]]] = []
        self._services = dict(services or {})
        self._watchers: dict[str, list[Heard]] = {}
        self._lock = threading.Lock()

    def offer(self, service: str, answer: Callable[[Message], dict[str, Any]]) -> None:
        """Offer a service from now on."""
        self._services[service] = answer

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        del kind
        message = copy.deepcopy(dict(fields))
        with self._lock:
            self.sent.append((topic, message))
            watchers = list(self._watchers.get(topic, ()))
        for heard in watchers:
            heard(message)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        arrived = threading.Event()
        got: list[Message] = []

        def keep(message: Message) -> None:
            got.append(message)
            arrived.set()

        unwatch = self.watch(topic, kind, keep)
        try:
            if not arrived.wait(within_s):
                raise RosError(f"Nothing arrived on {topic} within {within_s:g} s.")
        finally:
            unwatch()
        return dict(got[0])

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        del kind, within_s
        if service not in self._services:
            raise RosError(f"Nobody offers the service {service}.")
        self.called.append((service, dict(fields)))
        return self._services[service](fields)

    def watch(self, topic: str, kind: str | None, heard: Heard) -> Unwatch:
        del kind
        with self._lock:
            self._watchers.setdefault(topic, []).append(heard)

        def unwatch() -> None:
            with self._lock:
                self._watchers[topic].remove(heard)

        return unwatch

    def close(self) -> None:
        """Nothing to let go of."""
