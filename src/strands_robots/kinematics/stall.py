"""Contact of a moving arm, seen as a joint that stands still when told to move.

A joint is compared with its setpoints now and :data:`DELAY_S` ago, so that neither the delay of a servo nor the sag of
an arm under its payload counts: a joint that sags follows its setpoints, at a distance. Where the body reads the
currents of its motors, one that rises shows contact at a smaller lag; a current alone, of a payload, shows none.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # MuJoCo is not needed to watch joints
    from strands_robots.kinematics.chain import Floats

WINDOWS_S = (0.12, 0.22)
"""Times over which a joint is compared with its setpoints; the longer one is for slow motions."""

SLOW_WINDOWS_S = (0.45, 0.9, 1.8)
"""Such times for joints that go less than :data:`TOLD` in the others, down to 0.0045 rad/s."""

SLOW_SHARE = 0.1
"""Least way of a slow joint by that of the fastest: the sag of an arm that others stretch out is no contact."""

DELAY_S = 0.12
"""Greatest delay of a servo behind its setpoints."""

TOLD = 0.008
"""Least way of the setpoints in such a time by which a joint is judged (rad or m)."""

FOLLOWED = 0.2
"""Share of its way that a joint goes at least; one in contact goes less."""

STILL = 0.012
"""A joint that goes further in such a time does not stand still (rad or m)."""

CONFIRMED = 2
"""Control steps in a row in which a joint stands still."""

READ_LAG = 0.0087
"""Lag of a joint that stands still from which its current is read (rad or m): half a degree."""

PRESS_LAG = 0.0175
"""Least lag of a joint in contact whose current rises (rad or m): one degree."""

RISE_A = 0.25
"""Least rise of the current of a joint in contact over its lowest while it stands still (A).

A tenth of the stall current of an STS3215, and more than the 0.18 A that it draws to turn without a load. The rise also
has to be as much as the lowest current: a gear that carries a payload sticks until its current has risen by twice its
friction, which is less than that while the friction is below a third of the load. Assumed, not measured on real motors.
"""


class StallWatch:
    """Compares the joints of one motion with what they are told; for one thread.

    Args:
        lag: least distance of a joint from its setpoint, beyond that at the motion's start (rad or m).
    """

    def __init__(self, lag: float) -> None:
        self._lag = lag
        self._seen: list[tuple[float, Floats, Floats]] = []
        self._times: list[float] = []
        self._counts: Floats = np.zeros(0)
        self._lowest: Floats = np.zeros(0)
        self._reads = True

    def stalled(
        self, now: float, told: Floats, joints: Floats, currents: Callable[[], Floats] | None = None
    ) -> int | None:
        """Return the joint that stands still against its setpoints, if there is one.

        Args:
            now: the body's own time in seconds.
            told: setpoint of each joint (rad or m).
            joints: where they are.
            currents: reads the current of each joint's motor (A, NaN where it is not known), of which the sign does
                not count. Called only where a joint stands still at less than the full lag, and no more once it
                knows none.
        """
        if self._seen and now <= self._seen[-1][0]:
            return None
        self._seen.append((now, told, joints))
        self._times.append(now)
        # The first look stays, for the distance at the start.
        while len(self._seen) > 2 and self._seen[1][0] < now - DELAY_S - SLOW_WINDOWS_S[-1] - 0.1:
            del self._seen[1], self._times[1]
        if not len(self._counts):
            self._counts = np.zeros(len(joints))
            self._lowest = np.full(len(joints), np.nan)
        lags, steady = self._still(now)
        # Where the lag is enough, nothing is read.
        pressing = self._pressing(np.where(lags >= self._lag, -np.inf, steady), currents)
        self._counts = np.where((lags >= self._lag) | pressing, self._counts + 1, 0)
        worst = int(np.argmax(np.where(self._counts >= CONFIRMED, np.abs(told - joints), -1.0)))
        return worst if self._counts[worst] >= CONFIRMED else None

    def _pressing(self, lags: Floats, currents: Callable[[], Floats] | None) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Return which joints stand still with a current that has risen."""
        suspect = lags >= READ_LAG
        drawn = np.full(len(lags), np.nan)
        if currents is not None and self._reads and bool(np.any(suspect)):
            read = np.abs(currents())
            drawn = np.where(np.isfinite(read), read, np.nan)
            # A lost answer costs the bus some control steps, so it is not asked again.
            self._reads = not np.isnan(drawn).all()
        self._lowest = np.where(suspect, np.fmin(self._lowest, drawn), np.nan)
        rise = drawn - self._lowest
        result: np.ndarray[Any, np.dtype[np.bool_]] = (lags >= PRESS_LAG) & (rise >= np.fmax(RISE_A, self._lowest))
        return result

    def _still(self, now: float) -> Floats:
        """Return the lag of joints that do not follow, and of those that stand still.

        Both are the greatest of all windows, and minus infinity for the other joints.
        A joint that sinks under its payload as a motion begins draws more and more, and does not stand still.
        """
        first, last = self._seen[0], self._seen[-1]
        oldest = self._seen[1 if len(self._seen) > 1 else 0][0]
        windows = [window for window in (*WINDOWS_S, *SLOW_WINDOWS_S) if now - window >= oldest]
        if not windows:
            return np.full((2, len(last[2])), -np.inf)
        # One row for each window: the control thread has no time for one after another.
        before, earliest = ([self._at(now - delay - window) for window in windows] for delay in (0.0, DELAY_S))
        told = last[1] - np.array([look[1] for look in before])
        told_before = self._at(now - DELAY_S)[1] - np.array([look[1] for look in earliest])
        way = np.where(told * told_before > 0, np.sign(told) * np.minimum(np.abs(told), np.abs(told_before)), 0.0)
        gone = (last[2] - np.array([look[2] for look in before])) * np.sign(way)
        lag = ((last[1] - last[2]) - (first[1] - first[2])) * np.sign(way)
        fast = np.array([[window in WINDOWS_S] for window in windows])
        way = np.where(fast | (np.abs(way) >= SLOW_SHARE * np.abs(told).max(axis=1, keepdims=True)), way, 0.0)
        most = np.minimum(FOLLOWED * np.abs(way), STILL)
        behind = (np.abs(way) >= TOLD) & (gone <= most)
        found: Floats = np.where([behind, behind & (gone >= -most)], lag, -np.inf).max(axis=1)
        return found

    def _at(self, when: float) -> tuple[float, Floats, Floats]:
        """Return the last look at or before a time, else the first."""
        return self._seen[max(0, bisect_right(self._times, when) - 1)]
