"""What a robot on a ROS graph asks of the road to it, and an implementation in memory for newcomers and tests."""

from __future__ import annotations

import contextlib
import copy
import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

logger = logging.getLogger(__name__)

Message = Mapping[str, Any]
Heard = Callable[[Message], None]
Unwatch = Callable[[], None]
GivenUp = Callable[[], bool]


class RosError(RuntimeError):
    """The road to the graph, or the graph, did not do what was asked; the message is one sentence."""


def never() -> bool:
    """Nobody gives the goal up."""
    return False


class Goal:
    """A goal that was sent: ``done`` once the server told its end, or once that can no longer be told.

    Args:
        cancel: asks the server to end it; returns at once, raises :class:`RosError` when it cannot be asked.
    """

    def __init__(self, cancel: Callable[[], None]) -> None:
        self.done = threading.Event()
        self.status: int | None = None
        self.values: Any = {}
        self.rejected = False
        self.problem = ""
        self.cancel = cancel

    def end(self, status: int, values: Any) -> None:
        """The server told the end: a ``GoalStatus`` and the result's fields."""
        if not self.done.is_set():
            self.status, self.values = status, values
            self.done.set()

    def reject(self, problem: str) -> None:
        """The server did not take it, so that nothing began."""
        self.rejected = True
        self.fail(problem)

    def fail(self, problem: str) -> None:
        """The end will not be told, for this reason; the first one counts."""
        if not self.done.is_set():
            self.problem = problem
            self.done.set()


@runtime_checkable
class GoalLink(Protocol):
    """A link that carries actions."""

    def begin_goal(
        self,
        action: str,
        kind: str,
        goal: Message,
        within_s: float,
        *,
        feedback: Heard | None = None,
        given_up: GivenUp = never,
    ) -> Goal:
        """Send a goal and return once the server took it, time is over, or ``given_up`` says so.

        A goal that is cancelled before the server took it is cancelled once it does.

        Raises:
            RosError: there is no server, or it refused the goal; nothing began.
        """


class EarlierRefusedError(RosError):
    """A message was not sent, because the far end has refused an earlier one of its topic; the next one will be."""


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


@runtime_checkable
class UrgentLink(Protocol):
    """A link with a second way to the graph, for zeros alone, which the traffic of the first cannot hold up."""

    def prepare_urgent(self, topic: str, kind: str) -> None:
        """Have the second way ready for ``topic``; returns at once."""

    def publish_urgent(self, topic: str, kind: str, fields: Message) -> None:
        """Send one message by the second way. Raises :class:`RosError` where that cannot be done without waiting."""

    def cut(self) -> None:
        """Give up what the first way has not sent yet, so that nothing of it arrives later."""


def next_message(
    watch: Callable[[str, str | None, Heard], Unwatch], topic: str, kind: str | None, within_s: float
) -> dict[str, Any]:
    """The first message that a link's ``watch`` tells of a topic. Raises :class:`RosError` where none comes in time."""
    arrived, got = threading.Event(), list[Message]()

    def keep(message: Message) -> None:
        got.append(message)
        arrived.set()

    unwatch = watch(topic, kind, keep)
    try:
        if not arrived.wait(within_s):
            raise RosError(f"Nothing arrived on {topic} within {within_s:g} s.")
    finally:
        unwatch()
    return dict(got[0])


MemoryAction = Callable[[Message, Heard, Goal], None]


class MemoryLink:
    """A graph inside this process: what is published is kept in ``sent`` and told to whoever watches.

    Args:
        services: a callable by service name, which gets the request's fields and returns the response's.
    """

    def __init__(self, services: Mapping[str, Callable[[Message], dict[str, Any]]] | None = None) -> None:
        self.sent: list[tuple[str, dict[str, Any]]] = []
        self.called: list[tuple[str, dict[str, Any]]] = []
        self._services = dict(services or {})
        self._actions: dict[str, MemoryAction] = {}
        self._watchers: dict[str, list[Heard]] = {}
        self._lock = threading.Lock()

    def offer(self, service: str, answer: Callable[[Message], dict[str, Any]]) -> None:
        """Offer a service from now on."""
        self._services[service] = answer

    def serve(self, action: str, begun: MemoryAction) -> None:
        """Serve an action: ``begun`` gets the goal's fields, the way to tell feedback, and the goal to end."""
        self._actions[action] = begun

    def begin_goal(
        self,
        action: str,
        kind: str,
        goal: Message,
        within_s: float,
        *,
        feedback: Heard | None = None,
        given_up: GivenUp = never,
    ) -> Goal:
        del kind, within_s
        if given_up():
            raise RosError(f"{action} was given up before its goal was sent.")
        if action not in self._actions:
            raise RosError(f"Nobody serves the action {action}.")
        sent = Goal(lambda: sent.end(5, {}))
        self._actions[action](copy.deepcopy(dict(goal)), feedback or (lambda message: None), sent)
        return sent

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        del kind
        message = copy.deepcopy(dict(fields))
        with self._lock:
            self.sent.append((topic, message))
            watchers = list(self._watchers.get(topic, ()))
        for heard in watchers:
            try:
                heard(message)
            except Exception:
                logger.exception("A watcher of %s failed.", topic)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return next_message(self.watch, topic, kind, within_s)

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        del kind, within_s
        if service not in self._services:
            raise RosError(f"Nobody offers the service {service}.")
        self.called.append((service, dict(fields)))
        return self._services[service](fields)

    def tell(self, topic: str, kind: str, fields: Message) -> None:
        """The same as :meth:`publish`: a graph in memory misses nobody."""
        self.publish(topic, kind, fields)

    def watch(self, topic: str, kind: str | None, heard: Heard) -> Unwatch:
        del kind
        with self._lock:
            self._watchers.setdefault(topic, []).append(heard)

        def unwatch() -> None:
            with self._lock, contextlib.suppress(ValueError):  # a second call has nothing left to take out
                self._watchers[topic].remove(heard)

        return unwatch

    def close(self) -> None:
        """Nothing to let go of."""
