"""The way an action goal on a ROS graph is waited for, cancelled and told."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, field
from typing import Any

from strands_robots.ros.link import GivenUp, Goal, GoalLink, Heard, Message, RosError, never

SUCCEEDED = 4
"""``action_msgs/GoalStatus`` of a goal that was reached."""

STATUS_WORDS = ("unknown", "accepted", "executing", "canceling", "succeeded", "canceled", "aborted")
"""The statuses of ``action_msgs/GoalStatus``, in the order of their numbers."""

CANCEL_S = 5.0
"""Seconds within which a cancelled goal has to end."""

SLICE_S = 0.01


@dataclass(frozen=True, slots=True)
class GoalReport:
    """How a goal went. ``state``: a word of :data:`STATUS_WORDS`, ``rejected``, or ``lost`` where its end is not known.

    ``over`` is true when the server told its end, so that nothing goes on; ``cut`` says who ended it, "" nobody;
    ``sent`` is a lost goal itself, whose end may still come.
    """

    state: str
    over: bool
    cut: str = ""
    status: int | None = None
    values: Any = field(default_factory=dict)
    problem: str = ""
    sent: Goal | None = None


def run_goal(
    link: object,
    action: str,
    kind: str,
    goal: Message,
    within_s: float,
    *,
    feedback: Heard | None = None,
    given_up: GivenUp = never,
) -> GoalReport:
    """Send a goal and wait for its end; after ``within_s`` seconds, or when it is given up, cancel it.

    Raises:
        RosError: the goal never began.
    """
    if not isinstance(link, GoalLink):
        raise RosError(f"{action} is an action, and bare DDS carries topics only; use rclpy or rosbridge.")
    deadline = time.monotonic() + within_s
    sent = link.begin_goal(action, kind, goal, within_s, feedback=feedback, given_up=given_up)
    cut = ""
    try:
        while not sent.done.wait(SLICE_S):
            if given_up():
                cut = "a stop"
            elif time.monotonic() >= deadline:
                cut = f"its time of {within_s:g} s"
            if cut:
                break
    except BaseException:
        # A Ctrl-C in the wait must not leave the robot on its way.
        with contextlib.suppress(RosError):  # what cut the wait off is what is told
            sent.cancel()
        raise
    problem = _cancelled(sent) if cut else ""
    if sent.rejected:
        return GoalReport("rejected", True, cut, problem=sent.problem)
    if sent.status is None:
        return GoalReport("lost", False, cut, problem=problem or sent.problem, sent=sent)
    if not SUCCEEDED <= sent.status < len(STATUS_WORDS):
        problem = f"its server told status {sent.status}, which ends nothing"
        return GoalReport("lost", False, cut, sent.status, sent.values, problem)
    return GoalReport(STATUS_WORDS[sent.status], True, cut, sent.status, sent.values)


def _cancelled(sent: Goal) -> str:
    try:
        sent.cancel()
    except RosError as exc:
        return f"it could not be cancelled: {exc}"
    return "" if sent.done.wait(CANCEL_S) else f"it did not end within {CANCEL_S:g} s of being cancelled"


def said(report: GoalReport) -> str:
    """A report in one sentence."""
    if report.state == "lost":
        ended = f"After {report.cut}, " if report.cut else ""
        return f"{ended}nobody knows whether the goal still goes on: {report.problem}."
    if report.state == "rejected":
        return report.problem
    cut = f" after {report.cut} ended it" if report.cut else ""
    return f"the goal {'was ' if report.state in ('canceled', 'aborted') else ''}{report.state}{cut}."
