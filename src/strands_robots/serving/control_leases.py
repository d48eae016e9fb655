"""Control leases of a robot on all its networks, and the verbs on them."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, Protocol, cast

from strands_robots.contract import Observers, Robot, WorldRobot, body_of, holds_robots, robots_in, task_runs
from strands_robots.envelope import Envelope, is_error, success
from strands_robots.safety.authorization import Leave
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.control import (
    KINDS,
    TTL_S,
    ControlChange,
    ControlLease,
    FirstEpoch,
    NotHolderError,
    OnChange,
    doubts,
)
from strands_robots.serving.stops import RobotStop, stop_within
from strands_robots.serving.verbs import LEASE_ID, LEASE_ID_MAX, TTL_MAX_S, TTL_MIN_S, Arguments, Kind, Verb, table
from strands_robots.serving.workers import Share, ShareFullError
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap, choice, number, text
from strands_robots.verb_parameters import Parameter

logger = stop_logger(__name__)

CHANGES_MAX = 256
"""Changes that wait for an observer that hangs; the next is not told."""


class InputStreams(Protocol):
    """Streams of remote leaders, which move the first robot of a world."""

    def leading(self) -> bool:
        """Return True while a leader may move the robot, also in a pause."""

    def void(self) -> None:
        """Let no frame move the robot from now on; wait for nothing."""

    def end_pauses(self) -> None:
        """Void the streams of leaders that pause; wait for nothing."""


class ControlLeases:
    """The leases of one robot, one for each robot of a world.

    They keep no robot alive: they refer to what its networks serve, as long as that lives.
    """

    def __init__(self) -> None:
        self._hardware = False
        self._served: list[Callable[[], Robot | None]] = []
        self._by_name: dict[str, ControlLease] = {}
        self._only: ControlLease | None = None
        self._changing = threading.Lock()
        self._observers, self._telling = Observers[ControlChange](), Share(1, CHANGES_MAX)
        self._first_epoch = FirstEpoch()
        self._first_robot = ""
        self._streams: weakref.WeakSet[InputStreams] = weakref.WeakSet()

    def attach(self, streams: InputStreams) -> None:
        """Count the motions of these streams as long as they live."""
        self._streams.add(streams)

    def only(self, name: str) -> ControlLeases:
        """Return the same leases, for a network peer that is one robot of the world."""
        return _OneOf(self, name)

    def serve(self, robot: Robot, *, hardware: bool) -> None:
        """Add the robot as one of its networks serves it."""
        with self._changing:
            self._hardware = self._hardware or hardware
            self._served = [*(each for each in self._served if each() is not None), self._reference(robot)]
        if not holds_robots(robot):
            # A command then finds it without asking the robot.
            self._only = self.of()
            self._only.hardware = self._hardware

    @staticmethod
    def _reference(robot: Robot) -> Callable[[], Robot | None]:
        try:
            return weakref.ref(robot)
        except TypeError:
            # It allows no weak references, so it lives as long as its leases.
            return lambda: robot

    def observe(self, observer: OnChange) -> Callable[[], None]:
        """Tell ``observer``, on another thread, of every change; return what ends that."""
        return self._observers.subscribe(observer)

    def of(self, name: str = "") -> ControlLease:
        """Return the lease of the robot, or of the named robot of the world."""
        robot = self._robot()
        # Kept: an expiry asks the world for nothing.
        self._first_robot = next(iter(robots_in(robot)), "")
        name = (name or self._first_robot) if holds_robots(robot) else ""
        with self._changing:
            lease = self._by_name.get(name)
            if lease is None:
                shown_as = name or ("" if robot is None else robot.tool_name_str)
                lease = self._by_name[name] = ControlLease(
                    shown_as,
                    lambda reason: self._halt(name, shown_as, reason),
                    lambda: self._moves(name),
                    led_by=lambda: self._led_by(name),
                    end_pauses=lambda: self._end_pauses(name),
                    hardware=self._hardware,
                    first_epoch=self._first_epoch,
                )
                lease.observe(self._tell)
        return lease

    def admit(
        self, command: str, caller: object, lease_id: str, name: str | None, ttl_s: float = 0.0, **how: Any
    ) -> Leave:
        """Admit a motion of the named robot; with None of all robots of the world.

        Raises:
            NotHolderError: another holds the robot, or the lease is over.
        """
        if name is not None or self._only is not None or not holds_robots(self._robot()):
            lease = self._only or self.of(name or "")
            try:
                return lease.admit(command, caller, lease_id, ttl_s, **how)
            except NotHolderError as exc:
                leader = self._led_by(name or "")
                raise (exc.naming(leader) if leader else exc) from None
        for each in tuple(self._by_name.values()):
            each.refuse_others(command, caller, lease_id)
        return Leave()

    def facts(self) -> dict[str, Any]:
        """Return the holder of the robot; by name for the robots of a world."""
        robot = self._robot()
        names = robots_in(robot)
        return {name: self.of(name).facts() for name in names} if len(names) > 1 else self.of().facts()

    def _robot(self) -> Robot | None:
        return next((robot for each in self._served if (robot := each()) is not None), None)

    def _tell(self, change: ControlChange) -> None:
        try:
            self._telling.submit(partial(self._observers.notify, change))
        except ShareFullError:
            logger.warning("%s: an observer of its holder hangs and is not told: %s.", change.robot, change.event)

    def _streams_of(self, name: str) -> list[InputStreams]:
        return list(self._streams) if name == self._first_robot else []

    def _led_by(self, name: str) -> str:
        """Return the leader at this machine that drives the robot, empty without one."""
        robot = self._robot()
        led = getattr(body_of(robot), "teleoperated_by", None)
        return str(led(name or getattr(robot, "tool_name_str", ""))) if callable(led) else ""

    def _end_pauses(self, name: str) -> None:
        for each in tuple(self._streams) if name == self._first_robot else ():
            each.end_pauses()

    def _moves(self, name: str) -> bool | None:
        if any(each.leading() for each in self._streams_of(name)):
            return True
        robot = self._robot()
        if robot is None:
            return False
        # A leader at this machine is no task.
        return bool(self._led_by(name)) or task_runs(robot, name)

    def _halt(self, name: str, shown_as: str, reason: str) -> Future[StopVerdict] | None:
        """Order the halt of the robot, or of the named robot of the world."""
        for each in self._streams_of(name):
            each.void()
        robot = self._robot()
        if robot is None:
            return None
        target = RobotStop(cast(WorldRobot, robot), name) if name else robot
        halting = stop_executor().submit(target, shown_as, reason, within=stop_within(target))
        halting.add_done_callback(partial(_report, shown_as))
        return halting


_LEASES: IdentityMap[ControlLeases] = IdentityMap()


def leases_of(robot: Robot, *, hardware: bool) -> ControlLeases:
    """Return the leases of a robot, the same on every network that serves it."""
    leases = _LEASES.of(body_of(robot), ControlLeases)
    leases.serve(robot, hardware=hardware)
    return leases


class _OneOf(ControlLeases):
    """The leases of a world as one of its robots has them."""

    def __init__(self, world: ControlLeases, name: str) -> None:
        super().__init__()
        self._world = world
        self._name = name

    def of(self, name: str = "") -> ControlLease:
        """Return the lease of this robot."""
        return self._world.of(self._name)

    def admit(
        self, command: str, caller: object, lease_id: str, name: str | None, ttl_s: float = 0.0, **how: Any
    ) -> Leave:
        """Admit a motion of this robot."""
        return self._world.admit(command, caller, lease_id, self._name, ttl_s, **how)

    def facts(self) -> dict[str, Any]:
        """Return the holder of this robot."""
        return self.of().facts()


def control_facts(leases: ControlLeases | None) -> dict[str, Any]:
    """Return who holds a robot, as its status has it; empty for one without leases."""
    return {} if leases is None else {"control": leases.facts()}


def _report(robot: str, halted: Future[StopVerdict]) -> None:
    """Log a robot that may still move."""
    verdict = halted.result()
    if not verdict.stopped:
        logger.critical("%s may still move after the end of a lease: %s", robot, doubts(verdict))


_KIND = Parameter(
    "kind",
    str,
    f"Who will move it: {', '.join(KINDS)}",
    lambda name, value: choice(name, value, KINDS),
    default="agent",
)
_TTL = Parameter(
    "ttl_s",
    float,
    f"Seconds without a call after which it is free again, {TTL_MIN_S:g} to {TTL_MAX_S:g}",
    lambda name, value: number(name, value, low=TTL_MIN_S, high=TTL_MAX_S),
    default=TTL_S,
)
_HELD = Parameter(
    LEASE_ID,
    str,
    "The lease_id of acquireControl or takeControl",
    lambda name, value: text(name, value, longest=LEASE_ID_MAX),
)
_REASON = Parameter("reason", str, "Why, 1 to 200 characters", lambda name, value: text(name, value, longest=200))
_ASSERTION = Parameter(
    "assertion",
    dict,
    "What the operator's key signed: v, purpose, robot, epoch (of getControl), t, nonce and sig",
    lambda name, value: value,  # the lease refuses what was not signed
    default=None,
)


def _lease(arguments: Arguments) -> ControlLease:
    leases: ControlLeases = arguments["leases"]
    return leases.of(arguments.get("robot_name", "") or "")


def _acquire(robot: Robot, arguments: Arguments) -> Envelope:
    held = arguments.get(LEASE_ID, "") or ""
    answer = _lease(arguments).acquire(arguments["caller"], arguments["kind"], arguments["ttl_s"], held)
    return _of_one(robot, arguments, answer)


def _take(robot: Robot, arguments: Arguments) -> Envelope:
    name, device = arguments.get("robot_name", "") or "", arguments["robot"]
    who = f"{device}/{name}" if name else device
    answer = _lease(arguments).take(arguments["caller"], arguments["reason"], who, arguments.get("assertion"))
    return _of_one(robot, arguments, answer)


def _of_one(robot: Robot, arguments: Arguments, answer: Envelope) -> Envelope:
    """Name the robot of a world whose lease it is."""
    if not holds_robots(robot) or is_error(answer):
        return answer
    return {**answer, "robot_name": arguments.get("robot_name") or next(iter(robot.list_robots()), "")}


def _read(robot: Robot, arguments: Arguments) -> Envelope:
    facts = _lease(arguments).facts()
    held = f"{facts['holder']} ({facts['kind']}) holds control." if facts["held"] else "Nobody holds control."
    return success(held, **facts)


def _on_lease(name: str, summary: str, *parameters: Parameter, kind: Kind = Kind.RESUME, **carried_out: Any) -> Verb:
    return Verb(name, kind, summary, parameters, on_lease=True, urgent=True, **carried_out)


CONTROL_VERBS = table(
    [
        Verb(
            "acquireControl",
            Kind.MOTION,
            "Hold a free robot: it then moves only with your lease_id, and halts when you have been silent for ttl_s.",
            (_KIND, _TTL),
            returns="lease_id, epoch, expires_in_s, robot_name; refused with the holder and the seconds left",
            run=_acquire,
            on_lease=True,
            critical=False,
        ),
        _on_lease(
            "renewControl",
            "Start the time of your lease anew; every motion does so too.",
            _HELD,
            returns="epoch, expires_in_s",
            run=lambda robot, arguments: _lease(arguments).renew(arguments[LEASE_ID]),
        ),
        _on_lease(
            "releaseControl",
            "Free the robot for others.",
            _HELD,
            returns="epoch",
            run=lambda robot, arguments: _lease(arguments).release(arguments[LEASE_ID]),
        ),
        _on_lease(
            "takeControl",
            "A human takes the robot from its holder, by the operator's signature; it is halted before the answer.",
            _REASON,
            _ASSERTION,
            returns="lease_id, epoch, expires_in_s",
            run=_take,
        ),
        _on_lease(
            "getControl",
            "Read who holds the robot.",
            returns="held, holder, kind, epoch, for_one_motion, expires_in_s",
            run=_read,
            kind=Kind.READ,
        ),
    ]
)
