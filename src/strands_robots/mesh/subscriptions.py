"""Subscriptions of a mesh's user, delivered off the transport's thread."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from strands_robots.mesh import topics, wire
from strands_robots.mesh.executor import BoundedExecutor
from strands_robots.mesh.transport import Declaration, Sample, Transport, TransportError, undeclare

logger = logging.getLogger(__name__)

DataCallback = Callable[[str, dict[str, Any]], None]
SampleCallback = Callable[[str, dict[str, Any], str | None], None]

INBOX_MAX = 256


class Subscriptions:
    """Named subscriptions; callbacks run one after another on one thread.

    A slow callback loses the oldest messages; it never delays a command or a stop.
    """

    def __init__(self, executor: BoundedExecutor) -> None:
        self._executor = executor
        self._lock = threading.Lock()
        self._declared: dict[str, Declaration] = {}
        self.inbox: dict[str, deque[dict[str, Any]]] = {}

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
                    inbox.append({"key": sample.key, **data})

        def submit(sample: Sample) -> None:
            self._executor.submit(lambda: deliver(sample))

        return submit
