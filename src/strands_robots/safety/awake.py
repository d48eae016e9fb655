"""Clock of a process that notices when it did not run.

Every look at it is a proof that the process runs: one thread looks ten times a second, and every write of a motion
looks before it. Two looks that are half a second apart mean that nobody got to run in between: the process was stopped
by a signal, swapped out, or its machine slept. The first look after that holds the motions, whichever thread takes it,
because after a SIGCONT the thread of a motion may run before any other. A motion that writes seldom causes no hold, and
a busy machine none as long as any one of the threads that look gets half a second's share of it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from strands_robots.state_files import uptime
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

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
        self._held_until = float("-inf")
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
            self._held_until = now + (HOLD_S if now - last < LINKS_LOST_S else LONG_HOLD_S)
            self.pauses += 1
        if now > last:
            self._last = now
        return now

    def held_at(self, moment: float) -> bool:
        """Return True while every motion holds; never where nothing watches."""
        return self._over is not None and moment < self._held_until

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
                    self._last = float("inf")

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
                "This process did not run for a while; its motions hold for %.1f s.", self._held_until - self._last
            )
            for woke in self._watchers:
                try:
                    woke()
                except Exception:
                    logger.exception("What watches for pauses of this process raised.")


AWAKE = AwakeClock()
"""The clock of this process."""
