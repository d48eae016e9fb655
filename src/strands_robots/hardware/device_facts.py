"""Port, identity, units, speeds, joints and parts of an arm of a LeRobot device.

Neither MuJoCo nor numpy is loaded: a robot says what it can do before its first motion. The model decides then; a
calibration that does not fit it is found with the first motion.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from strands_robots.bus_access import joint_read_source
from strands_robots.hardware._compat import forget_input
from strands_robots.kinematics import ArmParts, StatedJoint
from strands_robots.policies.base import JOINT_SPEED_RAD_S, Action, Ranges, is_velocity
from strands_robots.utils import ValidationError, shown

_PATTERNS = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "tty.usbmodem*", "tty.usbserial*")
"""Paths of USB serial adapters on Linux, by their own names first, and on macOS."""

_PORTS_SHOWN = 8


def serial_ports(dev: Path = Path("/dev")) -> list[str]:
    """Return the USB serial ports of this machine, by id where there is one."""
    for pattern in _PATTERNS:
        found = sorted(str(path) for path in dev.glob(pattern))
        if found:
            return found
    return []


def check_port(name: str, port: object, *, needed: bool) -> None:
    """Check that an option is a serial port.

    Raises:
        ValidationError: no text, or nothing where the robot needs a port.
    """
    if port is None and not needed:
        return
    if not isinstance(port, str) or not port.strip():
        given = "" if port is None else f", not {shown(port)}"
        raise ValidationError(f"{name} needs port, its serial port, such as /dev/ttyACM0{given}; {_here()}.")


def require_port(device: Any) -> None:
    """Check that the port of a device is on this machine.

    Raises:
        ConnectionError: its ``config.port`` is a path with nothing there.
    """
    port = getattr(getattr(device, "config", None), "port", None)
    if isinstance(port, str) and port.startswith("/") and not Path(port).exists():
        raise ConnectionError(f"the port {port} is not there; {_here()}")


def _here() -> str:
    found = serial_ports()
    return f"connected here: {', '.join(found[:_PORTS_SHOWN])}" if found else "no USB serial port is connected here"


BY_ID = Path("/dev/serial/by-id")
"""Directory in which Linux names serial ports by the make and serial number of their adapter."""

_HOSTS = ("remote_ip", "robot_ip", "ip_address", "host", "ip")


def stable_id(device: Any, by_id: Path = BY_ID) -> str | None:
    """Return the serial adapter's id, the host or the calibration id, or None.

    A calibration id goes with its port: two arms of one type may share it. A port without an id of its own keeps its
    name until it is plugged in elsewhere.
    """
    config = getattr(device, "config", None)
    port = _text(config, "port")
    if port:
        named = _adapter(port, by_id)
        if named:
            return named
    host = next((each for each in (_text(config, name) for name in _HOSTS) if each), "")
    if host:
        return host
    parts = [_text(device, "id") or _text(config, "id"), port]
    return "@".join(part for part in parts if part) or None


def kind(device: Any) -> str:
    """Return the device's type: LeRobot's name of it, else that of its class."""
    return _text(device, "name") or type(device).__name__


def _adapter(port: str, by_id: Path) -> str:
    if Path(port).parent == by_id:
        return Path(port).name
    target = os.path.realpath(port)
    # Without such a folder, or with one that is not to be read, no adapter has a name.
    with contextlib.suppress(OSError):
        for link in sorted(by_id.iterdir()):
            if os.path.realpath(link) == target:
                return link.name
    return ""


def _text(owner: Any, name: str) -> str:
    value = getattr(owner, name, None)
    return value.strip() if isinstance(value, str) else ""


def is_picture(feature: Any) -> bool:
    """Return True for a feature that is a picture's height, width and channels."""
    return isinstance(feature, tuple | list) and len(feature) == 3


def feature_type(feature: Any) -> Any:
    """Return a feature as data: the name of its type, or its shape."""
    shape = list(feature) if isinstance(feature, tuple | list) else str(feature)
    return getattr(feature, "__name__", None) or shape


UNITS = {"RANGE_M100_100": "normalized", "RANGE_0_100": "percent", "DEGREES": "degrees"}
"""Our name for each of LeRobot's ``MotorNormMode``: from -100 to 100, from 0 to 100, and degrees."""

TEMPERATURE = "Present_Temperature"
"""LeRobot's name of the register, degrees Celsius in Feetech's and Dynamixel's tables."""


