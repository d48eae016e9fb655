"""One goal given to a robot's own navigation stack, from its sending to what is known of its end."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.link import GoalReport, Message, RosError, RosLink, run_goal
from strands_robots.safety.gate import Permit
from strands_robots.utils import MissingExtraError

logger = logging.getLogger(__name__)

FEEDBACK_KEPT = 5
"""How many samples of feedback an answer carries: the last ones."""


@dataclass(frozen=True, slots=True)
class Destination:
    """A checked goal: metres and radians in a frame, and how long the way may take."""

    x: float
    y: float
    yaw: float
    frame_id: str
    timeout_s: float

    def fields(self) -> dict[str, Any]:
        """The goal of ``nav2_msgs/NavigateToPose``; a heading is a rotation about the vertical axis."""
        return {
            "pose": {
                "header": {"frame_id": self.frame_id},
                "pose": {
                    "position": {"x": self.x, "y": self.y, "z": 0.0},
                    "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(self.yaw / 2), "w": math.cos(self.yaw / 2)},
                },
            }
        }


class Navigation:
    """Sends one goal under a permit and waits; a void permit cancels it. :meth:`run` once."""

    policy = "navigate"

    def __init__(self, link: RosLink, action: str, kind: str, to: Destination, permit: Permit) -> None:
        self.to = to
        self.state = "running"
        self.ended = threading.Event()
        """Set by whoever runs it, once the base is free for the next motion."""
        self.report: GoalReport | None = None
        self.feedback: list[Mapping[str, Any]] = []
        self.sent = 0
        self.answer: Envelope | None = None
        self._link = link
        self._target = (action, kind)
        self._permit = permit
        self._began = time.monotonic()
        self._took_s: float | None = None

    @property
    def instruction(self) -> str:
        """The goal in a few words."""
        return f"navigate to x {self.to.x:g} m, y {self.to.y:g} m in {self.to.frame_id}"

    @property
    def velocities(self) -> Mapping[str, float]:
        """None: the stack chooses them."""
        return {}

    @property
    def elapsed_s(self) -> float:
        """Seconds since the goal was ordered; once it has ended, how long it took."""
        return time.monotonic() - self._began if self._took_s is None else self._took_s

    @property
    def doubt(self) -> str | None:
        """Why the robot may still be on its way, or None: it is known not to be."""
        if not self.ended.is_set():
            return "the goal is being cancelled, and its server has not told its end"
        report = self.report
        if report is None and self.answer is None:
            return "the goal was interrupted, and nobody knows whether it still goes on"
        if report is None or report.over or (report.lost_goal is not None and report.lost_goal.status is not None):
            return None
        return report.sentence()

    def wait_until_over(self, within_s: float) -> None:
        """Wait for the end of the goal, a late one of a lost goal too."""
        deadline = time.monotonic() + within_s
        self.ended.wait(within_s)
        lost = None if self.report is None else self.report.lost_goal
        if lost is not None:
            lost.done.wait(max(0.0, deadline - time.monotonic()))

    def cancel_again(self) -> None:
        """Ask once more for the end of a goal that nobody knows to be over."""
        lost = None if self.report is None else self.report.lost_goal
        if lost is not None and not lost.done.is_set():
            try:
                lost.cancel()
            except RosError as exc:
                logger.warning("The %s could not be cancelled: %s", self.instruction, exc)

    def never_began(self, why: str) -> Envelope:
        """In place of :meth:`run`: nothing was sent, for this reason."""
        self.state = "error"
        self.answer = error(f"The goal could not begin: {why}.", goal_state="not sent")
        self._took_s = 0.0
        return self.answer

    def run(self) -> Envelope:
        """Send, wait, and answer how it went; the answer is kept in ``answer``."""
        try:
            self.report = run_goal(
                self._link,
                *self._target,
                self.to.fields(),
                self.to.timeout_s,
                feedback=self._hear,
                cancelled=lambda: not self._permit.valid,
            )
            self.answer = self._answered(self.report)
        except (RosError, MissingExtraError) as exc:
            self.state = "error"
            self.answer = error(f"The goal was not begun: {exc}", goal_state="not sent")
        finally:
            # A Ctrl-C has left neither a report nor an answer.
            self.state = "error" if self.state == "running" else self.state
            self._took_s = time.monotonic() - self._began
        return self.answer

    def _hear(self, message: Message) -> None:
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
