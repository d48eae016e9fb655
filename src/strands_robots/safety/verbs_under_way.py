"""Verbs of a robot's own that have begun and not returned.

A verb of ours is a rollout or a plan that a halt ends by itself. A robot's own verb is its author's code: a halt voids
its permit and waits until it has returned. One that does not return is a robot that may still move.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal


@dataclass(eq=False, slots=True)
class VerbCall:
    """One call of a robot's own verb.

    Attributes:
        name: of the verb.
        call: identity of the caller's request; verbs that a verb calls have its own.
        valid: returns False once its permit is void.
        void: ends its permit, and no other.
        thread: that runs it.
        ended: how it ended; empty while it runs.
    """

    name: str
    call: object
    valid: Callable[[], bool]
    void: Callable[[], None]
    began: float = field(default_factory=time.monotonic)
    thread: int = field(default_factory=threading.get_ident)
    ended: Literal["", "completed", "stopped", "error"] = ""
    error: str = ""


CallObserver = Callable[[VerbCall], None]
"""Called when a verb begins and when it has ended, on the verb's thread. It must return at once and may not raise."""


class VerbsUnderWay:
    """The own motion verbs of one robot that run now; thread-safe.

    A halt reads them without a lock.
    """

    def __init__(self) -> None:
        self._running: dict[VerbCall, None] = {}
        self._beginning = threading.Lock()
        self._observers: tuple[CallObserver, ...] = ()

    def __bool__(self) -> bool:
        return bool(self._running)

    @property
    def calls(self) -> tuple[VerbCall, ...]:
        """The calls that have not returned, the oldest first."""
        return tuple(self._running)

    @property
    def name(self) -> str:
        """The verb that a caller asked for; empty while none runs."""
        return next((each.name for each in tuple(self._running)), "")

    def observe(self, observer: CallObserver) -> Callable[[], None]:
        """Call ``observer`` at each begin and end; return a callable that ends that."""
        with self._beginning:
            self._observers = (*self._observers, observer)

        def leave() -> None:
            with self._beginning:
                self._observers = tuple(each for each in self._observers if each is not observer)

        return leave

    @contextmanager
    def entered(self, call: VerbCall) -> Iterator[str]:
        """Mark the time of a call; gives the verb that keeps it from beginning, or "".

        One call of a robot's own verbs runs at a time, with those that it calls itself.
        """
        with self._beginning:
            other = next((each.name for each in self.calls if each.call is not call.call), "")
            outer = not self._running
            if not other:
                self._running[call] = None
        try:
            if not other and outer:
                self._tell(call)
            yield other
        finally:
            if not other:
                self._running.pop(call, None)
                if outer:
                    self._tell(call)

    def _tell(self, call: VerbCall) -> None:
        for observer in self._observers:
            observer(call)
