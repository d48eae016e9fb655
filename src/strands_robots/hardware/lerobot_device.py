"""LeRobot devices by name, made but not connected, and their calibration.

A servo counts 4096 steps a turn. Its homing offset puts the middle of the joint's motion at 2047, and its range is
where the joint ends. LeRobot keeps both in a file by the arm's id, the servos keep them in their own memory, and
LeRobot's driver asks at a prompt where the two differ. Here the file counts.

LeRobot keeps its devices in registries of configuration classes (``RobotConfig``, ``TeleoperatorConfig``,
``CameraConfig``), filled when the module of each device is imported. Run on LeRobot 0.4.4 and 0.6.1.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from strands_robots.hardware._compat import drop, forget_input, lerobot_imports, lerobot_module, light
from strands_robots.hardware.device_facts import check_port
from strands_robots.utils import ValidationError, alike, mapping, missing_extra, shown, whole

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
    # A driver may bring the calibration of its motors, which have no other.
    if not device.calibration and not getattr(bus, "calibration", None):
        command = f"strands-robots calibrate {name} --port {bus.port} --id {device.id}"
        raise ValidationError(
            f"{name} {device.id!r} has no calibration, for {device.calibration_fpath} is not there; "
            f"run {command}{' --leader' if role == 'leader' else ''}, or give calibration."
        )


def checked_calibration(content: object, motors: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Return ``content`` checked against ``motors`` (servo id by name).

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
    """Write the device's calibration into the servos, torque off meanwhile.

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


def answer_lost(problem: BaseException) -> bool:
    """Return True for a lost answer of a device, False for its port."""
    # LeRobot raises the same for both, caused by the system's error or by the lost answer, which is a ConnectionError.
    cause = problem.__cause__
    of_port = isinstance(cause, OSError) and not isinstance(cause, ConnectionError)
    return isinstance(problem, ConnectionError | RuntimeError) and not of_port


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


FULL_TURN = ("wrist_roll",)
"""Joints without ends: their range is the whole turn."""

_POSITION_MODE = 0

MOVED_COUNTS = 200
"""Least reach of a joint that was moved, in encoder counts: 18 degrees. One at rest trembles by a few."""


@dataclass(frozen=True, slots=True)
class JointReach:
    """Range over which one joint was moved so far, in encoder counts."""

    low: int
    present: int
    high: int


LOOK_TRIES = 5
"""Connections, or joint reads, that fail before the calibration is given up; LeRobot waits 50 ms for each answer."""


class Calibrator:
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
        self._reaches: dict[str, JointReach] = {}

    def begin(self) -> None:
        """Connect and let go of the joints, again after a lost answer."""
        for left in reversed(range(LOOK_TRIES)):
            try:
                self._bus.connect()
                self._bus.disable_torque()
                for motor in self._bus.motors:
                    self._bus.write("Operating_Mode", motor, _POSITION_MODE)
            except (ConnectionError, RuntimeError) as exc:
                drop(self._device)
                if not left or not answer_lost(exc):
                    raise
            else:
                return

    def centre(self) -> None:
        """Take the present position of every joint as the middle of its motion."""
        self._offsets = {motor: int(offset) for motor, offset in self._bus.set_half_turn_homings().items()}
        self._reaches = {}

    def look(self) -> dict[str, JointReach]:
        """Read the joints once; return the reach of each since :meth:`centre`."""
        for motor, position in self._positions().items():
            at = int(position)
            known = self._reaches.get(motor, JointReach(at, at, at))
            self._reaches[motor] = JointReach(min(known.low, at), at, max(known.high, at))
        return dict(self._reaches)

    def watch(self, done: Callable[[], bool], report: Callable[[dict[str, JointReach]], None]) -> None:
        """Report :meth:`look` until ``done``."""
        while not done():
            report(self.look())

    def unmoved(self) -> list[str]:
        """Return the joints that were not moved since :meth:`centre`."""
        moved = {motor for motor, reach in self._reaches.items() if reach.high - reach.low >= MOVED_COUNTS}
        return [motor for motor in self._bus.motors if motor not in moved and motor not in FULL_TURN]

    def finish(self) -> Path:
        """Write the calibration into servos and LeRobot's file, and disconnect.

        Returns:
            The file.

        Raises:
            ValidationError: joints that were not moved, by name.
        """
        still = self.unmoved()
        if still:
            raise ValidationError(f"these joints were not moved: {', '.join(still)}.")
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
        """Read the positions, again after a lost answer."""
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
        reach = JointReach(0, 0, COUNTS - 1) if motor in FULL_TURN else self._reaches[motor]
        return {
            "id": number,
            "drive_mode": 0,
            "homing_offset": self._offsets[motor],
            "range_min": reach.low,
            "range_max": reach.high,
        }


Role = Literal["follower", "leader"]

_ROLES = {
    "follower": ("lerobot.robots", "RobotConfig", "make_robot_from_config"),
    "leader": ("lerobot.teleoperators", "TeleoperatorConfig", "make_teleoperator_from_config"),
}
_PREFIXES: Mapping[Role, str] = {"follower": "lerobot_robot_", "leader": "lerobot_teleoperator_"}
"""Beginning of the import names of LeRobot's plug-ins."""

_WITHOUT_TORCH = ("so_follower", "so_leader")
"""Modules that need no torch to be imported; the others are left alone where there is none."""

_CAMERA_MODULES = {"intelrealsense": "realsense"}


