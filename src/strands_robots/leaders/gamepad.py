"""A gamepad as a leader: each stick axis pushes a joint, read from the kernel's joystick device.

Source of the format: Linux, ``Documentation/input/joydev/joystick-api.rst``: events of eight bytes, ``u32 time`` in
milliseconds, ``s16 value``, ``u8 type`` (1 button, 2 axis, with 0x80 for the state at opening), ``u8 number``.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

from strands_robots.leaders.jog import Jog
from strands_robots.policies.base import Action, Ranges
from strands_robots.teleop import LeaderDone
from strands_robots.utils import ValidationError

PORT = "/dev/input/js0"
DEAD_ZONE = 0.1
"""Part of a stick's way that is taken for rest."""

_EVENT = struct.Struct("<IhBB")
_BUTTON, _AXIS, _OPENING = 1, 2, 0x80
_END_BUTTON = 1
_FULL = 32767
_GAP_MAX_S = 0.1


class GamepadLeader:
    """Axis 0 pushes the first joint, axis 1 the second and so on; button 1 ends the leading.

    Args:
        start: where the follower stands, by action key.
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
        """Whether the device is open."""
        return self._fd is not None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None
    ) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)

    def get_action(self) -> Action:
        """Every target, pushed by the sticks for the time since the last call, of which at most 0.1 s counts.

        Raises:
            LeaderDone: button 1 was pressed.
            OSError: the gamepad was unplugged.
        """
        self._read()
        if self._buttons.get(_END_BUTTON):
            raise LeaderDone("the gamepad ended it")
        now = self._now()
        seconds = 0.0 if self._at is None else min(now - self._at, _GAP_MAX_S)
        self._at = now
        for axis, push in self._pushes.items():
            if axis < len(self._jog.keys) and abs(push) > DEAD_ZONE:
                self._jog.move(self._jog.keys[axis], push, seconds)
        return self._jog.targets

    def get_teleop_events(self) -> dict[str, Any]:
        """The buttons by number."""
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
