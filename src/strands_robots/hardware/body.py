"""Device as the body of a control loop, under bus lock and permit; leader arms."""

from __future__ import annotations

import inspect
import logging
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from types import TracebackType
from typing import Any, Self, TypeVar

from strands_robots.bus_access import (
    action_ranges,
    bus_lock,
    declared_numbers,
    joint_reader,
    motor_buses,
    read_currents,
    write_joints,
)
from strands_robots.hardware._compat import drop, forget_input, reopened, stop_base, unplugged
from strands_robots.hardware.device_facts import default_speeds, require_port
from strands_robots.hardware.hold_check import HoldCheck
from strands_robots.hardware.lerobot_device import answer_lost, write_to_servos
from strands_robots.policies.base import Action, checked_speeds, is_velocity, numbers
from strands_robots.safety.gate import MotionsHeldError, Permit, PermitVoidError
from strands_robots.safety.stopping import StopLevel
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, number, shown

logger = stop_logger(__name__)

T = TypeVar("T")

READ_TRIES = 3
"""Joint reads that fail before a motor counts as silent; LeRobot waits 50 ms for each answer."""

CONNECT_TRIES = 3
"""Attempts to connect: it takes some two hundred exchanges, and LeRobot gives up at the first lost one.

A motor that does not answer its first ping is a ``RuntimeError`` of LeRobot's, one that falls silent later a
``ConnectionError``."""

IDLE_WAIT_S = 1.0
"""Seconds that a read of the state waits for the bus while nothing drives the robot."""

HOLD_FRESH_S = 0.25
"""Greatest age, in seconds, of a joint read whose positions are held when a new one fails."""

_INTERFACE = ("get_observation", "send_action", "connect", "disconnect")


