"""LeRobot devices by name, made but not connected, and leader arms.

LeRobot keeps its devices in registries of configuration classes (``RobotConfig``, ``TeleoperatorConfig``,
``CameraConfig``), filled when the module of each device is imported. Run on LeRobot 0.4.4 and 0.6.1.
"""

from __future__ import annotations

import dataclasses
import logging
import pkgutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from strands_robots.bus_access import bus_lock
from strands_robots.hardware._compat import drop, forget_input, lerobot_module, light
from strands_robots.hardware.body import DeviceBody
from strands_robots.hardware.calibration import calibrate_from
from strands_robots.hardware.device_facts import check_port
from strands_robots.policies.base import Action
from strands_robots.utils import ValidationError, alike, mapping, missing_extra, shown

logger = logging.getLogger(__name__)

Role = Literal["follower", "leader"]

_ROLES = {
    "follower": ("lerobot.robots", "RobotConfig", "make_robot_from_config"),
    "leader": ("lerobot.teleoperators", "TeleoperatorConfig", "make_teleoperator_from_config"),
}
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
    kind = name if name in known else f"{name}_{role}"
    if kind not in known:
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
    device = getattr(devices, factory)(config)
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


def _cameras(given: object) -> dict[str, Any]:
    made = {}
    for name, camera in mapping("cameras", given).items():
        if not isinstance(camera, Mapping):
            made[name] = camera
            continue
        fields = dict(camera)
        kind = str(fields.pop("type", "opencv"))
        try:
            lerobot_module(f"lerobot.cameras.{_CAMERA_MODULES.get(kind, kind)}")
        except ImportError as exc:
            raise ValidationError(f"cameras[{name!r}] is of the type {kind!r}, which is not available: {exc}.") from exc
        try:
            made[name] = lerobot_module("lerobot.cameras").CameraConfig.get_choice_class(kind)(**fields)
        except (TypeError, ValueError, KeyError) as exc:
            raise ValidationError(f"cameras[{name!r}] cannot be made with {sorted(fields)}: {exc}.") from exc
    return made


READ_TRIES = 3
"""Joint reads that fail before a frame counts as unusable; LeRobot waits 50 ms for each answer."""


class LeaderArm:
    """A LeRobot leader, connected without a prompt while it is entered as a context.

    Args:
        device: has ``connect``, ``disconnect`` and ``get_action``; its joints are moved by hand.
    """

    def __init__(self, device: Any) -> None:
        self.device = device
        self._lock = bus_lock(device)

    @property
    def is_connected(self) -> bool:
        """The device's own state; a device without one counts as connected."""
        return bool(getattr(self.device, "is_connected", True))

    def __enter__(self) -> Self:
        DeviceBody.bring_up(self.device)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.device.disconnect()
        except OSError:
            # Its cable is out, or a servo does not answer.
            drop(self.device)

    def get_action(self) -> Action:
        """Read the joints by action key; raise after three lost answers."""
        with self._lock:
            for left in reversed(range(READ_TRIES)):
                # A late answer would be taken for this one's, and every read after it would be old.
                forget_input(self.device)
                try:
                    return dict(self.device.get_action())
                except ConnectionError:
                    if not left:
                        raise
        raise AssertionError  # the last try returns or raises

    def get_teleop_events(self) -> dict[str, Any] | None:
        """Read the device's events besides its joints; None for a device without any."""
        read = getattr(self.device, "get_teleop_events", None)
        return dict(read()) if callable(read) else None
