"""A real robot behind the contract: tasks, teleoperation and single actions, and one verb that halts them all."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, cast

from strands_robots import settings
from strands_robots.bus_access import joint_read_source
from strands_robots.envelope import Envelope, error, success
from strands_robots.hardware.body import READ_TRIES, STOP_LEVELS, DeviceBody, StopLevel
from strands_robots.hardware.identity import kind, stable_id
from strands_robots.hardware.motors import joint_units, tells_temperature, temperatures
from strands_robots.hardware.tasks import ANSWER_SHARE, Tasks
from strands_robots.policies.base import checked_action
from strands_robots.recording.cameras import Shots
from strands_robots.safety.gate import MotionRefused, Permit, PermitVoidError
from strands_robots.safety.persistence import hardware_key
from strands_robots.safety.stopping import StopVerdict, halt_each
from strands_robots.safety.stopping import stop_level as configured_level
from strands_robots.utils import ValidationError, choice, number, text

logger = logging.getLogger(__name__)


IDLE_WAIT_S = 1.0
"""How long a read of the state waits for the bus while nothing drives the robot."""


class HardwareRobot(Tasks):
    """Any device with LeRobot's robot interface, driven by tasks, leaders and single actions.

    Args:
        device: has ``observation_features``, ``action_features``, ``get_observation``, ``send_action``, ``connect``,
            ``disconnect``, and may have ``is_connected``, ``joint_ranges``, ``get_joints`` and ``hold``.
        tool_name: what the robot is called on a network, 1 to 128 characters.
        control_hz: control rate, 1 to 2000; ``STRANDS_CONTROL_HZ`` by default.
        joint_ranges: lowest and highest target by action key, in the device's unit; what is not named is asked of
            the device, and unbounded where it does not know.
        stop_level: what a halt leaves: ``hold`` (frozen, torque on) or ``release`` (torque off: an arm falls); by
            default as ``STRANDS_ESTOP_TORQUE`` says.

    Raises:
        ValidationError: an argument outside its domain, or a device that lacks a part of the interface.
    """

    def __init__(
        self,
        device: Any,
        tool_name: str = "robot",
        control_hz: float | None = None,
        *,
        joint_ranges: Mapping[str, tuple[float, float]] | None = None,
        stop_level: StopLevel | None = None,
    ) -> None:
        name = text("tool_name", tool_name, longest=128)
        rate = settings.number("STRANDS_CONTROL_HZ") if control_hz is None else control_hz
        asked = ("release" if configured_level() == "limp" else "hold") if stop_level is None else stop_level
        level = cast(StopLevel, choice("stop_level", asked, STOP_LEVELS))
        super().__init__(DeviceBody(name, device, joint_ranges, level), number("control_hz", rate, low=1, high=2000))
        self.device = device
        self._sends: set[Permit] = set()
        self._unread = ""

    @property
    def safety_key(self) -> str:
        """Under what its lockout is kept: the hardware's own id, whatever it is called; empty where it has none."""
        given = getattr(self.device, "safety_key", "")
        if given:
            return str(given)
        own = stable_id(self.device)
        return "" if own is None else hardware_key(kind(self.device), own)

    def connect(self) -> None:
        """Connect the device, without asking for calibration, and again after its port was gone.

        Raises what the device raises.
        """
        self._body.connect()
        self._freezer.ready()
        if self.gate.refusal("connect") is not None:
            # The halt found no port: a servo that is back goes on to its last goal.
            self._freezer.freeze(ANSWER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S"))

    def get_features(self) -> Envelope:
        """``observation_features`` and ``action_features`` as data (``float``, or an image's shape), with ranges."""
        return success(
            f"{len(self._body.bounds)} action keys.",
            observation_features={key: _kind(feature) for key, feature in self.device.observation_features.items()},
            action_features={key: _kind(feature) for key, feature in self.device.action_features.items()},
            ranges={key: [low, high] for key, (low, high) in self._body.bounds.items() if high - low < float("inf")},
        )

    def get_state(self) -> Envelope:
        """``joints`` by name in the device's unit, ``joints_age_s``, and ``task``.

        While a loop drives the robot the joints are those of its last read, at most two control periods old, or read
        in a turn on the bus that is waited for for at most a control period; while nothing does, for at most 1 s.
        Where no turn comes, or a stop waits for the bus, they are those of the last read, and ``joints_error`` says
        why. A camera that fails does not touch them.
        """
        problem = self._refresh()
        age, joints = self._body.latest_joints or (None, {})
        fields: dict[str, Any] = {"joints": joints, "task": self._task_fields()}
        fields["joints_age_s"] = None if age is None else round(age, 4)
        if problem:
            fields["joints_error"] = problem
        return success(problem or f"{len(joints)} joints.", **fields)

    @property
    def is_connected(self) -> bool:
        """The device is connected, and its port is there."""
        return self._body.is_connected and not self._body.lost

    @property
    def hardware_name(self) -> str:
        """The device's type, such as ``so100_follower``."""
        return kind(self.device)

    @property
    def joint_units(self) -> dict[str, str]:
        """``normalized`` (-100 to 100), ``percent`` (0 to 100), ``degrees`` or the device's own word, by action key;
        a key whose unit nobody states is left out."""
        return joint_units(self.device)

    def get_health(self) -> Envelope:
        """``temps``, degrees Celsius by motor, where the motors tell; the read waits for the bus a control period."""
        if not self._body.is_connected or self._body.lost or not tells_temperature(self.device):
            return success("Nothing is known of its motors' health.")
        if not self._body.lock.acquire(timeout=1 / self.control_hz):
            return error("The bus was busy; the motors' temperatures are not known now.")
        try:
            if self._body.stop_waits:
                return error("A stop waits for the bus; the motors' temperatures are not known now.")
            temps = temperatures(self.device)
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the answer says what
            return error(f"The motors' temperatures could not be read: {type(exc).__name__}: {exc}")
        finally:
            self._body.lock.release()
        return success(f"The warmest motor has {max(temps.values(), default=0.0):g} degrees Celsius.", temps=temps)

    def get_observation(self) -> dict[str, Any]:
        """Everything the device sees, images included, in its turn on the bus. Raises what the device raises."""
        return self._body.get_observation()

    def camera_frames(self) -> Mapping[str, Any]:
        """The newest picture of each of the device's cameras, RGB (height, width, 3), without the bus.

        A picture is taken when it is asked for by its name; that raises what its camera raises.
        """
        cameras = getattr(self.device, "cameras", None)
        return Shots({str(name): partial(_picture, camera) for name, camera in (cameras or {}).items()})

    def send_action(self, action: Mapping[str, float]) -> Envelope:
        """Set targets once; ``sent`` is what the device really took. Refused while a task or a leader drives it."""
        try:
            permit = self.gate.permit("send_action")
            with self.starting:
                self._freezer.ready()
                self._free()
                targets = checked_action(dict(action) if isinstance(action, Mapping) else action, self._body.bounds)
            self._sends.add(permit)
            try:
                sent = self._body.send_action(targets, permit)
            finally:
                self._sends.discard(permit)
        except MotionRefused as refused:
            return refused.envelope
        except PermitVoidError as void:
            return error(f"send_action was overtaken by a stop: {void}.")
        except Exception as exc:
            if not isinstance(exc, ValidationError):
                logger.exception("%s did not take an action.", self.tool_name_str)
            return error(str(exc) if isinstance(exc, ValidationError) else f"{type(exc).__name__}: {exc}")
        return success(f"Sent {len(targets)} targets.", sent=dict(sent))

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop tasks, leaders and single actions, and freeze the robot; answers within ``STRANDS_HALT_DEADLINE_S``.

        Every permit is void first. A verdict of stopped means: no write is in flight, none will follow until
        somebody starts anew, and the robot was frozen. A bus that does not answer is ``not_stopped``.
        """
        began = time.monotonic()
        deadline = began + ANSWER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
        sending = bool(self._sends)
        self.gate.revoke()
        sources: dict[str, Callable[[], object]] = {}
        task = self._task
        if task is not None and task.running:
            task.request_stop()
            sources["task"] = partial(task.ended_by, deadline)
        sources.update(self.teleop_stops(deadline))
        if sending:
            sources["send_action"] = lambda: success("Sent.", stopped=True)
        problem = self._freeze(deadline)
        verdict = halt_each(sources) if problem is None else _unfrozen(problem, tuple(sources))
        logger.info("Halted %s (%s): %s", self.tool_name_str, reason or "no reason given", verdict.stopped)
        return replace(verdict, elapsed_ms=(time.monotonic() - began) * 1000)

    def cleanup(self) -> Envelope:
        """Halt and disconnect. A robot that did not stop stays connected, so that it can still be stopped."""
        verdict = self.halt("cleanup")
        if not verdict.stopped:
            return verdict.envelope()
        self._freezer.close()
        if self._body.is_connected:
            try:
                with self._body.lock:
                    self.device.disconnect()
            except Exception as exc:
                logger.exception("%s did not disconnect.", self.tool_name_str)
                return error(f"Halted, but the device did not disconnect: {type(exc).__name__}: {exc}")
        return success("Halted and disconnected.", stopped=True)

    def _refresh(self) -> str:
        if joint_read_source(self) is None or not self._body.is_connected:
            return "The device is not connected."
        if self._body.lost:
            return "The device's port is gone; these are the joints of the last read."
        age, _ = self._body.latest_joints or (math.inf, {})
        led = bool(self.teleoperating()) or (self._task is not None and self._task.running)
        # Two, because at one the loop itself is about to read, and would be held up.
        if led and age <= 2 / self.control_hz:
            return ""
        within_s = 1 / self.control_hz if led else IDLE_WAIT_S
        if not self._body.lock.acquire(timeout=within_s):
            return f"The bus was busy for {within_s:g} s; these are the joints of the last read."
        try:
            if self._body.stop_waits:
                return "A stop waits for the bus; these are the joints of the last read."
            # Whoever drives it waits meanwhile: for one lost answer, not for three.
            self._body.get_joints(1 if self._body.driven else READ_TRIES)
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the answer says what
            problem = f"The joints could not be read: {type(exc).__name__}: {exc}"
            if problem != self._unread:
                # Somebody may ask fifty times a second.
                logger.warning("%s: %s", self.tool_name_str, problem)
            self._unread = problem
            return problem
        finally:
            self._body.lock.release()
        self._unread = ""
        return ""


def _unfrozen(problem: str, moving: tuple[str, ...]) -> StopVerdict:
    """What moved may move on; of a robot that stood still nobody knows."""
    return StopVerdict(not_stopped=dict.fromkeys(moving, problem), unknown={} if moving else {"bus": problem})


def _picture(camera: Any) -> Any:
    """LeRobot's cameras keep the newest picture of a thread of their own; older ones only hand out new ones."""
    newest = getattr(camera, "read_latest", None)
    return newest() if callable(newest) else camera.async_read()


def _kind(feature: Any) -> Any:
    shape = list(feature) if isinstance(feature, tuple | list) else str(feature)
    return getattr(feature, "__name__", None) or shape