def make_device(name: str, options: Mapping[str, Any], role: Role = "follower", *, calibrated: bool = True) -> Any:
    """A LeRobot device, not connected yet, with its calibration.

    Args:
        name: a LeRobot type, such as ``so100_follower`` or ``so100_leader``; ``so100`` means the one of ``role``.
        options: fields of its configuration, such as ``port`` and ``id`` (the name by default); ``cameras`` as
            dictionaries, each with a ``type`` (opencv where none is named); and ``calibration``, a LeRobot
            calibration file or its content, in the place of the one LeRobot keeps for that id.
        role: which registry.
        calibrated: refuse a device that has a motor bus and no calibration.

    Raises:
        MissingExtraError: LeRobot is not installed.
        ValidationError: an unknown name, with the near ones; options that its configuration refuses; no serial port;
            no calibration.
    """
    package, registry, factory = _ROLES[role]
    try:
        devices = lerobot_module(package)
    except ModuleNotFoundError as exc:
        raise missing_extra(f"The real robot {shown(name)}", "lerobot") from exc
    _register_all(devices)
    known: dict[str, Any] = getattr(devices, registry).get_known_choices()
    kind = _kind(name, role, known)
    if not kind:
        broken = _register_plug_in(str(name), role, lambda: getattr(devices, registry).get_known_choices())
        known = getattr(devices, registry).get_known_choices()
        kind = _kind(name, role, known)
        if not kind and broken:
            raise ValidationError(f"LeRobot's plug-in for {shown(name)} cannot be loaded: {broken}.")
    if not kind:
        similar = alike(str(name), known)
        hint = f"near it: {', '.join(similar)}" if similar else f"known: {', '.join(sorted(known))}"
        raise ValidationError(f"name must be a LeRobot {role} type, not {shown(name)}; {hint}.")
    fields = dict(options)
    calibration = fields.pop("calibration", None)
    if fields.get("cameras"):
        fields["cameras"] = _cameras(fields["cameras"])
    if isinstance(fields.get("calibration_dir"), str):
        fields["calibration_dir"] = Path(fields["calibration_dir"]).expanduser()
    asked = {each.name: each for each in dataclasses.fields(known[kind])}
    if "id" not in fields and "id" in asked:
        fields["id"] = name
    if "num_read_retries" in asked:
        # Reads are repeated here: LeRobot (from 0.6 on) takes the late answer to one try for that of the next, and
        # leaves the bus to no stop between two tries.
        fields.setdefault("num_read_retries", 0)
    # Of a robot on a network the port is a number.
    if "port" in asked and str(asked["port"].type) in ("str", "<class 'str'>"):
        check_port(str(name), fields.get("port"), needed=asked["port"].default is dataclasses.MISSING)
    try:
        config = known[kind](**fields)
    except (TypeError, ValueError) as exc:
        raise ValidationError(f"the options {sorted(fields)} do not configure {kind}: {exc}.") from exc
    with lerobot_imports():  # a plug-in's class is imported here
        try:
            device = getattr(devices, factory)(config)
        except ValueError as exc:
            raise ValidationError(f"{kind} cannot be made: {' '.join(str(exc).split())}.") from exc
    if calibrated or calibration is not None:
        calibrate_from(device, calibration, name=name, role=role)
    return device


def _register_all(devices: Any) -> None:
    bare = light()
    for module in pkgutil.iter_modules(devices.__path__, f"{devices.__name__}."):
        if not module.ispkg or (bare and module.name.rpartition(".")[2] not in _WITHOUT_TORCH):
            continue
        try:
            lerobot_module(module.name)
        except ImportError as exc:
            logger.debug("%s is not available: %s", module.name, exc)


def _kind(name: str, role: Role, known: Mapping[str, Any]) -> str:
    """Return the registered type that a name means; empty for none."""
    # Some packages register their type under the name of the package.
    meant = (name, f"{name}_{role}", f"{_PREFIXES[role]}{name}")
    return next((each for each in meant if each in known), "")


def _register_plug_in(name: str, role: Role, known: Callable[[], Mapping[str, Any]]) -> str:
    """Import LeRobot's plug-ins until one registers ``name``.

    The package of that name is the first. LeRobot finds them by the prefix of their import name. Which types a
    package has is known once it is imported.

    Returns:
        Errors of the packages that could not be imported; empty once the name is registered.
    """
    prefix = _PREFIXES[role]
    likely = prefix + name.removesuffix(f"_{role}").replace("-", "_")
    broken = []
    for package in sorted(lerobot_plug_ins(prefix), key=lambda each: (not each.startswith(likely), each)):
        try:
            lerobot_module(package)
        except Exception as exc:  # noqa: BLE001 - a package of a stranger raises what it likes
            broken.append(f"{package}: {type(exc).__name__}: {' '.join(str(exc).split())}".rstrip("."))
        if _kind(name, role, known()):
            return ""
    return "; ".join(broken)


def lerobot_plug_ins(prefix: str = "lerobot_") -> list[str]:
    """Return the import names of LeRobot's installed plug-ins; nothing is imported."""
    return sorted(each.name for each in pkgutil.iter_modules() if each.name.startswith(prefix))


def _cameras(given: object) -> dict[str, Any]:
    made = {}
    for name, camera in mapping("cameras", given).items():
        if not isinstance(camera, Mapping):
            made[name] = camera
            continue
        fields = dict(camera)
        kind = str(fields.pop("type", "opencv"))
        plug_in = f"lerobot_camera_{kind}"
        module = plug_in if plug_in in lerobot_plug_ins() else f"lerobot.cameras.{_CAMERA_MODULES.get(kind, kind)}"
        try:
            lerobot_module(module)
        except ImportError as exc:
            raise ValidationError(f"cameras[{name!r}] is of the type {kind!r}, which is not available: {exc}.") from exc
        try:
            made[name] = lerobot_module("lerobot.cameras").CameraConfig.get_choice_class(kind)(**fields)
        except (TypeError, ValueError, KeyError) as exc:
            raise ValidationError(f"cameras[{name!r}] cannot be made with {sorted(fields)}: {exc}.") from exc
    return made
