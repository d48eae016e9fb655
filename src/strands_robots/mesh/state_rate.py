"""Rate of a robot's state: 10 Hz while it moves, 1 Hz while it is idle.

More than 40 robots of a process that publish ten a second each pass what Zenoh carries on a link and states are lost.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.contract import RUNNING
from strands_robots.mesh.scheduler import repeat
from strands_robots.safety.gate import MotionGate

IDLE_HZ = 1.1
"""States a second of a robot that does nothing: at least one, even where one is a little late."""

LOOK_HZ = 10.0
"""Looks a second for a change of the lockouts, which nothing else tells."""

ACTIVE_S = 1.0
"""Seconds after the last sign of a motion in which the state is published as if the robot moved."""

STILL = 1e-3
"""Change of a joint, in its own unit, up to which it stands still: noise, and the settling of a simulation."""


class StateRate:
    """Signs of a robot's motion: its gate, lockouts and last states; any thread.

    Args:
        gate: every motion asks it for a permit before it begins.
        epochs: returns the lockouts of the robot.
        hurry: has the state published at once.
    """

    def __init__(
        self,
        gate: MotionGate,
        epochs: Callable[[], object],
        hurry: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._gate = gate
        self._epochs = epochs
        self._hurry = hurry
        self._clock = clock
        self._seen_halts, self._seen_given = self._halts(), gate.given
        self._active_until = -math.inf
        self._joints: dict[str, float] = {}

    @property
    def active(self) -> bool:
        """True while the robot moves, and shortly after."""
        return self._clock() < self._active_until

    def begins(self) -> None:
        """Publish at once for the first motion after a rest; called before each permit."""
        if not self.active:
            self._wake()

    def look(self) -> None:
        """Publish at once after a halt or a change of the lockouts."""
        halts, given = self._halts(), self._gate.given
        if halts != self._seen_halts:
            self._seen_halts = halts
            self._wake()
        if given != self._seen_given:
            self._seen_given = given
            self._active_until = self._clock() + ACTIVE_S

    def published(self, body: Mapping[str, Any]) -> None:
        """Note a state: it tells whether a task runs and whether joints have moved."""
        joints = dict(_positions(body.get("joints")))
        moved = joints.keys() != self._joints.keys() or any(
            abs(at - self._joints[name]) > STILL for name, at in joints.items()
        )
        if moved:
            # Compared with the last that counted as moved, so that a slow motion adds up.
            self._joints = joints
        task, robots = body.get("task"), body.get("robots")
        runs = isinstance(task, Mapping) and task.get("status") in RUNNING
        if moved or runs or (isinstance(robots, Mapping) and any(robots.values())):
            self._active_until = self._clock() + ACTIVE_S

    def _wake(self) -> None:
        self._active_until = self._clock() + ACTIVE_S
        self._hurry()

    def _halts(self) -> object:
        return self._gate.generation, self._epochs()


class StateRates:
    """The rates of a process, looked at by one job for all of its robots."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rates: tuple[StateRate, ...] = ()
        self._end: Callable[[], None] | None = None

    def join(self, rate: StateRate) -> None:
        """Look at ``rate`` from now on."""
        with self._lock:
            self._rates = (*self._rates, rate)
            if self._end is None:
                self._end = repeat("states", LOOK_HZ, self._look)

    def leave(self, rate: StateRate) -> None:
        """Look at ``rate`` no more."""
        with self._lock:
            self._rates = tuple(each for each in self._rates if each is not rate)
            end, self._end = (None, self._end) if self._rates else (self._end, None)
        if end is not None:
            end()

    def _look(self) -> None:
        for rate in self._rates:
            rate.look()


STATE_RATES = StateRates()
"""The rates of this process."""


def _positions(joints: object) -> list[tuple[str, float]]:
    found = []
    for name, entry in joints.items() if isinstance(joints, Mapping) else ():
        at = entry.get("position") if isinstance(entry, Mapping) else entry
        if isinstance(at, int | float) and not isinstance(at, bool):
            found.append((str(name), float(at)))
    return found
