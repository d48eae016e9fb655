"""Real time: one thread for all worlds of a process, while one runs.

Stepping releases the GIL, and thirty worlds that each wake a thread two hundred times a second would spend more
time passing it on than computing; one thread visits them in turn instead. A world runs while a rollout or a
teleoperation holds a lease (:meth:`WorldClock.running`), and for :data:`SETTLE_S` after a command. After a step by
hand commands alone start nothing until the next lease, so the same steps give the same numbers.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from strands_robots.simulation.physics import Physics
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

TICK_S = 0.005
"""Period in which the pacing thread visits each running world."""

WORLDS_A_TICK = 10
"""Worlds visited every tick. More are visited less often, in longer steps, because every visit has to get the
interpreter back from the threads that ran meanwhile."""

SETTLE_S = 2.0
"""Seconds that physics goes on after a single command."""

MAX_BEHIND_S = 1.0
"""A world that is further behind real time than this drops the rest: it will not catch up."""

VISIT_S = 0.01
"""Longest visit while a world catches up, so that it does not starve the others."""

_CHUNK = 16


class WorldClock:
    """Pacing of one world; ``slipped_s`` is simulated time dropped when late.

    Args:
        held: returns True while no robot of the world may move; its time then stands still, and is not made up for.
    """

    def __init__(self, physics: Physics, *, on_command: bool = True, held: Callable[[], bool] = lambda: False) -> None:
        self._physics = physics
        self._held = held
        self._on_command = on_command
        self._lock = threading.Lock()
        self._leases = 0
        self._until = 0.0
        self._by_hand = False
        self._due: float | None = None
        self.slipped_s = 0.0
        self.paced_s = 0.0
        self.closed = False

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Take a lease: real time passes while it is held, and for a moment afterwards."""
        with self._lock:
            self._leases += 1
            self._by_hand = False
        _pacer.wake(self)
        try:
            yield
        finally:
            with self._lock:
                self._leases -= 1
                self._until = time.monotonic() + SETTLE_S / 4

    def commanded(self) -> None:
        """Let physics follow a new setpoint, unless the world is stepped by hand."""
        with self._lock:
            if self.closed or self._by_hand or not self._on_command:
                return
            self._until = time.monotonic() + SETTLE_S
        _pacer.wake(self)

    def by_hand(self) -> None:
        """Mark a step by hand: commands alone do not start the clock from now on."""
        with self._lock:
            self._by_hand = True
            self._until = 0.0

    def close(self) -> None:
        """Stop for good; return when the pacing thread has left this world."""
        with self._lock:
            self.closed = True
        _pacer.forget(self)

    @property
    def wanted(self) -> bool:
        """True while real time should pass."""
        with self._lock:
            return not self.closed and (self._leases > 0 or time.monotonic() < self._until)

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds for each real one: 1.0 unless the machine is too slow."""
        with self._lock:
            return 1.0 if self.paced_s <= 0 else max(0.0, 1.0 - self.slipped_s / self.paced_s)

    def tick(self, now: float) -> None:
        """Catch up with ``now``; called by the pacing thread alone."""
        timestep = self._physics.stage.plan.timestep
        if self._due is None or self._held():
            self._due = now
            return
        behind = now - self._due
        if behind > MAX_BEHIND_S:
            with self._lock:
                self.slipped_s += behind - MAX_BEHIND_S
                self.paced_s += behind - MAX_BEHIND_S
            self._due = now - MAX_BEHIND_S
            behind = MAX_BEHIND_S
        left = int(behind / timestep)
        leave = time.monotonic() + VISIT_S
        while left:
            steps = min(left, _CHUNK)
            self._physics.advance(steps)
            left -= steps
            self._due += steps * timestep
            with self._lock:
                self.paced_s += steps * timestep
            if time.monotonic() > leave:
                return

    def rest(self) -> None:
        """Forget when the next step was due, because nothing runs any more."""
        self._due = None


class _Pacer:
    """The pacing thread and the worlds it visits."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clocks: list[WorldClock] = []
        self._thread: threading.Thread | None = None

    def wake(self, clock: WorldClock) -> None:
        with self._lock:
            if clock.closed:
                return
            if clock not in self._clocks:
                self._clocks.append(clock)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="simulation-pacer", daemon=True)
                self._thread.start()

    def forget(self, clock: WorldClock) -> None:
        """Remove ``clock``, and wait for the end of the thread when it was the last."""
        with self._lock:
            thread = self._thread
            if clock in self._clocks:
                self._clocks.remove(clock)
            others = bool(self._clocks)
        if thread is not None and thread is not threading.current_thread() and not others:
            thread.join(timeout=2.0)

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            clocks = self._still_running()
            if not clocks:
                return
            now = time.monotonic()
            for clock in clocks:
                self._visit(clock, now)
            due = max(due + TICK_S * max(1.0, len(clocks) / WORLDS_A_TICK), time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))

    def _still_running(self) -> list[WorldClock]:
        """Return the clocks that still run; without any, mark the thread as ended."""
        with self._lock:
            for clock in [c for c in self._clocks if not c.wanted]:
                self._clocks.remove(clock)
                clock.rest()
            if not self._clocks:
                self._thread = None
            return list(self._clocks)

    def _visit(self, clock: WorldClock, now: float) -> None:
        try:
            clock.tick(now)
        except Exception:
            logger.exception("A simulated world cannot be stepped and is paused for good.")
            with self._lock:
                clock.closed = True


_pacer = _Pacer()