def joint_units(device: Any) -> dict[str, str]:
    """Return the unit by action key: the device's ``joint_units``, else its motor's."""
    own = getattr(device, "joint_units", None)
    stated: Mapping[str, Any] = own if isinstance(own, Mapping) else {}
    motors = _motors(device)
    units: dict[str, str] = {}
    for key in device.action_features:
        motor = motors.get(str(key).removesuffix(".pos"))
        mode = str(getattr(getattr(motor, "norm_mode", None), "name", ""))
        unit = stated.get(key) or UNITS.get(mode)
        if unit:
            units[str(key)] = str(unit)
    return units


def calibration(device: Any) -> Mapping[str, Any]:
    """Return the calibration of the device's bus by motor; empty without one."""
    entries = getattr(getattr(device, "bus", None), "calibration", None)
    return entries if isinstance(entries, Mapping) else {}


def half_ranges(device: Any) -> dict[str, float]:
    """Return half the calibrated range of each motor, in radians."""
    return {
        str(motor): math.radians((entry.range_max - entry.range_min) / 2 * 360 / 4095)
        for motor, entry in calibration(device).items()
        if hasattr(entry, "range_max") and hasattr(entry, "range_min")
    }


COUNTS = 4096
"""Counts of one turn of the encoders by which calibrations are read here."""


def of_known_encoder(device: Any) -> frozenset[str]:
    """Return the motors whose encoder has :data:`COUNTS` a turn, as their bus says."""
    table = getattr(_bus(device), "model_resolution_table", None)
    counts: Mapping[Any, Any] = table if isinstance(table, Mapping) else {}
    return frozenset(
        str(name) for name, motor in _motors(device).items() if counts.get(getattr(motor, "model", None)) == COUNTS
    )


def has_temperatures(device: Any) -> bool:
    """Return True when every motor of the one bus has the temperature register."""
    bus = _bus(device)
    tables = getattr(bus, "model_ctrl_table", None)
    motors = _motors(device)
    if not motors or not isinstance(tables, Mapping) or not callable(getattr(bus, "sync_read", None)):
        return False
    return all(TEMPERATURE in tables.get(getattr(motor, "model", None), ()) for motor in motors.values())


def temperatures(device: Any) -> dict[str, float]:
    """Read degrees Celsius by motor, in one exchange; the caller has the bus."""
    # A late answer to an earlier read would be taken for this one's.
    forget_input(device)
    read = _bus(device).sync_read(TEMPERATURE, normalize=False)
    return {str(motor): float(value) for motor, value in read.items()}


def _bus(device: Any) -> Any:
    source = joint_read_source(device)
    return getattr(device if source is None else source, "bus", None)


def _motors(device: Any) -> Mapping[str, Any]:
    motors = getattr(_bus(device), "motors", None)
    return motors if isinstance(motors, Mapping) else {}


def default_speeds(device: Any) -> dict[str, float]:
    """Return 2 rad/s in the unit of each joint whose unit is an angle.

    A gripper that is told in percent, a base's velocity and a joint without a known unit have no bound of their own.
    """
    return {key: JOINT_SPEED_RAD_S * per_radian for key, per_radian in units_per_radian(device).items()}


def units_per_radian(device: Any) -> dict[str, float]:
    """Return the device's units in one radian, by action key, where that is known."""
    halves = half_ranges(device)
    factors = {
        key: _per_radian(unit, halves.get(key.removesuffix(".pos"))) for key, unit in joint_units(device).items()
    }
    return {key: per_radian for key, per_radian in factors.items() if per_radian}


def _per_radian(unit: str, half_range: float | None) -> float:
    """Return units per radian, 0 where that is not known."""
    known: Mapping[str, float] = {
        "radians": 1.0,
        "degrees": 180 / math.pi,
        "normalized": 100 / half_range if half_range else 0.0,
    }
    return known.get(unit, 0.0)


SUFFIX = ".pos"
"""End of LeRobot's keys of positions."""

_OF_POSITIONS = ("degrees", "radians", "metres", "normalized", "percent")
"""Units of positions; a key with another one, such as newtons, is none."""


