"""Models that are loaded before a motion, each used by one policy at a time."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable
from typing import Any, Protocol, runtime_checkable

from strands_robots.envelope import error
from strands_robots.policies.unfinished import computing
from strands_robots.safety.gate import MotionRefused

logger = logging.getLogger(__name__)


@runtime_checkable
class Warmable(Protocol):
    """Policy that takes long to load, and can be loaded before it is reset."""

    def warm(self) -> str | None:
        """Begin to load unless it is loaded; return None when it is ready.

        Otherwise ``""`` while it loads, or the reason why the last attempt failed, once.
        """


class WarmModels:
    """Loaded models by key. Thread-safe; a model in use is given to no second policy."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: dict[Hashable, list[Any]] = {}
        self._loading: set[Hashable] = set()
        self._failed: dict[Hashable, str] = {}

    def warm(self, key: Hashable, load: Callable[[], Any], profile: str = "") -> str | None:
        """Load a model on a thread unless one is idle; as :meth:`Warmable.warm`.

        Args:
            key: of the model.
            load: makes it.
            profile: that it is loaded for, for the log.
        """
        with self._lock:
            if self._idle.get(key):
                return None
            if key in self._loading:
                return ""
            failed = self._failed.pop(key, "")
            if failed:
                return failed
            self._loading.add(key)
        loader = threading.Thread(target=self._load, args=(key, load, profile), name="policy-loader", daemon=True)
        loader.start()
        return ""

    def take(self, key: Hashable, load: Callable[[], Any]) -> Any:
        """Return an idle model, or load one here."""
        with self._lock:
            idle = self._idle.get(key)
            if idle:
                return idle.pop()
        return load()

    def give(self, key: Hashable, model: Any) -> None:
        """Keep a model that a policy has done with, for the next one."""
        with self._lock:
            self._idle.setdefault(key, []).append(model)

    def _load(self, key: Hashable, load: Callable[[], Any], profile: str) -> None:
        what = f"the policy {profile}".rstrip()
        logger.info("Loading %s.", what)
        began = time.monotonic()
        try:
            with computing(f"The loading of {what}"):
                model = load()
        except BaseException as exc:  # noqa: BLE001 - whatever a loader raises is told to the next caller
            logger.warning("Loading %s failed: %s: %s", what, type(exc).__name__, exc)
            with self._lock:
                self._failed[key] = f"{type(exc).__name__}: {exc}"
                self._loading.discard(key)
            return
        logger.info("Loaded %s in %.1f s.", what, time.monotonic() - began)
        with self._lock:
            self._idle.setdefault(key, []).append(model)
            self._loading.discard(key)


def require_warm(policy: object, name: str) -> None:
    """Refuse a motion by a policy that is not loaded yet; loading goes on.

    Raises:
        MotionRefused: with ``loading`` true where the caller may ask again.
    """
    if not isinstance(policy, Warmable):
        return
    problem = policy.warm()
    if problem:
        raise MotionRefused(error(f"the policy {name} could not be loaded: {problem}.", loading=False))
    if problem is not None:
        raise MotionRefused(error(f"the policy {name} is loading; ask again.", loading=True))
