"""Goal of a robot's own navigation stack."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from strands_robots.drivers.ros.motion import BaseMotion
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.link import Goal, GoalReport, Message, RosError, RosLink, run_goal
from strands_robots.safety.gate import Permit
from strands_robots.stop_log import stop_logger
from strands_robots.utils import MissingExtraError

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