def stated_joints(device: Any, bounds: Ranges, speeds: Mapping[str, float] | None = None) -> tuple[StatedJoint, ...]:
    """Return the joints of a device, in the order of its action keys.

    Args:
        device: its ``joint_units`` or its motors state the units.
        bounds: range of every action key, in the device's unit.
        speeds: greatest speed by action key, in its unit a second.
    """
    units, factors, known = joint_units(device), units_per_radian(device), of_known_encoder(device)
    # A normalized position is an angle only by the counts of the calibration, of which one turn has to be known.
    factors = {
        key: each for key, each in factors.items() if units[key] != "normalized" or key.removesuffix(SUFFIX) in known
    }
    return tuple(
        _stated(key, units.get(key, ""), factors.get(key, 0.0), bounds[key], (speeds or {}).get(key, math.inf))
        for key in _positions(bounds, units)
    )


def still_action(device: Any, bounds: Ranges, targets: Mapping[str, float], observed: Mapping[str, float]) -> Action:
    """Return an action that leaves every joint where it was told to be, or is.

    Velocities are zero. A key that may be no position, such as a force, is left out.
    """
    known = {key: value for key, value in {**observed, **targets}.items() if key in bounds}
    positions = {key: known[key] for key in _positions(bounds, joint_units(device)) if key in known}
    return {**{key: 0.0 for key in bounds if is_velocity(key)}, **positions}


def _positions(bounds: Ranges, units: Mapping[str, str]) -> list[str]:
    return [key for key in bounds if not is_velocity(key) and (key.endswith(SUFFIX) or units.get(key) in _OF_POSITIONS)]


def _stated(key: str, unit: str, factor: float, bounds: tuple[float, float], speed: float) -> StatedJoint:
    name, slides = key.removesuffix(SUFFIX), unit == "metres"
    if not (factor or slides):
        what = "degrees" if unit else "degrees or metres"
        return StatedJoint(
            name, key, refusal=f"it is told in {unit or 'an unknown unit'}, of which no {what} can be made"
        )
    if not all(math.isfinite(end) for end in bounds):
        return StatedJoint(name, key, not slides, refusal="its limits are not stated; give joint_ranges")
    scale = 1.0 if slides else factor * math.pi / 180
    low, high = sorted(end / scale for end in bounds)
    return StatedJoint(name, key, not slides, round(low, 9), round(high, 9), 1.0 if slides else factor, speed)


MODEL_OF = {"so100_follower": "so101", "so101_follower": "so101", "so_follower": "so101"}
"""The built-in model of each of LeRobot's arms."""

_BUILT_IN = ("so100", "so101")
_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
"""Joints of the built-in models."""

_JAWS = "gripper"


def model_name(device: Any, model: str | None) -> str:
    """Return the model that is stated, else that of the device's type; "" for none."""
    return model or MODEL_OF.get(kind(device), "")


def arm_parts(device: Any, bounds: Ranges, model: str | None) -> ArmParts:
    """Return what a device has of an arm.

    Args:
        device: the device.
        bounds: range of every action key.
        model: so100, so101 or the path of an MJCF file; by default that of the device's type.
    """
    name = model_name(device, model)
    if not name:
        movable = any(not each.refusal for each in stated_joints(device, bounds))
        return ArmParts(joints=movable and _installed("numpy"))
    if not (_installed("mujoco") and _installed("numpy")):
        return ArmParts()
    if name in _BUILT_IN:
        return _parts(_jaws(bounds, _JAWS)) if _fits(device, bounds) else ArmParts()
    if not Path(name).expanduser().is_file():
        return ArmParts()
    # LeRobot's grippers are told in percent; what the model calls its own is known once it is loaded.
    percent = [key for key, unit in joint_units(device).items() if unit == "percent"]
    return _parts(any(_jaws(bounds, key.removesuffix(".pos")) for key in (*percent, _JAWS)))


@cache
def _installed(package: str) -> bool:
    return find_spec(package) is not None


def _parts(jaws: bool) -> ArmParts:
    return ArmParts(joints=True, model=True, tip=True, jaws=jaws)


def _jaws(bounds: Ranges, name: str) -> bool:
    return any(math.isfinite(end - low) for low, end in (bounds[key] for key in (f"{name}.pos", name) if key in bounds))


def _fits(device: Any, bounds: Ranges) -> bool:
    """Return True where the built-in joints are there, with known zero and sign."""
    factors, calibrated = units_per_radian(device), calibration(device)
    keys = [next((key for key in (f"{name}.pos", name) if key in bounds), "") for name in _JOINTS]
    inverted = any(getattr(calibrated.get(name), "drive_mode", 0) for name in _JOINTS)
    return not inverted and all(factors.get(key) for key in keys)
