"""Models loaded before a motion, and the end of a process that still computes.

While the interpreter shuts down, Python ends every thread that comes back to it from native code. glibc does that by
unwinding the native code, which torch's does not allow: the process would abort. So where torch is loaded the end waits
for what is being computed. What still runs is named on stderr, and its thread never comes back.
"""

from __future__ import annotations

import atexit
import ctypes
import logging
import platform
import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

from strands_robots.envelope import error
from strands_robots.safety.gate import MotionRefused

ENDING_S = 5.0
"""Seconds that the end of the process waits for what is being computed."""

_POLL_S = 0.01
_running: dict[object, tuple[str, float]] = {}
_ending = threading.Event()


@contextmanager
def computing(what: str) -> Iterator[None]:
    """Note native code that runs on a daemon thread.

    No computation starts once the process ends.

    Args:
        what: its name in the message about one that hangs.
    """
    token = object()
    _running[token] = (what, time.monotonic())
    try:
        if _ending.is_set():
            _running.pop(token)
            threading.Event().wait()
        yield
    finally:
        _running.pop(token, None)


def name_unfinished() -> bool:
    """Name on stderr what is still being computed; return True for any."""
    unfinished = list(_running.values())
    for what, began in unfinished:
        taken = time.monotonic() - began
        print(f"{what} has not ended after {taken:.1f} s; the process ends without it.", file=sys.stderr, flush=True)
    return bool(unfinished)


# Registered with the first policy, so that it runs after the robots and networks that were made later have ended.
@atexit.register
def _end() -> None:
    _ending.set()
    deadline = time.monotonic() + (ENDING_S if "torch" in sys.modules else 0.0)
    while _running and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    if name_unfinished() and "torch" in sys.modules and platform.libc_ver()[0] == "glibc":
        _keep_threads()


def _keep_threads() -> None:
    """Let a thread that glibc unwinds sleep, and keep the exit code."""
    libc, libstdcxx = ctypes.CDLL(None), ctypes.CDLL("libstdc++.so.6")
    std_set_terminate = libstdcxx._ZSt13set_terminatePFvvE
    std_set_terminate(ctypes.cast(libc.pause, ctypes.c_void_p))
    # Destructors of native libraries would run beside that thread; the last one registered here runs first.
    libc.on_exit(ctypes.cast(libc._exit, ctypes.c_void_p), None)


logger = logging.getLogger(__name__)


@runtime_checkable
class Warmable(Protocol):
    """Policy that takes long to load, and can be loaded before it is reset."""

    def warm(self) -> str | None:
        """Begin to load unless it is loaded; return None when it is ready.

        Otherwise ``""`` while it loads, or the reason why the last attempt failed, once.
        """


class PreloadedModels:
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
