"""Leaders as policies within a follower's bounds; keyboard and gamepad leaders.

A leader is any object with ``get_action() -> dict`` of targets by action key (a LeRobot teleoperator, a gamepad). It
may have ``is_connected`` and ``get_teleop_events()``, and raises :class:`LeaderFinished` at its end.

Source of the joystick format: Linux, ``Documentation/input/joydev/joystick-api.rst``: events of eight bytes, ``u32
time`` in milliseconds, ``s16 value``, ``u8 type`` (1 button, 2 axis, with 0x80 for the state at opening), ``u8
number``.
"""

from __future__ import annotations

import logging
import math
import os
import select
import struct
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Mapping
from typing import Any, Protocol, Self

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


SHARE_PER_S = 0.25
"""Part of a joint's whole range that a key held down, or a stick pushed to its end, crosses in a second."""

JOG_UNBOUNDED_PER_S = 45.0
"""The same for a joint without a range, in its unit a second."""

UP, DOWN = "qwertyuiop", "asdfghjkl;"
"""Keys that raise and lower each joint, in the joints' order."""

STEP_S = 0.1
"""One press moves a joint as far as a key held down for this long."""

_END = "\x1b\x03\x04"

PORT = "/dev/input/js0"
DEAD_ZONE = 0.1
"""Part of a stick's travel that counts as rest."""

_EVENT = struct.Struct("<IhBB")
_BUTTON, _AXIS, _OPENING = 1, 2, 0x80
_END_BUTTON = 1
_FULL = 32767
_GAP_MAX_S = 0.1


class Jog:
    """Targets of some joints, each moved on its own and kept inside its range.

    Args:
        start: their positions by action key, in the follower's units.
        ranges: lowest and highest target by action key; a missing key is unbounded.
    """

    def __init__(self, start: Mapping[str, float], ranges: Ranges) -> None:
        if not start:
            raise ValidationError("start must hold at least one joint to lead.")
        self.keys = tuple(start)
        self._targets = dict(start)
        self._ranges = {key: ranges.get(key, (-math.inf, math.inf)) for key in start}

    @property
    def targets(self) -> Action:
        """The present targets of all joints."""
        return dict(self._targets)

    def move(self, key: str, push: float, seconds: float) -> None:
        """Push a joint for some seconds; ``push`` is -1 to 1."""
        low, high = self._ranges[key]
        speed = (high - low) * SHARE_PER_S if math.isfinite(high - low) else JOG_UNBOUNDED_PER_S
        self._targets[key] = min(max(self._targets[key] + push * speed * seconds, low), high)


class KeyboardLeader:
    """A leader of a terminal's keys, while entered; Escape or Ctrl-D ends it.

    Args:
        start: the follower's position by action key; at most ten joints.
        ranges: of the follower's action keys.
        fd: the terminal; standard input by default.

    Raises:
        ValidationError: too many joints, or ``fd`` is no terminal.
    """

    def __init__(self, start: Mapping[str, float], ranges: Ranges, fd: int | None = None) -> None:
        if len(start) > len(UP):
            raise ValidationError(f"start must hold at most {len(UP)} joints, not {len(start)}.")
        self._fd = sys.stdin.fileno() if fd is None else fd
        if not os.isatty(self._fd):
            raise ValidationError("keyboard needs a terminal; standard input is none.")
        self._jog = Jog(start, ranges)
        self._pushes = {up: (key, 1.0) for up, key in zip(UP, self._jog.keys, strict=False)}
        self._pushes |= {down: (key, -1.0) for down, key in zip(DOWN, self._jog.keys, strict=False)}
        self._before: list[int | list[bytes | int]] | None = None

    @property
    def is_connected(self) -> bool:
        """The terminal gives single keys."""
        return self._before is not None

    @property
    def help(self) -> list[tuple[str, str, str]]:
        """Name, raising key and lowering key of each joint."""
        return [(key, UP[index], DOWN[index]) for index, key in enumerate(self._jog.keys)]

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        return self

    def __exit__(self, *exc: object) -> None:
        before, self._before = self._before, None
        if before is not None:
            termios.tcsetattr(self._fd, termios.TCSADRAIN, before)

    def get_action(self) -> Action:
        """Return all targets after the keys pressed since the last call.

        Raises:
            LeaderFinished: Escape or Ctrl-D was pressed.
        """
        while select.select([self._fd], [], [], 0)[0]:
            pressed = os.read(self._fd, 64).decode("ascii", "ignore")
            if not pressed:
                break
            for char in pressed:
                if char in _END:
                    raise LeaderFinished("the keyboard ended it")
                if char.lower() in self._pushes:
                    key, push = self._pushes[char.lower()]
                    self._jog.move(key, push, STEP_S)
        return self._jog.targets


class GamepadLeader:
    """A leader of stick axes, one for each joint in order; button 1 ends it.

    Args:
        start: the follower's position by action key.
        ranges: of the follower's action keys.
        port: the joystick device.
        now: monotonic seconds.

    Raises:
        ValidationError: the device cannot be opened.
    """

    def __init__(
        self,
        start: Mapping[str, float],
        ranges: Ranges,
        port: str = PORT,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._jog = Jog(start, ranges)
        self._now = now
        self._at: float | None = None
        self._pushes: dict[int, float] = {}
        self._buttons: dict[int, bool] = {}
        try:
            self._fd: int | None = os.open(port, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as exc:
            raise ValidationError(f"gamepad {port!r} cannot be opened: {exc.strerror}.") from exc

    @property
    def is_connected(self) -> bool:
        """The device is open."""
        return self._fd is not None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)

    def get_action(self) -> Action:
        """Return all targets, pushed for the time since the last call, at most 0.1 s.

        Raises:
            LeaderFinished: button 1 was pressed.
            OSError: the gamepad was unplugged.
        """
        self._read()
        if self._buttons.get(_END_BUTTON):
            raise LeaderFinished("the gamepad ended it")
        now = self._now()
        seconds = 0.0 if self._at is None else min(now - self._at, _GAP_MAX_S)
        self._at = now
        for axis, push in self._pushes.items():
            if axis < len(self._jog.keys) and abs(push) > DEAD_ZONE:
                self._jog.move(self._jog.keys[axis], push, seconds)
        return self._jog.targets

    def get_teleop_events(self) -> dict[str, Any]:
        """Return the buttons' states by number."""
        return {f"button_{number}": pressed for number, pressed in self._buttons.items()}

    def _read(self) -> None:
        if self._fd is None:
            raise ConnectionError("the gamepad is closed")
        while True:
            try:
                data = os.read(self._fd, _EVENT.size * 64)
            except BlockingIOError:
                return
            for _, value, kind, number in _EVENT.iter_unpack(data[: len(data) // _EVENT.size * _EVENT.size]):
                if kind & ~_OPENING == _AXIS:
                    self._pushes[number] = max(value / _FULL, -1.0)
                elif kind & ~_OPENING == _BUTTON:
                    self._buttons[number] = bool(value)
            if len(data) < _EVENT.size * 64:
                return
