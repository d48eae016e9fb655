"""Time slices, garbage collector and pauses of the process's interpreter."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from strands_robots.state_files import uptime
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

T = TypeVar("T")

SWITCH_S = 0.0005
"""Longest time in seconds that a busy Python thread may keep the interpreter from the threads of a stop; Python's own
default is ten times that, and a stop wakes up to three threads on either side."""


class _WhileNeeded(Generic[T]):
    """A setting of the interpreter that is another one while anyone needs that.

    Args:
        read: returns the setting.
        change: changes it, given what it was.
        restore: undoes that, given what it was.
    """

    def __init__(self, read: Callable[[], T], change: Callable[[T], object], restore: Callable[[T], object]) -> None:
        self._read, self._change, self._restore = read, change, restore
        self._lock = threading.Lock()
        self._users = 0
        self._before = read()

    def begin(self) -> Callable[[], None]:
        """Change the setting; return the end of it.

        The setting is as before once every caller has ended it.
        """
        with self._lock:
            if not self._users:
                self._before = self._read()
                self._change(self._before)
            self._users += 1
        left = [None]

        def end() -> None:
            with self._lock:
                if not left:
                    return
                left.clear()
                self._users -= 1
                if not self._users:
                    self._restore(self._before)

        return end


class ShortTimeSlices(_WhileNeeded[float]):
    """Time slices of the interpreter in which busy threads give it up early."""

    def __init__(self) -> None:
        super().__init__(
            sys.getswitchinterval, lambda own_s: sys.setswitchinterval(min(own_s, SWITCH_S)), sys.setswitchinterval
        )

    def suspend(self) -> None:
        """Give the slices their own length while they are short."""
        with self._lock:
            if self._users:
                self._restore(self._before)

    def go_on(self) -> None:
        """Make the slices short again if anyone still needs that."""
        with self._lock:
            if self._users:
                self._change(self._before)


class LongTimeSlices(_WhileNeeded[None]):
    """Time slices of their own length in place of short ones.

    A stop of many robots is a few milliseconds of work on several threads. Short slices would cut it into dozens of
    hand-offs, each of which waits for a free core, and save it nothing beside a busy thread.
    """

    def __init__(self, short: ShortTimeSlices) -> None:
        super().__init__(lambda: None, lambda _: short.suspend(), lambda _: short.go_on())


class PausedCollector(_WhileNeeded[bool]):
    """Garbage collector that waits.

    A whole collection stops all threads of a large process for 0.1 s and more.
    """

    def __init__(self) -> None:
        super().__init__(gc.isenabled, lambda _: gc.disable(), lambda enabled: gc.enable() if enabled else None)


_SHORT_SLICES = ShortTimeSlices()
_LONG_SLICES = LongTimeSlices(_SHORT_SLICES)
_COLLECTOR = PausedCollector()

shorten_time_slices = _SHORT_SLICES.begin
"""Shortens the slices of this process."""


def undisturbed(*, many: bool) -> Callable[[], None]:
    """Prepare the interpreter for halts; return the end of it.

    Args:
        many: there are so many halts that slices of their own length are better for them.
    """
    ends = [_COLLECTOR.begin(), *([_LONG_SLICES.begin()] if many else [])]

    def end() -> None:
        for each in ends:
            each()

    return end


PAUSE_S = 0.5
"""Seconds without a look from which a process counts as one that did not run."""

HOLD_S = 0.3
"""Seconds for which motions hold from the first look after that."""

LINKS_LOST_S = 2.75
"""Pause from which peers may have given up the e-stop links of this process.

Their lease is 4 s and begins with the last keep-alive, which may lie a second before the pause.
"""

LONG_HOLD_S = 2.0
"""Hold after such a pause: links are dialled anew before the missed stops can be asked for."""

BEAT_S = 0.1
"""Seconds between two looks of the thread of its own."""


class AwakeClock:
    """Looks of one process. A look takes no lock and costs less than a microsecond.

    Args:
        clock: seconds that go on while the process is stopped and while the machine sleeps.
    """

    def __init__(self, clock: Callable[[], float] = uptime) -> None:
        self._clock = clock
        self._last = float("inf")
        self.held_until = float("-inf")
        """Moment until which every motion holds; never to come where nothing watches."""
        self.pauses = 0
        """Number of times that the process was found not to have run."""
        self._watching = threading.Lock()
        self._watchers: tuple[Callable[[], None], ...] = ()
        self._over: threading.Event | None = None

    def look(self) -> float:
        """Return the present moment, in s of the clock; hold the motions after a pause.

        Where nothing watches it changes nothing.
        """
        # Read first: the last watcher may end meanwhile, and no thread looks after that.
        over = self._over
        now, last = self._clock(), self._last
        if over is None:
            return now
        if now - last >= PAUSE_S:
            # Before the mark below: whoever finds a fresh mark also finds the hold.
            self.held_until = now + (HOLD_S if now - last < LINKS_LOST_S else LONG_HOLD_S)
            self.pauses += 1
            if self._over is None:  # the last watcher ended meanwhile
                self.held_until = float("-inf")
        if now > last:
            self._last = now
        return now

    def watch(self, woke: Callable[[], None]) -> Callable[[], None]:
        """Call ``woke`` after each pause, on a thread of this clock; return its end.

        The clock runs while anything watches. Without a thread to be had it does not run, and holds nothing.
        """
        with self._watching:
            self._watchers = (*self._watchers, woke)
            if self._over is None:
                self._start()

        def unwatch() -> None:
            with self._watching:
                self._watchers = tuple(each for each in self._watchers if each is not woke)
                if not self._watchers and self._over is not None:
                    self._over.set()
                    self._over = None
                    self._last, self.held_until = float("inf"), float("-inf")

        return unwatch

    def _start(self) -> None:
        over = threading.Event()
        try:
            threading.Thread(target=self._run, args=(over,), name="awake-clock", daemon=True).start()
        except RuntimeError:
            logger.critical("No thread notices when this process does not run.", exc_info=True)
        else:
            self._last = self._clock()
            self._over = over

    def _run(self, over: threading.Event) -> None:
        reported = self.pauses
        while not over.wait(BEAT_S):
            self.look()
            if self.pauses == reported:
                continue
            reported = self.pauses
            logger.warning(
                "This process did not run for a while; its motions hold for %.1f s.", self.held_until - self._last
            )
            for woke in self._watchers:
                try:
                    woke()
                except Exception:
                    logger.exception("What watches for pauses of this process raised.")


AWAKE = AwakeClock()
"""The clock of this process."""
