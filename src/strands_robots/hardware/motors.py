"""What the motors of a LeRobot device tell besides their positions: the unit of each, and how warm they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from strands_robots.bus_access import joint_read_source
from strands_robots.hardware._compat import forget_input

UNITS = {"RANGE_M100_100": "normalized", "RANGE_0_100": "percent", "DEGREES": "degrees"}
"""Our word for each of LeRobot's ``MotorNormMode``: from -100 to 100, from 0 to 100, and degrees."""

TEMPERATURE = "Present_Temperature"
"""LeRobot's name of the register, degrees Celsius in Feetech's and Dynamixel's tables."""


def joint_units(device: Any) -> dict[str, str]:
    """The unit by action key: what the device's own ``joint_units`` says, else that of its motor."""
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


def tells_temperature(device: Any) -> bool:
    """Whether every motor of the device's one bus has the register."""
    bus = _bus(device)
    tables = getattr(bus, "model_ctrl_table", None)
    motors = _motors(device)
    if not motors or not isinstance(tables, Mapping) or not callable(getattr(bus, "sync_read", None)):
        return False
    return all(TEMPERATURE in tables.get(getattr(motor, "model", None), ()) for motor in motors.values())


def temperatures(device: Any) -> dict[str, float]:
    """Degrees Celsius by motor, in one exchange; whoever calls holds the bus. Raises what the device raises."""
    # An answer that came late would be taken for this one's.
    forget_input(device)
    read = _bus(device).sync_read(TEMPERATURE, normalize=False)
    return {str(motor): float(value) for motor, value in read.items()}


def _bus(device: Any) -> Any:
    source = joint_read_source(device)
    return getattr(device if source is None else source, "bus", None)


def _motors(device: Any) -> Mapping[str, Any]:
    motors = getattr(_bus(device), "motors", None)
    return motors if isinstance(motors, Mapping) else {}