class DeviceBody:
    """One device with LeRobot's robot interface.

    Args:
        name: what it is called in events and refusals.
        device: the device.
        joint_ranges: lowest and highest target by action key; what is not named is asked of the device.
        stop_level: hold (freeze with torque on), limp (torque off: an arm falls) or settle, whose stop freezes too.
        speed_limit: greatest speed of every position, or by action key, in its unit a second.

    Raises:
        ValidationError: the device lacks a part of the interface, a range is none, or it cannot release torque.
    """

    stall_lag = 0.05
    """Least lag of a joint in contact, in radians: a gear sticks and has play before it moves."""

    def __init__(
        self,
        name: str,
        device: Any,
        joint_ranges: Mapping[str, tuple[float, float]] | None = None,
        stop_level: StopLevel = "hold",
        speed_limit: float | Mapping[str, float] | None = None,
    ) -> None:
        self.name = name
        self.device = device
        missing = [verb for verb in _INTERFACE if not callable(getattr(device, verb, None))]
        missing += [name for name in ("observation_features", "action_features") if not hasattr(device, name)]
        if missing:
            raise ValidationError(f"device must have LeRobot's robot interface; {shown(device)} lacks {missing}.")
        self._torque = _torque_buses(device)
        # Motors take targets, which may be sent again; of a device of its own kind an action may be a step.
        self._send_tries = READ_TRIES if motor_buses(device) else 1
        if stop_level != "hold" and not self._torque:
            raise ValidationError(
                f"stop_level (or STRANDS_ESTOP_TORQUE) must be hold: {shown(device)} has no bus.disable_torque()."
            )
        self.stop_level = stop_level
        self._limp: set[str] = set()
        self.lock = bus_lock(device)
        self.bounds = {**action_ranges(device), **_checked(joint_ranges or {}, device)}
        positions = [key for key in self.bounds if not is_velocity(key)]
        # LeRobot's driver of an arm on a base takes no action without the speeds of the base.
        self._still = {key: 0.0 for key in self.bounds if is_velocity(key)} if positions else {}
        self._speeds = {} if speed_limit is None else checked_speeds(speed_limit, positions)
        self._read_joints = joint_reader(device)
        self.speeds = default_speeds(device) | self._speeds
        """Greatest speed by action key: as given, else 2 rad/s for an angle."""
        self._latest: tuple[float, dict[str, float]] | None = None
        self.targets: dict[str, float] = {}
        """What it was told last by an action, by key; empty once it was frozen or let go."""
        self._holdable = HoldCheck(name)
        self._lost = False
        self._was_connected = self.is_connected
        self._holds_unconnected = bool(getattr(device, "holds_unconnected", False))
        self._stops: list[object] = []
        self._current_lost, self._unread = False, ""
        self.driven = False
        """True from an action until it was frozen or let go."""

    @property
    def lost(self) -> bool:
        """True from when its port was found gone until it is connected again."""
        self._lost = self._lost or unplugged(self.device)
        return self._lost

    @property
    def is_connected(self) -> bool:
        """The device's own state; a device without one counts as connected."""
        return bool(getattr(self.device, "is_connected", True))

    @property
    def stop_waits(self) -> bool:
        """True while the body is being stopped, or a stop waits for the bus."""
        return bool(self._stops)

    @property
    def latest_joints(self) -> tuple[float, dict[str, float]] | None:
        """Seconds since the last joint read, and its joints; None before the first."""
        latest = self._latest
        return None if latest is None else (time.monotonic() - latest[0], dict(latest[1]))

    def connect(self) -> None:
        """Connect the device unless it is connected, a LeRobot device without a prompt."""
        with self.lock:
            if self.lost:
                drop(self.device)
            elif self.is_connected and hasattr(self.device, "is_connected"):
                return
            self.bring_up(self.device)
            self._lost, self._was_connected = False, True
            self.speeds = default_speeds(self.device) | self._speeds
            self._read_joints = joint_reader(self.device)
            # A driver that connects switches the torque on.
            self._limp = set()

    @staticmethod
    def bring_up(device: Any) -> None:
        """Connect a follower or leader, its calibration first; close it on failure."""
        require_port(device)
        for left in reversed(range(CONNECT_TRIES)):
            try:
                write_to_servos(device)
                if "calibrate" in inspect.signature(device.connect).parameters:
                    device.connect(calibrate=False)
                else:
                    device.connect()
            except BaseException as exc:
                drop(device)
                if left and answer_lost(exc):
                    continue
                raise
            return

    def get_observation(self) -> dict[str, Any]:
        """Read joints and pictures; repeat as :meth:`get_joints` does."""
        with self.lock:
            began, observation = self._exchange(lambda: (time.monotonic(), dict(self.device.get_observation())))
            self._latest = (began, declared_numbers(self.device, observation))
            return observation

    def get_joints(self, tries: int = READ_TRIES, *, urgent: bool = False) -> dict[str, float]:
        """Read the joints; repeat after a lost answer unless a stop waits for the bus.

        Raises what the device raises.

        Args:
            tries: reads of which one has to be answered.
            urgent: do not give the bus up to a stop that waits, for this is the stop.
        """
        with self.lock:
            joints = self._exchange(self._read_joints, tries, urgent=urgent)
            self._latest = (time.monotonic(), joints)
            return dict(joints)

    def refresh(self, *, led: bool, rate: float) -> str:
        """Read the joints unless they are fresh; return why they were not read, or "".

        Args:
            led: a loop drives the robot and reads them itself.
            rate: of that loop, in Hz.
        """
        if not self.is_connected:
            return "The device is not connected."
        if self.lost:
            return "The device's port is gone; these are the joints of the last read."
        age, _ = self.latest_joints or (math.inf, {})
        # Two, because at one the loop itself is about to read, and would be held up.
        if led and age <= 2 / rate:
            return ""
        within_s = 1 / rate if led else IDLE_WAIT_S
        if not self.lock.acquire(timeout=within_s):
            return f"The bus was busy for {within_s:g} s; these are the joints of the last read."
        try:
            if self.stop_waits:
                return "A stop waits for the bus; these are the joints of the last read."
            # The driving loop waits meanwhile: for one lost answer, not for three.
            self.get_joints(1 if self.driven else READ_TRIES)
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the answer says what
            problem = f"The joints could not be read: {type(exc).__name__}: {exc}"
            if problem != self._unread:
                # A caller may ask fifty times a second.
                logger.warning("%s: %s", self.name, problem)
            self._unread = problem
            return problem
        finally:
            self.lock.release()
        self._unread = ""
        return ""

    def get_positions(self) -> dict[str, float]:
        """Read the joints, which are called as the action keys are."""
        return self.get_joints()

    def get_currents(self) -> dict[str, float]:
        """Read how much the motors draw in ampere, by the keys of :meth:`get_joints`.

        Empty where that is not known: the device has no such motors, a stop waits for the bus, or the answer was lost,
        which is logged once. One try, for a motion goes on without it.
        """
        if self._stops:
            return {}
        with self.lock:
            # Another stop may have come while this waited for the bus.
            if self._stops:
                return {}
            try:
                return self._exchange(lambda: read_currents(self.device), 1)
            except Exception as exc:  # noqa: BLE001 - a bus may raise anything; contact is then seen by the lag alone
                level = logging.DEBUG if self._current_lost else logging.WARNING
                logger.log(
                    level, "%s did not tell the currents of its motors: %s: %s", self.name, type(exc).__name__, exc
                )
                self._current_lost = True
                return {}

    def send_action(self, action: Action, permit: Permit) -> Mapping[str, Any]:
        def send() -> Any:
            if not permit.valid:
                raise PermitVoidError(f"{self.name} was stopped")
            if permit.held:
                # Also before the second try of an exchange that the process did not run in.
                raise MotionsHeldError(f"{self.name} holds")
            if self._limp:
                self._stiffen()
            self.driven = True
            # A driver that bounds the step reads the joints first, whose answer may be lost.
            return self.device.send_action(self._still | dict(action))

        def exchange() -> Mapping[str, Any]:
            sent = self._exchange(send, self._send_tries)
            taken = sent if isinstance(sent, Mapping) else dict(action)
            _, present = self._latest or (0.0, {})
            self._holdable.note(action, numbers(taken), present)
            self.targets |= {key: value for key, value in numbers(taken).items() if key not in self._holdable.turned}
            return taken

        return permit.write(self.lock, exchange)

    def hold(self, permit: Permit | None = None) -> None:
        with self.lock:
            if permit is None or not permit.revoked:
                self._hold()
                self.driven = False

    def let_go(self, permit: Permit) -> None:
        """Switch the torque off at the end of a motion."""

        def release() -> None:
            if not permit.valid:
                raise PermitVoidError(f"{self.name} was stopped")
            self._release()
            self.driven = False

        permit.write(self.lock, release)

    @property
    def motors(self) -> tuple[str, ...]:
        """Motors whose torque can be switched off by name."""
        return tuple(motor for motor in self._torque if motor)

    @property
    def limp_motors(self) -> tuple[str, ...]:
        """Motors whose torque was switched off here, and not on again."""
        return tuple(motor or "bus" for motor in self._torque if motor in self._limp)

    def release(self, motors: Collection[str] = ()) -> None:
        """Freeze the robot and switch the torque of ``motors`` off, or of all.

        Raises:
            ConnectionError: the port is gone, or some motors did not confirm that they let go.
            Exception: what else the device raises.
        """
        with self.stopping():
            if self.lost or not self.is_connected:
                raise ConnectionError("its port is gone" if self.lost else "it is not connected")
            # What is to let go does so first: it may be squeezing a person.
            self._release(motors)
            if motors:
                self._hold(urgent=True)
            self.driven = False

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """Reserve the bus for a stop; readers release it after their exchange.

        The bus is waited for without end, so a caller with a deadline does this on the stop executor's thread.
        """
        stop = object()
        self._stops.append(stop)
        try:
            with self.lock:
                try:
                    yield
                finally:
                    # Before the bus is free: the next reader then waits for no stop that is over.
                    self._stops.remove(stop)
        finally:
            # A Ctrl-C may have cut off the wait for the bus.
            if stop in self._stops:
                self._stops.remove(stop)

    def stop(self) -> None:
        """Freeze or release as the stop level says; nothing if idle and disconnected.

        Raises:
            ConnectionError: the port is gone, or some motors did not confirm that they let go.
            Exception: what else the device raises.
        """
        with self.stopping():
            # A port that is back is written to at once; the next motion connects and configures the device again.
            if self.lost and not reopened(self.device):
                raise ConnectionError("its port is gone; a servo goes on to its last goal")
            if not (self.is_connected or self._holds_unconnected):
                self._check_known_still()
                return
            if self.stop_level == "limp":
                self._release()
            else:
                self._hold(urgent=True)
            self.driven, self._was_connected = False, True

    def _check_known_still(self) -> None:
        """Raise :class:`ConnectionError` unless the device is known not to move."""
        if self.driven:
            raise ConnectionError("it is not connected; what it was told last goes on")
        if not self._was_connected:
            raise ConnectionError("it was never connected here, so it is not known whether it moves")

    def running(self) -> AbstractContextManager[None]:
        return nullcontext()

    def _exchange(self, exchange: Callable[[], T], tries: int = READ_TRIES, *, urgent: bool = False) -> T:
        """Repeat an exchange after a lost answer unless a stop waits for the bus."""
        for left in reversed(range(tries)):
            # An answer that came late would be taken for this one's, and every read after it be old.
            forget_input(self.device)
            try:
                return exchange()
            except ConnectionError:
                if not left or (self._stops and not urgent):
                    raise
        raise AssertionError  # the last try returns or raises

    def _hold(self, *, urgent: bool = False) -> None:
        """Use the device's ``hold()``, else target the present position.

        Args:
            urgent: do not give the bus up to a stop that waits, for this is the stop.
        """
        self.targets = {}
        own = getattr(self.device, "hold", None)
        if callable(own):
            own()
            return
        still = {key: 0.0 for key in self.bounds if is_velocity(key)}
        if len(still) == len(self.bounds):
            self.device.send_action(still)
            return
        if still:
            self._stop_base(still)
        age, known = self.latest_joints or (math.inf, {})
        try:
            present = self.get_joints(1)
        except ConnectionError:
            # One silent motor must not leave the others running to their goals while it is asked again.
            if age <= HOLD_FRESH_S and (targets := still | self._targets(known)):
                write_joints(self.device, targets)
            present = self.get_joints(READ_TRIES, urgent=urgent)
        targets = still | self._targets(present)
        if targets:
            # LeRobot cannot send an action to an arm of which no motor is in it.
            write = partial(write_joints, self.device) if self._limp else self.device.send_action
            sent = self._exchange(lambda: write(targets), urgent=urgent)
            if isinstance(sent, Mapping):
                self._holdable.note(targets, numbers(sent), present)
        # A bus does not confirm targets; what it answers after them shows that it took them.
        self.get_joints(READ_TRIES, urgent=urgent)
        moving = [key for key in self.bounds if not is_velocity(key) and self._stiff(key)]
        if problem := self._holdable.problem(present, moving=moving):
            raise ConnectionError(problem)
        self._holdable.held()

    def _stop_base(self, still: Mapping[str, float]) -> None:
        """Stop the wheels before the arm is read, which one silent motor fails."""
        try:
            stop_base(self.device, still)
        except Exception:
            # The targets of the arm, which follow, stop the wheels too, or fail the hold.
            logger.warning("%s did not stop its base alone.", self.name, exc_info=True)

    def _targets(self, present: Mapping[str, float]) -> dict[str, float]:
        """Return what freezes the robot; a motor without torque gets no target."""
        return {
            key: present[key]
            for key in self.bounds
            if key in present and not is_velocity(key) and self._stiff(key) and key not in self._holdable.turned
        }

    def _stiff(self, key: str) -> bool:
        """Return True unless the torque of that joint was switched off here."""
        return self._limp.isdisjoint({"", key.removesuffix(".pos")})

    def _release(self, motors: Collection[str] = ()) -> None:
        """Switch torque off motor by motor, so that a silent one delays no other."""
        self.targets = {}
        silent = {}
        for motor, (bus, own) in self._torque.items():
            if motors and motor not in motors:
                continue
            try:
                bus.disable_torque(own) if own is not None else bus.disable_torque()
            except Exception as exc:  # noqa: BLE001 - a bus may raise anything; the halt reports it
                silent[motor or "bus"] = f"{type(exc).__name__}: {exc}"
            else:
                self._limp.add(motor)
        if silent:
            raise ConnectionError(f"torque not confirmed off of {', '.join(silent)} ({next(iter(silent.values()))})")

    def _stiffen(self) -> None:
        """Switch the torque on again for a motion, with the present position as target."""
        present, limp = self.get_joints(READ_TRIES), self._limp
        self._limp = set()
        try:
            targets = self._targets(present)
            if targets:
                self._exchange(lambda: self.device.send_action(self._still | targets))
            for motor in limp:
                bus, own = self._torque[motor]
                enable = getattr(bus, "enable_torque", None)
                if callable(enable):
                    enable(own) if own is not None else enable()
        except BaseException:
            self._limp = limp
            raise


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


