"""Access to a device's bus: one re-entrant lock, joints without cameras.

A serial motor bus carries one exchange at a time, so every read and every write of a device holds
:func:`bus_lock` of it. A wrapper and the device inside it share one lock.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from strands_robots.moved import of_module
from strands_robots.policies.base import numbers

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


NESTING_MAX = 4
"""Wrappers around wrappers that are looked through."""

AMPERES = {"sts3215": 0.0065}
"""Ampere of one unit of ``Present_Current`` by LeRobot's name of the motor, whose 15 lower bits are its magnitude.

LeRobot 0.4.4 does not decode the direction, bit 15. Motors that are not named here have none that is known.
"""

_CURRENT_BITS = 0x7FFF
_INNER = ("device", "robot")
_READERS = ("get_joints", "get_observation")

NORMALISED = {"RANGE_M100_100": (-100.0, 100.0), "RANGE_0_100": (0.0, 100.0)}
"""LeRobot's normalised motor ranges (``MotorNormMode``)."""

TEXTS = (str, "str", "string")
"""Features that are words, such as a mode, which no policy and no caller sets."""

_locks: dict[int, tuple[object, threading.RLock]] = {}
_guard = threading.Lock()


def joint_read_source(robot: Any) -> Any | None:
    """The object that a robot's joints are read from, or None when it has none.

    A native driver that owns its bus is its own source; a wrapper's is the device inside it (``device``, or
    ``robot`` as LeRobot's own wrappers call it), through at most :data:`NESTING_MAX` wrappers.
    """
    source = robot
    for _ in range(NESTING_MAX):
        inner = next((each for each in (getattr(source, name, None) for name in _INNER) if _may_be_device(each)), None)
        if inner is None or inner is source:
            break
        source = inner
    return source if _readable(source) else None


def bus_lock(device: Any) -> threading.RLock:
    """Return the lock of the bus behind ``device``; a wrapper has the same."""
    source = joint_read_source(device)
    key = device if source is None else source
    with _guard:
        known = _locks.get(id(key))
        if known is None:
            known = (_reference(key), threading.RLock())
            _locks[id(key)] = known
        return known[1]


def read_joints(device: Any) -> dict[str, float]:
    """Read joint positions by key, in the device's unit, under the bus lock.

    From ``get_joints()`` where the device has it and answers with numbers (a native driver that answers with an
    envelope names its motors there, not its action keys), from the motor buses alone where those of a LeRobot device
    give every number that it observes: one bus, several, or those of arms in a pair (``left_arm``, ``right_arm``).
    Else, as of a base that computes its speed, the numbers of a whole observation, which a failing camera fails.
    Raises what the device raises.
    """
    return joint_reader(device)()


def joint_reader(device: Any) -> Callable[[], dict[str, float]]:
    """Return a reader of a device's joints, as :func:`read_joints`.

    The buses are looked for once.
    """
    source = joint_read_source(device)
    if source is None:
        return dict
    lock, buses = bus_lock(source), motor_buses(source)

    def read() -> dict[str, float]:
        with lock:
            own = getattr(source, "get_joints", None)
            answer = own() if callable(own) else None
            if answer is not None and "status" not in answer:
                return numbers(answer)
            if not buses:
                return declared_numbers(source, source.get_observation())
            joints: dict[str, float] = {}
            for prefix, bus in buses:
                positions = bus.sync_read("Present_Position")
                joints |= numbers({f"{prefix}{name}.pos": positions[name] for name in bus.motors})
            return joints

    return read


def declared_numbers(device: Any, observation: Mapping[str, Any]) -> dict[str, float]:
    """Return the declared numbers of an observation; all where none is declared.

    A driver may answer with more, such as what a joint was told last, which is no position.
    """
    features = getattr(device, "observation_features", None)
    found = numbers(observation)
    return (
        {key: found[key] for key in found if key in features} if isinstance(features, Mapping) and features else found
    )


def read_currents(device: Any) -> dict[str, float]:
    """Read the magnitude of each motor's current in ampere, under the bus lock.

    By the keys of :func:`read_joints`: from ``get_currents()`` where the device has it, else from the motor buses of a
    LeRobot device, of the motors in :data:`AMPERES`, in one exchange a bus. Empty, without an exchange, for any other.
    Raises what the device raises.
    """
    source = joint_read_source(device)
    if source is None:
        return {}
    with bus_lock(source):
        own = getattr(source, "get_currents", None)
        if callable(own):
            return {key: abs(value) for key, value in numbers(own()).items()}
        currents: dict[str, float] = {}
        for prefix, bus in motor_buses(source):
            models = {name: str(getattr(motor, "model", "")) for name, motor in bus.motors.items()}
            known = [name for name, model in models.items() if model in AMPERES]
            drawn = bus.sync_read("Present_Current", known) if known else {}
            for name in known:
                currents[f"{prefix}{name}.pos"] = (abs(int(drawn[name])) & _CURRENT_BITS) * AMPERES[models[name]]
        return currents


