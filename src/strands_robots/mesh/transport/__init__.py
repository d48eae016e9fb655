"""Transports of the mesh: protocol, backends and a user's subscriptions.

A backend is loaded when it is named: ``zenoh`` is the default, ``iot`` is MQTT 5, ``bridge`` is both at once,
``memory`` stays inside one process.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from strands_robots.errors import StrandsRobotsError
from strands_robots.mesh import topics, wire
from strands_robots.moved import moved_name
from strands_robots.threads import BoundedExecutor

logger = logging.getLogger(__name__)

__all__ = [
    "BridgeTransport",
    "Callback",
    "DataCallback",
    "Declaration",
    "IotMqttTransport",
    "LivenessCallback",
    "MemoryBus",
    "MemoryTransport",
    "NoToken",
    "Sample",
    "SampleCallback",
    "Subscriptions",
    "Transport",
    "TransportError",
    "ZenohTransport",
    "undeclare",
]

_MODULES = {
    "BridgeTransport": "bridge",
    "IotMqttTransport": "iot",
    "MemoryBus": "memory",
    "MemoryTransport": "memory",
    "ZenohTransport": "zenoh",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        return moved_name(__name__, name)
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


class TransportError(StrandsRobotsError, RuntimeError):
    """A transport cannot connect or publish; the message says why and what to do."""


@dataclass(slots=True)  # not frozen: that would cost each message a microsecond
class Sample:
    """One message as it arrived.

    Attributes:
        session: id of the publisher's session, None where the publisher or the transport names none.
        sessionless: the transport has no sessions at all, so a missing one says nothing (MQTT).
        retained: it is older than our subscription; the broker stored it for late joiners.
    """

    key: str
    payload: bytes
    session: str | None = None
    sessionless: bool = False
    retained: bool = False


Callback = Callable[[Sample], None]
"""Called on the transport's own thread: it returns at once and does not raise."""

LivenessCallback = Callable[[str, bool], None]
"""Called with the key of a liveliness token and whether it is there."""


class Declaration(Protocol):
    """A declared subscriber or token."""

    def undeclare(self) -> None:
        """Withdraw it: no callback starts after this returns; twice is once."""


def undeclare(declared: Iterable[Declaration]) -> None:
    """Withdraw what was declared; a session that is gone took it along."""
    for each in declared:
        with contextlib.suppress(TransportError):
            each.undeclare()


class NoToken:
    """The declaration of a token on a transport that has none."""

    def undeclare(self) -> None:
        """Nothing was declared."""


class Transport(ABC):
    """Publish and subscribe on the mesh's keys, without the namespace.

    Attributes:
        confirms: :meth:`put_confirmed` reports whether a topic has subscribers.
        pins_topics: the broker's policy lets a peer publish on topics of its own name alone.
        dials_only: it connects to a hub of others and never becomes one.
        stops_apart: :meth:`open_stops` opens a connection of their own.
    """

    confirms = False
    pins_topics = False
    dials_only = False
    stops_apart = False

    def take_part(self) -> None:
        """Let a robot of this process be found: from now on this may become the hub."""
        self.dials_only = False

    @property
    @abstractmethod
    def session_id(self) -> str | None:
        """Id of our session on this transport, None where it has none or is closed."""

    @abstractmethod
    def connect(self) -> None:
        """Open. Raises TransportError when that is not possible; already open is fine."""

    @abstractmethod
    def close(self) -> None:
        """Close; every subscriber goes with it. Twice is once."""

    @abstractmethod
    def is_alive(self) -> bool:
        """True between connect and close, as far as the transport can tell."""

    @abstractmethod
    def put(self, key: str, payload: bytes | Mapping[str, Any]) -> None:
        """Publish. Raises TransportError when closed, WireError when too large."""

    @abstractmethod
    def declare_subscriber(self, key: str, callback: Callback) -> Declaration:
        """Receive a key expression of ``*`` (one segment) and ``**`` (any number).

        Raises:
            TransportError: the transport is closed.
        """

    @property
    def stops_up(self) -> bool:
        """True while stops also arrive on a connection of their own."""
        return False

    def open_stops(
        self, on_stop: Callable[[str, bytes], None], on_check_in: Callback | None = None
    ) -> Callable[[], None]:
        """Open a connection for stops alone, and return what closes it; wait for nothing.

        A transport without one receives stops on its only connection.

        Args:
            on_stop: called with the publisher's session, "" for none, and the message.
            on_check_in: called for check-ins, where robots need a live controller.
        """
        return lambda: None

    def put_stop(self, key: str, payload: Mapping[str, Any]) -> bool:
        """Publish there, as from :attr:`session_id`; False where it is not up."""
        return False

    def refusals(self) -> Mapping[str, str]:
        """Key expressions whose subscription the network refused, with the reason."""
        return {}

    def subscribe_again(self) -> int:
        """Try the refused subscriptions again; return at once how many there are."""
        return 0

    def clear_retained(self, key: str) -> bool:
        """Remove the message that a broker stores for late joiners; False without one."""
        return False

    def put_confirmed(self, key: str, payload: bytes | Mapping[str, Any], timeout: float) -> bool | None:
        """Publish; return whether the topic has subscribers, None if unanswered."""
        self.put(key, payload)
        return None

    def declare_token(self, key: str) -> Declaration:
        """Show ``key`` as alive until it is undeclared or this session ends."""
        return NoToken()

    def watch_tokens(self, key: str, callback: LivenessCallback) -> Declaration:
        """Call back for every token that comes or goes, those already there included."""
        return NoToken()

    def anchored(self) -> bool:
        """True while tokens of other sessions can reach us."""
        return True

    def cut_off(self) -> bool:
        """True while no other session can be reached."""
        return not self.anchored()

    def links_back(self) -> int:
        """Return how often a link came up after one had been lost."""
        return 0

    def rejoined(self) -> int:
        """Return how often a link came up where none was left."""
        return self.links_back()

    def lost_link_at(self) -> float | None:
        """Return the time of the last loss of the hub, monotonic s, or None."""
        return None


