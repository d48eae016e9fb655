"""Leaders as policies, and leaders kept inside a follower's bounds.

A leader is any object with ``get_action() -> dict`` of targets by action key (a LeRobot teleoperator, a gamepad). It
may have ``is_connected`` and ``get_teleop_events()``, and raises :class:`LeaderFinished` at its end.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from strands_robots.errors import StrandsRobotsError
from strands_robots.policies.base import Action, Ranges, checked_action, limited, numbers, speeds_across
from strands_robots.utils import ValidationError, mapping

logger = logging.getLogger(__name__)

GIVE_UP_S = 0.5
"""Longest time without a usable frame; after it the teleoperation ends with an error and the follower stops."""

FULL_RANGES_PER_S = 2.0
"""Speed bound of a joint with a range, in whole ranges a second."""

UNBOUNDED_PER_S = 1440.0
"""Speed bound of a joint without a range, in its unit a second (two turns a second in degrees, twice)."""

MAGNITUDE_MAX = 720.0
"""Largest target of a joint without a range, in its unit."""


class LeaderFinished(StrandsRobotsError):  # noqa: N818 - an end, not a fault
    """End of a leader's actions; raised by ``get_action``, it ends the teleoperation."""


class InputSink(Protocol):
    """Second receiver of a leader's frames, given by a network; it never blocks."""

    def publish(self, device: str, method: str, action: Mapping[str, float], events: Mapping[str, Any] | None) -> None:
        """Publish one frame; ``events`` is None where none could be read."""


def teleop_events(leader: Any) -> dict[str, Any] | None:
    """Return a leader's events by name, or None; raises the leader's exceptions."""
    read = getattr(leader, "get_teleop_events", None)
    events = read() if callable(read) else None
    # LeRobot names events by a plain enumeration.
    return None if events is None else {str(getattr(key, "value", key)): value for key, value in dict(events).items()}


class LeaderPolicy:
    """A leader as a policy: checked, renamed, clamped and bounded in speed.

    A frame that cannot be read or used is counted and not applied; after :data:`GIVE_UP_S` without a usable one the
    rollout ends with an error. A follower that starts apart from its leader moves there at the speed bound.

    Args:
        leader: has ``get_action()``.
        device: the leader's name on the network.
        method: kind of leader: arm, gamepad, keyboard or phone.
        keys: follower's key for each leader's key; unnamed keys keep their name.
        max_speed: whole joint ranges a second.
        period: control period, seconds.
        sink: receives every usable frame, as the leader gave it.
    """

    uses_cameras = False

    def __init__(
        self,
        leader: Any,
        *,
        device: str = "leader",
        method: str = "arm",
        keys: Mapping[str, str] | None = None,
        max_speed: float = FULL_RANGES_PER_S,
        period: float = 0.02,
        sink: InputSink | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.frames = 0
        self.errors = 0
        self.event_errors = 0
        """Frames that went to the sink without events because reading those failed."""
        self.last_error = ""
        self._leader = leader
        self._device, self._method = device, method
        self._keys = dict(keys or {})
        self._max_speed = max_speed
        self._period = period
        self._sink = sink
        self._sink_failed = False
        self._now = now
        self._ranges: Ranges = {}
        self._speeds: dict[str, float] | None = None
        self._last: dict[str, float] = {}
        self._usable_at = 0.0

    def reset(self, instruction: str, ranges: Ranges) -> None:
        if getattr(self._leader, "is_connected", True) is False:
            raise ValidationError(f"teleoperator {self._device} is not connected; connect it first.")
        self._ranges = {
            key: (max(low, -MAGNITUDE_MAX) if low == -math.inf else low, MAGNITUDE_MAX if high == math.inf else high)
            for key, (low, high) in ranges.items()
        }
        self._speeds = speeds_across(ranges, self._max_speed, UNBOUNDED_PER_S)
        self._last = {}
        self._usable_at = self._now()

    def act(self, observation: Mapping[str, Any]) -> Action | list[Action] | None:
        now = self._now()
        try:
            frame = mapping("leader action", self._leader.get_action())
            target = checked_action({self._keys.get(key, key): value for key, value in frame.items()}, self._ranges)
        except LeaderFinished:
            return None
        except Exception as exc:
            self.errors += 1
            self.last_error = f"{type(exc).__name__}: {exc}"
            if now - self._usable_at >= GIVE_UP_S:
                raise
            return []
        self.frames += 1
        # A pause must not add up to a jump.
        dt = min(max(now - self._usable_at, self._period), 2 * self._period)
        self._usable_at = now
        if not self._last:
            self._last = {key: value for key, value in numbers(observation).items() if key in self._ranges}
        speeds = self._speeds or speeds_across(self._ranges, self._max_speed, UNBOUNDED_PER_S)
        self._last = {**self._last, **limited(target, self._last, speeds, dt)}
        self._publish(frame)
        return {key: self._last[key] for key in target}

    def interrupt(self) -> None:
        """Do nothing: a leader's read cannot be interrupted."""

    def close(self) -> None:
        """Do nothing: the leader stays connected for its owner."""

    def _publish(self, frame: Mapping[str, Any]) -> None:
        if self._sink is None:
            return
        try:
            self._sink.publish(self._device, self._method, numbers(frame), self._readable_events())
        except Exception:
            if not self._sink_failed:
                logger.exception("The frames of %s do not reach the network; the follower goes on.", self._device)
            self._sink_failed = True

    def events(self) -> dict[str, Any] | None:
        """Return the leader's events, or None; raises the leader's exceptions."""
        return teleop_events(self._leader)

    def _readable_events(self) -> dict[str, Any] | None:
        try:
            return self.events()
        except Exception as exc:
            self.event_errors += 1
            self.last_error = f"get_teleop_events: {type(exc).__name__}: {exc}"
            if self.event_errors == 1:
                logger.warning("The events of %s cannot be read; frames go on without.", self._device, exc_info=True)
            return None


class BoundedLeader:
    """A leader whose every frame is inside the follower's bounds.

    Args:
        policy: the leader as a policy, which checks, clamps and bounds its frames.
        start: the follower's position by action key; the first frames approach the leader's from there.
        ranges: of the follower's action keys.

    Raises:
        ValidationError: the leader is not connected.
    """

    is_connected = True

    def __init__(self, policy: LeaderPolicy, start: Mapping[str, float], ranges: Ranges) -> None:
        self.done = threading.Event()
        """Set when the leader has finished, or has failed for :data:`GIVE_UP_S`."""
        self.error = ""
        self._policy = policy
        self._start = dict(start)
        self._last: Action = {}
        policy.reset("lead a follower elsewhere", ranges)

    def get_action(self) -> Action:
        """Return the next frame, or the last one after the end.

        Raises:
            ValidationError: the leader gave no usable frame this time, or ended before its first.
        """
        action: object = None
        if not self.done.is_set():
            try:
                action = self._policy.act(self._start)
            except Exception as exc:  # noqa: BLE001 - a leader may raise anything; it ends, and the reason is stored
                self.error = f"{type(exc).__name__}: {exc}"
        if action is None:
            self.done.set()
            if not self._last:
                raise ValidationError("leader ended before its first frame.")
        elif isinstance(action, Mapping) and action:
            self._last = dict(action)
        else:
            raise ValidationError(f"leader gave nothing usable: {self._policy.last_error}.")
        return dict(self._last)

    def get_teleop_events(self) -> dict[str, Any] | None:
        """Return the leader's own events; raises the leader's exceptions."""
        return self._policy.events()
