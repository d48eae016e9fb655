"""The calibration of an arm of bus servos: given, or read from LeRobot's file, never asked for at a prompt.

A servo counts 4096 steps a turn. Its homing offset puts the middle of the joint's motion at 2047, and its range is
where the joint ends. LeRobot keeps both in a file by the arm's id, the servos keep them in their own memory, and
LeRobot's driver asks at a prompt where the two differ. Here the file counts.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from strands_robots.hardware._compat import lerobot_module
from strands_robots.utils import ValidationError, mapping, shown, whole

logger = logging.getLogger(__name__)

COUNTS = 4096
"""Encoder steps of one turn of an STS3215."""

_OFFSET_MAX = 2047
_FIELDS = ("id", "drive_mode", "homing_offset", "range_min", "range_max")


def calibrate_from(device: Any, given: object, *, name: str, role: str) -> None:
    """Give a LeRobot device its calibration; nothing for a device that has none.

    Args:
        device: not connected.
        given: a file of LeRobot's or its content; None for the file of the device's id.
        name: what the device was asked for as, for the sentence that says how to calibrate it.
        role: follower or leader, for the same.

    Raises:
        ValidationError: there is none, or it does not fit the device.
    """
    bus: Any = getattr(device, "bus", None)
    if not hasattr(device, "calibration_fpath") or not isinstance(getattr(bus, "motors", None), Mapping):
        if given is not None:
            raise ValidationError(f"calibration must be left out: {name} has none.")
        return
    if given is not None:
        made = lerobot_module("lerobot.motors").MotorCalibration
        checked = checked_calibration(_content(given), {motor: each.id for motor, each in bus.motors.items()})
        device.calibration = {motor: made(**entry) for motor, entry in checked.items()}
        bus.calibration = device.calibration
    if not device.calibration:
        command = f"strands-robots calibrate {name} --port {bus.port} --id {device.id}"
        raise ValidationError(
            f"{name} {device.id!r} has no calibration, for {device.calibration_fpath} is not there; "
            f"run {command}{' --leader' if role == 'leader' else ''}, or give calibration."
        )


def checked_calibration(content: object, motors: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """``content`` as LeRobot writes it, checked against the ``motors`` (servo id by name) it is for.

    Raises:
        ValidationError: another arm's motors, or a number outside its domain.
    """
    given = mapping("calibration", content)
    if set(given) != set(motors):
        raise ValidationError(f"calibration must be for {', '.join(motors)}, not for {', '.join(given) or 'nothing'}.")
    checked = {}
    for motor, number in motors.items():
        entry = mapping(f"calibration[{motor!r}]", given[motor])
        missing = [field for field in _FIELDS if field not in entry]
        if missing:
            raise ValidationError(f"calibration[{motor!r}] lacks {', '.join(missing)}.")
        what = f"calibration[{motor!r}]"
        low = whole(f"{what} range_min", entry["range_min"], low=0, high=COUNTS - 2)
        checked[motor] = {
            "id": whole(f"{what} id", entry["id"], low=number, high=number),
            "drive_mode": whole(f"{what} drive_mode", entry["drive_mode"], low=0, high=1),
            "homing_offset": whole(f"{what} homing_offset", entry["homing_offset"], low=-_OFFSET_MAX, high=_OFFSET_MAX),
            "range_min": low,
            "range_max": whole(f"{what} range_max", entry["range_max"], low=low + 1, high=COUNTS - 1),
        }
    return checked


def write_to_servos(device: Any) -> None:
    """Make the servos hold the calibration of their device, torque off while it is written.

    Their positions are counted from the homing offset, so it must not change while a servo holds a goal. Nothing for
    a device without a calibration. The device is not connected before and not after.

    Raises:
        Exception: what the device's bus raises.
    """
    bus: Any = getattr(device, "bus", None)
    if not getattr(device, "calibration", None) or not callable(getattr(bus, "write_calibration", None)):
        return
    bus.connect()
    try:
        if not device.is_calibrated:
            logger.warning("The servos of %s had another calibration; the one of its file is written.", device)
            bus.disable_torque()
            bus.write_calibration(device.calibration)
    finally:
        bus.disconnect(disable_torque=False)


def _content(given: object) -> object:
    if not isinstance(given, str | Path):
        return given
    path = Path(given).expanduser()
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as exc:
        raise ValidationError(f"calibration {shown(str(given))} cannot be read: {exc.strerror}.") from exc
    except ValueError as exc:
        raise ValidationError(f"calibration {shown(str(given))} is no JSON: {exc}.") from exc
