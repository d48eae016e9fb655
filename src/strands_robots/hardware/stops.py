"""Stops of a real robot besides its halt: of its task, and the release of torque."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

from strands_robots.hardware.body import DeviceBody
from strands_robots.policies.rollout import Rollout, RolloutsEnd
from strands_robots.safety.stop_targets import StopOfRobot
from strands_robots.safety.stopping import PendingVerdict, StopVerdict
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)


@dataclass(frozen=True)
class TaskStop:
    """Stops a task that was asked to end, and leaves what waits to start."""

    body: DeviceBody
    task: Rollout

    def halt_ordered(self) -> None:
        """The caller has noted the task."""

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        try:
            self.body.stop()
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the verdict says what
            return self.unanswered(failure(self.body.name, exc))
        return RolloutsEnd((), {"task": self.task}, deadline)

    def unanswered(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={"task": why})


class ReleasableRobot(Protocol):
    """Robot that switches the torque of motors off on the stop executor's thread."""

    def halt_ordered(self) -> None:
        """Note what moves."""

    def release_here(self, motors: Collection[str], deadline: float) -> StopVerdict | PendingVerdict:
        """Halt and switch torque off."""

    def unanswered(self, why: str) -> StopVerdict:
        """Return the verdict while the bus does not answer."""


@dataclass(frozen=True)
class TorqueRelease(StopOfRobot):
    """Stops a robot and takes the torque of some motors, or all, away."""

    robot: ReleasableRobot
    motors: str

    def stopped_robot(self) -> object:
        """Return the robot, whose own verbs it stops as well."""
        return self.robot

    def halt_ordered(self) -> None:
        """Note what moves."""
        self.robot.halt_ordered()

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        return self.robot.release_here(self.motors.split(",") if self.motors else (), deadline)

    def unanswered(self, why: str) -> StopVerdict:
        return self.robot.unanswered(why)


def failure(name: str, exc: Exception) -> str:
    problem = f"it could not be frozen: {type(exc).__name__}: {exc}"
    logger.critical("%s did not stop: %s", name, problem)
    return problem


def unfrozen(problem: str, moving: Mapping[str, None]) -> StopVerdict:
    """Return the verdict on a robot that is perhaps not frozen."""
    return StopVerdict(not_stopped=dict.fromkeys(moving, problem), unknown={} if moving else {"bus": problem})
