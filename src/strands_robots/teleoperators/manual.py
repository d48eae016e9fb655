"""Keyboard and gamepad leaders, which jog the joints of a follower.

Source of the joystick format: Linux, ``Documentation/input/joydev/joystick-api.rst``: events of eight bytes, ``u32
time`` in milliseconds, ``s16 value``, ``u8 type`` (1 button, 2 axis, with 0x80 for the state at opening), ``u8
number``.
"""

from __future__ import annotations

import math
import os
import select
import struct
import sys
import termios
import time
import tty
from collections.abc import Callable, Mapping
from typing import Any, Self

from strands_robots.policies.base import Action, Ranges
from strands_robots.teleoperators.leader import LeaderFinished
from strands_robots.utils import ValidationError

SHARE_PER_S = 0.25
"""Part of a joint's whole range that a key held down, or a stick pushed to its end, crosses in a second."""

UNBOUNDED_PER_S = 45.0
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
        speed = (high - low) * SHARE_PER_S if math.isfinite(high - low) else UNBOUNDED_PER_S
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
