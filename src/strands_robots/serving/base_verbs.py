"""The verbs of mobile bases, beside those of every robot with tasks."""

from __future__ import annotations

from strands_robots.contract import Robot, body_of, for_request
from strands_robots.envelope import Envelope, error
from strands_robots.ros.gate import Approved
from strands_robots.safety.gate import MotionRequest
from strands_robots.serving.robot_verbs import ARM_VERBS
from strands_robots.serving.verbs import Arguments, Begin, Kind, Parameter, Verb, table
from strands_robots.utils import DURATION_MAX_S, duration, number, text


def _of_base(method: str, cannot: str) -> Begin:
    """Carry a verb out by a method of a mobile base; any other robot refuses it."""

    def begin(robot: Robot, arguments: Arguments, request: MotionRequest | None) -> Envelope:
        start = getattr(body_of(robot), method, None)
        if not callable(start):
            return error(cannot)
        # The operator's approval of this verb is the approval of what it sends.
        answer: Envelope = for_request(request, start)(**arguments, tool_context=Approved())
        return answer

    return begin


def _navigates(robot: Robot) -> bool:
    """Return True for a base with a navigation stack."""
    body = body_of(robot)
    return callable(getattr(body, "start_navigation", None)) and getattr(body, "nav_action", None) is not None


DRIVE = Verb(
    "drive",
    Kind.MOTION,
    "Drive for some seconds and return at once; follow it with getStatus or the taskComplete event.",
    (
        Parameter("linear", float, "Speed forwards in m/s; negative reverses", number),
        Parameter("angular", float, "Turning rate in rad/s; positive turns left", number),
        Parameter(
            "duration",
            float,
            f"Seconds until the base is stopped again, above 0 and at most {DURATION_MAX_S:g}",
            duration,
        ),
    ),
    returns="task_status",
    method="start_drive",
    begin=_of_base("start_drive", "drive: this robot is no mobile base."),
)
NAVIGATE_TO = Verb(
    "navigateTo",
    Kind.MOTION,
    "Send the base to a place around obstacles and return at once; follow it with getStatus or taskComplete.",
    (
        Parameter("x", float, "Position of the goal in metres, along the frame's x axis", number),
        Parameter("y", float, "Position of the goal in metres, along the frame's y axis", number),
        Parameter("yaw", float, "Heading at the goal in radians; positive is to the left", number, default=0.0),
        Parameter(
            "frame_id",
            str,
            "Frame in which the goal is given, such as map or odom",
            lambda name, value: text(name, value, longest=255),
            default="map",
        ),
        Parameter(
            "timeout",
            float,
            f"Seconds after which the goal is cancelled, above 0 and at most {DURATION_MAX_S:g}",
            duration,
            default=120.0,
        ),
    ),
    returns="task_status",
    method="start_navigation",
    suits=_navigates,
    begin=_of_base("start_navigation", "navigateTo: this robot has no navigation stack."),
)

BASE_VERBS = {**ARM_VERBS, **table([DRIVE])}
NAVIGATING_BASE_VERBS = {**BASE_VERBS, **table([NAVIGATE_TO])}
