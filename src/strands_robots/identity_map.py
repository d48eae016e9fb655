"""Values by the identity of objects."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

T = TypeVar("T")


class IdentityMap(Generic[T]):
    """Values by the identity of objects; thread-safe.

    The objects may be equal, or have no hash. A value goes with its object. An object that cannot be referred to
    weakly is kept for good.
    """

    def __init__(self) -> None:
        self._values: dict[int, tuple[object, T]] = {}
        self._lock = threading.Lock()

    def of(self, key: object, make: Callable[[], T]) -> T:
        """Return the value of ``key``, made at the first question."""
        known = self._values.get(id(key))
        if known is None:
            with self._lock:
                known = self._values.get(id(key))
                if known is None:
                    known = self._values[id(key)] = self._reference(key), make()
        return known[1]

    def get(self, key: object) -> T | None:
        """Return the value of ``key``, None before it was made."""
        known = self._values.get(id(key))
        return None if known is None else known[1]

    def _reference(self, key: object) -> object:
        try:
            # Called by the garbage collector, on any thread: it may take no lock.
            return weakref.ref(key, partial(self._forget, id(key)))
        except TypeError:
            return key

    def _forget(self, at: int, _: object) -> None:
        self._values.pop(at, None)
