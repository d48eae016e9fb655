"""Events of a remote robot, bounded in number and in bytes."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Self

from strands_robots.fleet.adapter import NetworkAdapter, RobotEvent

EVENTS_MAX = 10_000
"""Events that wait for a slow reader; a further one displaces the oldest."""

BYTES_MAX = 64 * 1024 * 1024
"""Bytes of memory that waiting events may take; the oldest ones go first."""


class EventFeed:
    """Events of one robot as they come; an iterator and context manager."""

    def __init__(self, robot: str, network: NetworkAdapter, timeout: float | None) -> None:
        self._arrived: deque[tuple[RobotEvent, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._timeout = timeout
        self._end: Callable[[], None] | None = network.subscribe(robot, self._push)

    def close(self) -> None:
        """Receive no more events."""
        end, self._end = self._end, None
        if end is not None:
            end()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> RobotEvent:
        with self._changed:
            if self._changed.wait_for(lambda: self._arrived, self._timeout):
                return self._oldest()
        self.close()
        raise StopIteration

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def _push(self, event: RobotEvent) -> None:
        size = size_of(event.payload)
        with self._changed:
            self._arrived.append((event, size))
            self._bytes += size
            while len(self._arrived) > EVENTS_MAX or (self._bytes > BYTES_MAX and len(self._arrived) > 1):
                self._oldest()
            self._changed.notify()

    def _oldest(self) -> RobotEvent:
        event, size = self._arrived.popleft()
        self._bytes -= size
        return event


def size_of(value: object) -> int:
    """Return the bytes of memory that a decoded JSON value takes."""
    total, waiting = 0, [value]
    while waiting:
        each = waiting.pop()
        total += sys.getsizeof(each)
        if isinstance(each, Mapping):
            waiting += each.keys()
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each
    return total
