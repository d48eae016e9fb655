"""Calibrating an arm of bus servos: its middle and the ends of its joints, shown by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strands_robots.hardware._compat import forget_input
from strands_robots.hardware.calibration import COUNTS, calibrate_from
from strands_robots.utils import ValidationError

FULL_TURN = ("wrist_roll",)
"""Joints without ends: their range is the whole turn."""

_POSITION_MODE = 0


@dataclass(frozen=True, slots=True)
class Reach:
    """How far one joint was moved so far, in encoder counts."""

    low: int
    present: int
    high: int


LOOK_TRIES = 5
"""How often joints are asked for before the calibration is given up; LeRobot waits 50 ms for each answer."""


class Calibrating:
    """One calibration of a LeRobot device with one motor bus, a step at a time.

    Args:
        device: a follower or leader, not connected. Its torque goes off: an arm falls.

    Raises:
        ValidationError: a device without a motor bus.
    """

    def __init__(self, device: Any) -> None:
        bus: Any = getattr(device, "bus", None)
        if not callable(getattr(bus, "set_half_turn_homings", None)):
            raise ValidationError(f"{device} has no motor bus that is calibrated.")
        self._device, self._bus = device, bus
        self._offsets: dict[str, int] = {}
        self._reaches: dict[str, Reach] = {}

    def begin(self) -> None:
        """Connect and let go of the joints. Raises what the bus raises."""
        self._bus.connect()
        self._bus.disable_torque()
        for motor in self._bus.motors:
            self._bus.write("Operating_Mode", motor, _POSITION_MODE)

    def centre(self) -> None:
        """Take where every joint is now for the middle of its motion."""
        self._offsets = {motor: int(offset) for motor, offset in self._bus.set_half_turn_homings().items()}
        self._reaches = {}

    def look(self) -> dict[str, Reach]:
        """Read the joints once; how far each was moved since :meth:`centre`. Raises what the bus raises."""
        for motor, position in self._positions().items():
            at = int(position)
            known = self._reaches.get(motor, Reach(at, at, at))
            self._reaches[motor] = Reach(min(known.low, at), at, max(known.high, at))
        return dict(self._reaches)

    def watch(self, done: Callable[[], bool], told: Callable[[dict[str, Reach]], None]) -> None:
        """:meth:`look` and tell, until ``done``."""
        while not done():
            told(self.look())

    def finish(self) -> Path:
        """Write the calibration into the servos and into LeRobot's file of the device's id, and disconnect.

        Returns:
            The file.

        Raises:
            ValidationError: joints that were not moved, by name.
        """
        still = [motor for motor, reach in self._reaches.items() if reach.low >= reach.high]
        if still or not self._reaches:
            raise ValidationError(f"these joints were not moved: {', '.join(still) or 'none was'}.")
        content = {motor: self._entry(motor, each.id) for motor, each in self._bus.motors.items()}
        calibrate_from(self._device, content, name=str(self._device), role="")
        self._bus.write_calibration(self._device.calibration)
        path = Path(self._device.calibration_fpath)
        path.write_text(json.dumps(content, indent=4), encoding="utf-8")
        return path

    def close(self) -> None:
        """Disconnect; the torque stays off."""
        if self._bus.is_connected:
            self._bus.disconnect(disable_torque=False)

    def _positions(self) -> dict[str, Any]:
        """What the servos say. One lost answer of hundreds must not throw away a calibration by hand."""
        motors = [motor for motor in self._bus.motors if motor not in FULL_TURN]
        for left in reversed(range(LOOK_TRIES)):
            forget_input(self._device)
            try:
                return dict(self._bus.sync_read("Present_Position", motors, normalize=False))
            except ConnectionError:
                if not left:
                    raise
        raise AssertionError  # the last try returns or raises

    def _entry(self, motor: str, number: int) -> dict[str, int]:
        reach = Reach(0, 0, COUNTS - 1) if motor in FULL_TURN else self._reaches[motor]
        return {
            "id": number,
            "drive_mode": 0,
            "homing_offset": self._offsets[motor],
            "range_min": reach.low,
            "range_max": reach.high,
        }