def write_joints(device: Any, targets: Mapping[str, float]) -> None:
    """Write joint targets without a read, by the motor buses of a LeRobot device.

    LeRobot's drivers read every joint before they write a bounded step (``max_relative_target``), and one silent motor
    fails that for all. Other devices are sent an action. Raises what the device raises, of several buses once each of
    them was written to.
    """
    buses = motor_buses(device)
    if not buses or not all(callable(getattr(bus, "sync_write", None)) for _, bus in buses):
        device.send_action(dict(targets))
        return
    failed: Exception | None = None
    for prefix, bus in buses:
        names = {name: f"{prefix}{name}.pos" for name in bus.motors}
        goals = {name: targets[key] for name, key in names.items() if key in targets}
        try:
            # LeRobot cannot write to no motor.
            if goals:
                bus.sync_write("Goal_Position", goals)
        except Exception as exc:  # noqa: BLE001 - a bus may raise anything; the others are written to first
            failed = failed or exc
    if failed is not None:
        raise failed


def action_ranges(device: Any) -> dict[str, tuple[float, float]]:
    """Return the range of every number of an action; infinite where none is known.

    A LeRobot motor in degrees has the range of its calibration, which LeRobot centres on 0:
    ``(range_max - range_min) / 2`` encoder counts each way, of 4096 a turn minus one.
    """
    declared = getattr(device, "joint_ranges", None)
    known: Mapping[str, Any] = declared if isinstance(declared, Mapping) else {}
    motors = _described(device)
    ranges: dict[str, tuple[float, float]] = {}
    for key, feature in dict(device.action_features).items():
        if feature in TEXTS:
            continue
        if key in known:
            low, high = known[key]
            ranges[key] = (float(low), float(high))
        else:
            ranges[key] = _motor_range(*motors[key]) if key in motors else (-math.inf, math.inf)
    return ranges


def _described(device: Any) -> dict[str, tuple[Any, str]]:
    """Return bus and name of the motor of each key, beside the wheels of a base."""
    bus = getattr(device, "bus", None)
    own = [("", bus)] if _is_bus(bus) else []
    buses = (*own, *motor_buses(device))
    return {f"{prefix}{motor}.pos": (each, motor) for prefix, each in buses for motor in each.motors}


def _motor_range(bus: Any, motor: str) -> tuple[float, float]:
    mode = str(getattr(getattr(bus.motors[motor], "norm_mode", None), "name", ""))
    if mode in NORMALISED:
        return NORMALISED[mode]
    calibration = getattr(bus, "calibration", None)
    entry = calibration.get(motor) if isinstance(calibration, Mapping) else None
    if mode == "DEGREES" and entry is not None:
        half = (entry.range_max - entry.range_min) / 2 * 360 / 4095
        return (-half, half)
    return (-math.inf, math.inf)


def _motors(device: Any) -> Mapping[str, Any] | None:
    """Return the motors whose one bus gives every observed number, else None."""
    bus: Any = getattr(device, "bus", None)
    if not _is_bus(bus) or _scalars(device) != {f"{name}.pos" for name in bus.motors}:
        return None
    motors: Mapping[str, Any] = bus.motors
    return motors


def motor_buses(device: Any) -> list[tuple[str, Any]]:
    """Return the buses, with key prefixes, that give every observed number, if any."""
    if _motors(device) is not None:
        return [("", device.bus)]
    found: list[tuple[str, Any]] = []
    for name, part in getattr(device, "__dict__", {}).items():
        if _is_bus(part):
            found.append(("", part))
        elif _is_bus(getattr(part, "bus", None)):
            found.append((f"{name.removesuffix('_arm')}_", part.bus))
    keys = [f"{prefix}{motor}.pos" for prefix, bus in found for motor in bus.motors]
    return found if len(keys) == len(set(keys)) and set(keys) == _scalars(device) else []


def _is_bus(candidate: Any) -> bool:
    return isinstance(getattr(candidate, "motors", None), Mapping) and callable(getattr(candidate, "sync_read", None))


def _scalars(device: Any) -> set[str]:
    features = getattr(device, "observation_features", {})
    return {key for key, kind in features.items() if not isinstance(kind, tuple | list)}


def _may_be_device(candidate: Any) -> bool:
    return _readable(candidate) or any(_readable(getattr(candidate, name, None)) for name in _INNER)


def _readable(candidate: Any) -> bool:
    return any(callable(getattr(candidate, name, None)) for name in _READERS)


def _reference(key: Any) -> object:
    """Return a weak reference to the device, or the device where it allows none."""
    number = id(key)
    try:
        return weakref.ref(key, lambda _: _locks.pop(number, None))
    except TypeError:
        return key
