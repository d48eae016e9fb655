"""Every exception with which a remote robot, or the way to it, refuses a call.

::

    StrandsRobotsError
     +-- RefusalError          robot, verb, why, remedy, envelope
          +-- ArgumentsError       the arguments
          +-- UnknownVerbError     no such verb; an AttributeError as well
          +-- CallerError          this caller may not move the robot
          +-- ControlError         another holds the control lease, or the lease is over
          +-- LockoutError         locked by an emergency stop
          +-- ApprovalError        the operator has not approved the motion
          +-- BusyError            the robot has earlier calls to answer
          +-- RobotError           the verb failed, or was refused, inside the robot
          +-- NoSuchRobotError     no robot has the id; a LookupError as well
          +-- AmbiguousRobotError  two networks have a robot of the id
          +-- NoAnswerError        no answer in time; a TimeoutError as well
          +-- UnreachableError     the network; a ConnectionError as well
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class StrandsRobotsError(Exception):
    """Base of all public exceptions of ``strands_robots``.

    A subclass keeps the built-in base that callers know it by: :class:`~strands_robots.utils.ValidationError` is a
    ``ValueError`` as well, a policy's failure a ``RuntimeError``. Exceptions are raised inside the package; an agent or
    a network peer sees an error envelope (:mod:`strands_robots.envelope`) instead.
    """


class RefusalError(StrandsRobotsError, RuntimeError):
    """A call that was not carried out: who refused it, what, why, and what to do.

    Attributes:
        robot: id of the robot; empty where none is concerned.
        verb: the verb's name on the wire; empty where none is concerned.
        why: the reason, as the robot or the network gave it.
        remedy: what the caller can do about it; may be empty.
        envelope: the robot's whole answer; empty where there was none.
    """

    usual_remedy = ""

    def __init__(
        self,
        why: str,
        *,
        robot: str = "",
        verb: str = "",
        remedy: str | None = None,
        envelope: Mapping[str, Any] | None = None,
    ) -> None:
        self.robot, self.verb, self.why = robot, verb, why
        self.remedy = self.usual_remedy if remedy is None else remedy
        self.envelope = dict(envelope or {})
        said = why if not why or why.endswith((".", "!", "?")) else f"{why}."
        super().__init__(" ".join(filter(None, (f"{robot}:" if robot else "", said, self.remedy))))


class ArgumentsError(RefusalError, ValueError):
    """An argument is missing, unknown or outside its domain."""

    usual_remedy = "help() on the verb lists its arguments with units and domains."


class UnknownVerbError(RefusalError, AttributeError):
    """The robot has no such verb; the remedy names similar ones."""


class CallerError(RefusalError):
    """This caller may not move the robot."""

    usual_remedy = "The operator names the caller in DEVICE_CONNECT_RPC_ALLOW at the robot."


class ControlError(RefusalError):
    """Another caller holds the control lease, or this caller's lease is over."""

    usual_remedy = "Acquire control when the robot is free: with robot.control()."


class LockoutError(RefusalError):
    """An emergency stop has locked the robot."""

    usual_remedy = "The operator clears the lockout with a signed resume: strands-robots resume."


class ApprovalError(RefusalError):
    """The motion needs an approval that the operator has not given."""

    usual_remedy = "The operator approves it at the robot's machine: strands-robots grant."


class BusyError(RefusalError):
    """The robot has no thread left for the call."""

    usual_remedy = "Call again once its earlier calls are answered."


class RobotError(RefusalError):
    """The verb failed, or was refused, inside the robot."""


class NoSuchRobotError(RefusalError, LookupError):
    """No robot in reach has this id; the remedy names similar ones."""


class AmbiguousRobotError(RefusalError):
    """Two networks have a robot of this id, and no key proves which one is meant."""

    usual_remedy = "Give one of them another id, or leave the mesh out: connect(mesh=False). halt() reaches both."


class NoAnswerError(RefusalError, TimeoutError):
    """The robot did not answer in time; what it was asked for may still begin."""

    usual_remedy = "It may still carry the call out: halt() it if it may move."


class UnreachableError(RefusalError, ConnectionError):
    """The network cannot be reached, or cannot carry the call."""

    usual_remedy = "Check the network's settings: strands-robots doctor."
