"""Joining of networks, side by side, tried again where their caller stays."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from typing import TypeVar

from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import NetworkAdapter, NetworkBusyError
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)

T = TypeVar("T")
R = TypeVar("R")


def on_own_thread(work: Callable[[], R], *, here: bool = False) -> Future[R]:
    """Begin ``work`` on a thread of its own, or do it ``here``, as where none starts."""
    done: Future[R] = Future()
    # From now on it cannot be cancelled.
    done.set_running_or_notify_cancel()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as exc:  # noqa: BLE001 - it is raised where the result is taken
            done.set_exception(exc)

    if not here:
        with suppress(RuntimeError):
            threading.Thread(target=run, name="fleet-work", daemon=True).start()
            return done
    run()
    return done


def side_by_side(work: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return ``work`` of each item, in order; raise the first exception at the end.

    A pool of threads takes no work once the interpreter ends; a stop must be possible even then, so what gets no
    thread is done one after the other.
    """
    last = len(items) - 1
    begun = [on_own_thread(partial(work, each), here=place == last) for place, each in enumerate(items)]
    for each in begun:
        each.exception()
    return [each.result() for each in begun]


def those(test: Callable[[T], bool], items: Sequence[T], *, every: bool) -> list[T]:
    """Return items for which ``test`` is true: all, or those known at the first one.

    One that raises is none.
    """
    found: dict[int, bool] = {}
    change = threading.Condition()

    def one(place: int) -> None:
        there = False
        try:
            there = test(items[place])
        finally:
            with change:
                found[place] = there
                change.notify_all()

    for place in range(len(items)):
        on_own_thread(partial(one, place))
    with change:
        change.wait_for(lambda: len(found) == len(items) or (not every and any(found.values())))
        return [each for place, each in enumerate(items) if found.get(place)]


AGAIN_S, AGAIN_MAX_S = 1.0, 5.0
"""Seconds until a network that could not be joined is tried again: the first time, and at most."""


class Joining:
    """One network, from the first attempt to join it to its end.

    Args:
        network: to join.
        again: go on trying until it is joined.
        changed: called after each attempt.
        before: the joining of the same network that was closed last, which ends first.

    Attributes:
        attempted: set once the first attempt is over.
        why: the reason of the last attempt that failed; empty before the first.
        unexpected: what an attempt raised that is no refusal.
        over: set once no attempt goes on.
    """

    def __init__(
        self,
        network: NetworkAdapter,
        *,
        again: bool,
        changed: Callable[[Joining], None],
        before: Joining | None = None,
    ) -> None:
        self.network = network
        self.attempted = threading.Event()
        self.why = ""
        self.unexpected: BaseException | None = None
        self._busy_since: float | None = None
        self._again, self._changed, self._before = again, changed, before
        self._lock, self._insisting = threading.Lock(), threading.Lock()
        self._closing, self.over = threading.Event(), threading.Event()
        self._begun = self._up = False

    @property
    def up(self) -> bool:
        """True while the network is joined."""
        return self._up

    def begin(self, *, here: bool = False) -> None:
        """Join on a thread of its own, or on this one; a second call does nothing."""
        with self._lock:
            begun, self._begun = self._begun, True
        if begun:
            return
        try:
            if not here:
                threading.Thread(target=self._run, name=f"join {self.network.name}", daemon=True).start()
                return
        except RuntimeError:
            # The interpreter ends and starts no thread: one attempt has to do.
            logger.debug("%s is joined on the thread of its caller.", self.network.name)
            self._again = False
        self._run()

    def insist(self, seconds: float) -> None:
        """Try a busy network again, until so many seconds after it was found busy."""
        with self._insisting:
            while (since := self._busy_since) is not None and not self._again and not self._closing.is_set():
                self._attempt()
                if time.monotonic() >= since + seconds:
                    return

    def close(self) -> None:
        """Leave the network; one that is being joined is left once it is."""
        with self._lock:
            self._closing.set()
            joined, self._up = self._up, False
            if not self._begun:
                self._begun = True
                self.over.set()
        if joined:
            self._leave()

    def _run(self) -> None:
        """Join; go on trying where that is wanted."""
        pause = AGAIN_S
        try:
            if self._before is not None:
                # They share the network, which the other one leaves at its end.
                self._before.over.wait()
                self._before = None
            while not self._attempt() and self._again and not self._closing.wait(pause):
                pause = min(2 * pause, AGAIN_MAX_S)
        finally:
            self.over.set()

    def _attempt(self) -> bool:
        try:
            self.network.open()
        except UnreachableError as exc:
            self.why = exc.why or "it gave no reason"
            self._busy_since = (self._busy_since or time.monotonic()) if isinstance(exc, NetworkBusyError) else None
        except (KeyboardInterrupt, SystemExit) as exc:
            self.why = type(exc).__name__
            raise
        except BaseException as exc:
            if self.unexpected is None:
                # The other networks are joined all the same.
                logger.exception("%s cannot be joined.", self.network.name)
            self.unexpected, self.why = exc, plain_text(f"{type(exc).__name__}: {exc}")
        else:
            self.why, self.unexpected, self._busy_since = "", None, None
            with self._lock:
                self._up = not self._closing.is_set()
            if not self._up:
                self._leave()
        finally:
            self.attempted.set()
            self._changed(self)
        return not self.why

    def _leave(self) -> None:
        try:
            self.network.close()
        except Exception as exc:  # noqa: BLE001 - the others are left all the same
            logger.warning("%s was not left in good order: %s", self.network.name, exc)
