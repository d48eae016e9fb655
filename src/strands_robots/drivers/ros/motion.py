"""Motions of a base: the drive, and the goal of its own navigation stack."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from strands_robots.contract import RolloutEvent
from strands_robots.drivers.ros.velocity import VelocityPublisher
from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.ros.link import Goal, GoalReport, Message, RosError, RosLink, run_goal
from strands_robots.safety.gate import MotionsHeldError, Permit, PermitVoidError
from strands_robots.stop_log import stop_logger
from strands_robots.utils import MissingExtraError, ValidationError

COUNT_MAX = 10**12
"""Most messages of one drive: three hundred years at 100 Hz, and still a number that every sentence can carry."""


class BaseMotion:
    """One motion of a base, which :meth:`run` carries out once, on any thread.

    ``state`` is running, completed, stopped or error; ``answer`` is the envelope that ends it; ``sent`` counts the
    messages sent or the samples of feedback received. The base sets ``ended`` once it is free for the next motion.
    """

    noun: str
    policy: str

    def __init__(self, permit: Permit) -> None:
        self.state = "running"
        self.answer: Envelope | None = None
        self.sent = 0
        self.ended = threading.Event()
        self._permit = permit
        self._began = time.monotonic()
        self._took_s: float | None = None

    @property
    def instruction(self) -> str:
        """The order in a few words."""
        raise NotImplementedError

    @property
    def velocities(self) -> Mapping[str, float]:
        """Ordered ``linear`` (m/s) and ``angular`` (rad/s) velocity, or empty."""
        return {}

    @property
    def elapsed_s(self) -> float:
        """Seconds since the order; after the end, how long the motion took."""
        return time.monotonic() - self._began if self._took_s is None else self._took_s

    def run(self) -> Envelope:
        """Carry out the order and answer how it went; ``answer`` keeps the envelope."""
        raise NotImplementedError

    def status_fields(self) -> dict[str, Any]:
        """Fields of the status that only this kind of motion has."""
        return {}

    def status(self) -> Envelope:
        """Return the progress, and running until the base is free for the next one."""
        state = self.state if self.ended.is_set() else "running"
        return success(
            f"The last {self.noun} is {state}.",
            task_status=state,
            instruction=self.instruction,
            step_count=self.sent,
            duration=round(self.elapsed_s, 3),
            outcome=self._outcome(state),
            **self.status_fields(),
        )

    def _outcome(self, state: str) -> dict[str, Any] | None:
        if state == "running":
            return None
        why = "it was stopped" if self.answer is None else text_of(self.answer)
        return {"task_status": state, "instruction": self.instruction, "duration": round(self.elapsed_s, 3), "why": why}

    def fail_to_begin(self, why: str, **fields: Any) -> Envelope:
        """End the motion before anything was sent; return the error to answer."""
        self.state = "error"
        self.answer = error(f"The {self.noun} could not begin: {why}.", **fields)
        self._took_s = 0.0
        return self.answer

    def event(self, kind: Literal["started", "finished"], robot: str) -> RolloutEvent:
        """Return the event that tells observers of the begin or the end of this motion."""
        answer = self.answer
        return RolloutEvent(
            kind=kind,
            robot=robot,
            instruction=self.instruction,
            policy=self.policy,
            step=self.sent,
            elapsed_s=self.elapsed_s,
            state=self.state,
            error=text_of(answer) if answer is not None and self.state == "error" and is_error(answer) else "",
            action=self.velocities if kind == "started" else {},
        )


class DriveOrder(NamedTuple):
    """A checked drive: velocities as sent (m/s, rad/s), their message and rate."""

    linear: float
    angular: float
    fields: Mapping[str, Any]
    messages: int
    rate_hz: float
    latches: bool

    @property
    def zero(self) -> bool:
        """True for an order to stand still."""
        return not (self.linear or self.angular)

    @property
    def trailing_zero(self) -> bool:
        """True where a zero ends the drive: not after zeros or a latching message."""
        return not (self.latches or self.zero)


class Drive(BaseMotion):
    """Velocity messages at a rate, and one zero after them whatever happened."""

    noun = policy = "drive"

    def __init__(self, order: DriveOrder, publisher: VelocityPublisher, permit: Permit) -> None:
        super().__init__(permit)
        self.order = order
        self._publisher = publisher
        self._stopped = threading.Event()

    @property
    def instruction(self) -> str:
        return f"drive {self.order.linear:g} m/s, {self.order.angular:g} rad/s"

    @property
    def velocities(self) -> Mapping[str, float]:
        return {"linear": self.order.linear, "angular": self.order.angular}

    @property
    def latched(self) -> bool:
        """True where the base may go on at this velocity after the drive.

        A single message that failed, or that a Ctrl-C interrupted, may have reached the base all the same.
        """
        return self.order.latches and not self.order.zero and self.state != "stopped"

    def interrupt(self) -> None:
        """Send nothing more but the zero."""
        self._stopped.set()

    def fail_to_begin(self, why: str, **fields: Any) -> Envelope:
        return super().fail_to_begin(why, messages=0, **fields)

    def run(self) -> Envelope:
        problem, zero_problem = "", ""
        try:
            self._send_all()
        except PermitVoidError:
            self.state = "stopped"
        except Exception as exc:  # noqa: BLE001 - whatever the link raises, the zero still goes out and the answer says so
            problem = str(exc) or type(exc).__name__
        except BaseException:
            problem = "it was interrupted"
            raise
        finally:
            # In a finally, so that a Ctrl-C between the messages leaves no velocity behind either.
            if self.order.trailing_zero:
                zero_problem = self._send_zero()
            self.answer = self._answered(problem, zero_problem)
            self._took_s = time.monotonic() - self._began
        return self.answer

    def _send_all(self) -> None:
        period_s = 1 / self.order.rate_hz
        due = time.monotonic()
        while self.sent < self.order.messages:
            try:
                self._publisher.send(self.order.fields, self._permit)
                self.sent += 1
            except MotionsHeldError:
                self._stand()
                if self.order.latches:
                    continue
            # A late message is not made up for: the ones after it would come faster than the rate.
            due = max(due + period_s, time.monotonic())
            if self.order.latches:
                return
            if self._stopped.wait(min(due - time.monotonic(), threading.TIMEOUT_MAX)):
                raise PermitVoidError("the drive was stopped")

    def _stand(self) -> None:
        """Let the base stand for this beat of a hold."""
        if self.order.latches:
            # It is not told to move yet, and its only message is still to come.
            self._permit.wait()
        else:
            self._publisher.zero()

    def _send_zero(self) -> str:
        try:
            self._publisher.zero()
        except Exception as exc:  # noqa: BLE001 - a zero that failed turns the whole answer into an error
            return str(exc) or type(exc).__name__
        return ""

    def _answered(self, problem: str, zero_problem: str) -> Envelope:
        order = self.order
        fields: dict[str, Any] = {
            "linear": order.linear,
            "angular": order.angular,
            "messages": self.sent,
            "trailing_zero": order.trailing_zero and not zero_problem,
        }
        clauses = []
        if self.state == "stopped":
            clauses.append(f"A stop ended the drive after {self.sent} of {order.messages} messages")
        if problem:
            clauses.append(f"the drive failed after {self.sent} of {order.messages} messages: {problem}")
        if zero_problem:
            clauses.append(f"the zero that ends the drive failed, so the base may still move: {zero_problem}")
        if clauses:
            self.state = "error" if problem or zero_problem else self.state
            sentence = "; ".join(clauses).rstrip(".")
            return error(f"{sentence[0].upper()}{sentence[1:]}.", **fields)
        self.state = "completed"
        latched = " It goes on until it is stopped." if self.latched else ""
        return success(
            f"Sent {self.sent} messages of {order.linear:g} m/s and {order.angular:g} rad/s.{latched}", **fields
        )


def messages_for(name: str, seconds: float, rate_hz: float) -> int:
    """Return how many messages keep a velocity for so long, up to ``COUNT_MAX``."""
    wanted = seconds * rate_hz
    if wanted > COUNT_MAX:
        most = COUNT_MAX / rate_hz
        raise ValidationError(f"{name} must be at most {most:g} s at {rate_hz:g} Hz, not {seconds:g}.")
    return max(1, round(wanted))


logger = stop_logger(__name__)

FEEDBACK_KEPT = 5
"""Number of the last samples of feedback that an answer carries."""


@dataclass(frozen=True, slots=True)
class Destination:
    """A checked goal in metres and radians, and the seconds that it may take."""

    x: float
    y: float
    yaw: float
    frame_id: str
    timeout_s: float

    def fields(self) -> dict[str, Any]:
        """Return the goal of ``nav2_msgs/NavigateToPose``."""
        return {
            "pose": {
                "header": {"frame_id": self.frame_id},
                "pose": {
                    "position": {"x": self.x, "y": self.y, "z": 0.0},
                    "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(self.yaw / 2), "w": math.cos(self.yaw / 2)},
                },
            }
        }


class Navigation(BaseMotion):
    """A goal sent under a permit and waited for; a void permit cancels it."""

    noun = "goal"
    policy = "navigate"

    def __init__(self, link: RosLink, action: str, kind: str, to: Destination, permit: Permit) -> None:
        super().__init__(permit)
        self.to = to
        self.report: GoalReport | None = None
        self.feedback: list[Mapping[str, Any]] = []
        self._link = link
        self._target = (action, kind)

    @property
    def instruction(self) -> str:
        return f"navigate to x {self.to.x:g} m, y {self.to.y:g} m in {self.to.frame_id}"

    def status_fields(self) -> dict[str, Any]:
        """``feedback``: the latest sample."""
        return {"feedback": self.feedback[-1] if self.feedback else {}}

    def fail_to_begin(self, why: str, **fields: Any) -> Envelope:
        return super().fail_to_begin(why, goal_state="not sent", **fields)

    def doubt(self) -> str | None:
        """Return why the robot may still be on its way, or None: it is known not to be."""
        if not self.ended.is_set():
            return "the goal is being cancelled, and its server has not reported its end"
        report, lost = self.report, self._lost_goal
        if report is None and self.answer is None:
            return "the goal was interrupted, and it is unknown whether it still goes on"
        if report is None or report.over or (lost is not None and lost.status is not None):
            return None
        return report.sentence()

    @property
    def _lost_goal(self) -> Goal | None:
        return None if self.report is None else self.report.lost_goal

    def cancel_again(self) -> None:
        """Cancel a lost goal once more."""
        lost = self._lost_goal
        if lost is not None and not lost.done.is_set():
            try:
                lost.cancel()
            except RosError as exc:
                logger.warning("The %s could not be cancelled: %s", self.instruction, exc)

    def run(self) -> Envelope:
        # A goal that was sent is the robot's own: only one that is not sent yet waits for the end of a hold.
        self._permit.wait()
        try:
            self.report = run_goal(
                self._link,
                *self._target,
                self.to.fields(),
                self.to.timeout_s,
                feedback=self._on_feedback,
                cancelled=lambda: not self._permit.valid,
            )
            self.answer = self._answered(self.report)
        except (RosError, MissingExtraError) as exc:
            self.state = "error"
            self.answer = error(f"The goal was not begun: {exc}", goal_state="not sent")
        finally:
            # A Ctrl-C leaves neither a report nor an answer.
            self.state = "error" if self.state == "running" else self.state
            self._took_s = time.monotonic() - self._began
        return self.answer

    def _on_feedback(self, message: Message) -> None:
        self.sent += 1
        self.feedback = [*self.feedback[1 - FEEDBACK_KEPT :], dict(message)]

    def _answered(self, report: GoalReport) -> Envelope:
        fields: dict[str, Any] = {
            "goal_status": report.status,
            "goal_state": report.state,
            "result": report.values,
            "feedback": list(self.feedback),
            "feedback_count": self.sent,
            "ended_by": report.ended_by or None,
        }
        if report.state == "succeeded":
            self.state = "completed"
            return success(f"Arrived at x {self.to.x:g} m, y {self.to.y:g} m in {self.to.frame_id}.", **fields)
        stopped = report.over and report.ended_by and not self._permit.valid
        self.state = "stopped" if stopped else "error"
        sentence = report.sentence()
        return error(f"{sentence[0].upper()}{sentence[1:]}", **fields)