def _torque_buses(device: Any) -> dict[str, tuple[Any, str | None]]:
    """Return bus, and name on it, of each motor whose torque can be switched off.

    A bus that names no motors is one entry without a name.
    """
    buses = motor_buses(device) or [("", getattr(device, "bus", None))]
    found: dict[str, tuple[Any, str | None]] = {}
    for prefix, bus in buses:
        if callable(getattr(bus, "disable_torque", None)):
            motors = getattr(bus, "motors", None)
            found |= {f"{prefix}{motor}": (bus, motor) for motor in motors} if motors else {prefix: (bus, None)}
    return found


def _checked(ranges: Mapping[str, tuple[float, float]], device: Any) -> dict[str, tuple[float, float]]:
    checked = {}
    for key, pair in ranges.items():
        if key not in device.action_features:
            raise ValidationError(f"joint_ranges has {shown(key)}, which is no action of the device.")
        try:
            low, high = pair
        except (TypeError, ValueError):
            raise ValidationError(f"joint_ranges[{key!r}] must be a pair of numbers, not {shown(pair)}.") from None
        bottom = -math.inf if low == -math.inf else number(f"joint_ranges[{key!r}] low", low)
        top = math.inf if high == math.inf else number(f"joint_ranges[{key!r}] high", high, above=bottom)
        checked[key] = (bottom, top)
    return checked