DataCallback = Callable[[str, dict[str, Any]], None]
SampleCallback = Callable[[str, dict[str, Any], str | None], None]

INBOX_MAX = 256


class Subscriptions:
    """Named subscriptions of a peer's user; callbacks run one after another on one thread.

    A slow callback loses the oldest messages; it never delays a command or a stop.
    """

    def __init__(self, executor: BoundedExecutor) -> None:
        self._executor = executor
        self._lock = threading.Lock()
        self._declared: dict[str, Declaration] = {}
        self.inbox: dict[str, deque[tuple[str, dict[str, Any]]]] = {}

    def add(
        self,
        transport: Transport,
        topic: str,
        name: str,
        *,
        callback: DataCallback | None = None,
        on_sample: SampleCallback | None = None,
        direct: Callable[[Sample], None] | None = None,
    ) -> bool:
        """Subscribe under ``name``, replacing it; False when the transport refused.

        Args:
            direct: called with the raw sample on the transport's thread instead, for parts of the mesh.
        """
        try:
            declared = transport.declare_subscriber(topic, direct or self._deliverer(callback, name, on_sample))
        except TransportError as exc:
            logger.warning("subscribe %s: %s", topic, exc)
            return False
        refused = transport.refusals().get(topic)
        if refused is not None:
            logger.warning("subscribe %s: %s", topic, refused)
            undeclare([declared])
            return False
        self.remove(name)
        with self._lock:
            self._declared[name] = declared
            if callback is None and on_sample is None and direct is None:
                self.inbox.setdefault(name, deque(maxlen=INBOX_MAX))
        return True

    def remove(self, name: str) -> bool:
        """Undeclare; False when there is none of that name."""
        with self._lock:
            declared = self._declared.pop(name, None)
            self.inbox.pop(name, None)
        if declared is None:
            return False
        undeclare([declared])
        return True

    def clear(self) -> int:
        """Undeclare all of them; how many there were."""
        names = list(self._declared)
        return sum(self.remove(name) for name in names)

    def _deliverer(
        self, callback: DataCallback | None, name: str, on_sample: SampleCallback | None
    ) -> Callable[[Sample], None]:
        def deliver(sample: Sample) -> None:
            try:
                data = wire.decode(sample.payload, topics.topic_of(sample.key).max_bytes)
            except wire.WireError as exc:
                logger.debug("%s: %s", sample.key, exc)
                return
            if on_sample is not None:
                on_sample(sample.key, data, sample.session)
            elif callback is not None:
                callback(sample.key, data)
            else:
                inbox = self.inbox.get(name)
                if inbox is not None:
                    inbox.append((sample.key, data))

        def submit(sample: Sample) -> None:
            self._executor.submit(lambda: deliver(sample))

        return submit
