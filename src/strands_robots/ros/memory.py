"""Link to a graph in this process's memory, for newcomers and tests."""

from __future__ import annotations

import contextlib
import copy
import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.ros.link import CancelCheck, Goal, Message, OnMessage, RosError, Unwatch, never, next_message

logger = logging.getLogger(__name__)

MemoryAction = Callable[[Message, OnMessage, Goal], None]


class MemoryLink:
    """A graph inside this process, which keeps published messages in ``sent``.

    Args:
        services: a callable by service name, which gets the request's fields and returns the response's.
    """

    def __init__(self, services: Mapping[str, Callable[[Message], dict[str, Any]]] | None = None) -> None:
        self.sent: list[tuple[str, dict[str, Any]]] = []
        self.called: list[tuple[str, dict[str, Any]]] = []
        self._services = dict(services or {})
        self._actions: dict[str, MemoryAction] = {}
        self._watchers: dict[str, list[OnMessage]] = {}
        self._lock = threading.Lock()

    def open(self) -> None:
        """Do nothing: there is no connection."""

    def offer(self, service: str, answer: Callable[[Message], dict[str, Any]]) -> None:
        """Offer a service from now on."""
        self._services[service] = answer

    def serve(self, action: str, run: MemoryAction) -> None:
        """Serve an action: ``run`` gets fields, feedback callback and goal to end."""
        self._actions[action] = run

    def send_goal(
        self,
        action: str,
        kind: str,
        goal: Message,
        within_s: float,
        *,
        feedback: OnMessage | None = None,
        cancelled: CancelCheck = never,
    ) -> Goal:
        del kind, within_s
        if cancelled():
            raise RosError(f"{action} was given up before its goal was sent.")
        if action not in self._actions:
            raise RosError(f"No server for the action {action}.")
        sent = Goal(lambda: sent.end(5, {}))
        self._actions[action](copy.deepcopy(dict(goal)), feedback or (lambda message: None), sent)
        return sent

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        del kind
        message = copy.deepcopy(dict(fields))
        with self._lock:
            self.sent.append((topic, message))
            watchers = list(self._watchers.get(topic, ()))
        for on_message in watchers:
            try:
                on_message(message)
            except Exception:
                logger.exception("A watcher of %s failed.", topic)

    def broadcast(self, topic: str, kind: str, fields: Message) -> None:
        """Publish: a graph in memory has no subscription that could be missing."""
        self.publish(topic, kind, fields)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return next_message(self.watch, topic, kind, within_s)

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        del kind, within_s
        if service not in self._services:
            raise RosError(f"No server for the service {service}.")
        self.called.append((service, dict(fields)))
        return self._services[service](fields)

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        del kind
        with self._lock:
            self._watchers.setdefault(topic, []).append(on_message)

        def unwatch() -> None:
            with self._lock, contextlib.suppress(ValueError):  # a second call has nothing left to take out
                self._watchers[topic].remove(on_message)

        return unwatch

    def close(self) -> None:
        """Do nothing: there is no connection."""
